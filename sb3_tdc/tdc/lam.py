"""
The effect of λ: where it changes which target critic is selected, and how much that adds to the target.

Let critic m have the smallest mean. λ > 0 prefers critic i to m where σ_i > σ_m and λ > (μ_i − μ_m)/(σ_i − σ_m). So the
mean of the target is a non-decreasing step function of λ, which starts from the smallest mean at λ = 0.
"""

import torch as th

from sb3_tdc.tdc.quantiles import Target

QUANTILES = (0.1, 0.5, 0.9)


def critical_lam(mean: th.Tensor, std: th.Tensor) -> th.Tensor:
    """
    Return λ*, above which λ selects a different critic than λ = 0 does.

    :param mean: (B, C)
    :param std: (B, C)
    :return: (B,), at least 0; infinite where the critic with the smallest mean also has the largest σ
    """
    first = mean.argmin(dim=1, keepdim=True)
    more_mean, more_std = mean - mean.gather(1, first), std - std.gather(1, first)
    thresholds = th.where(more_std > 0, more_mean / more_std.clamp(min=th.finfo(std.dtype).tiny), th.inf)
    return thresholds.amin(dim=1)


def describe_selection(target: Target) -> dict[str, th.Tensor]:
    """
    Measure the effect of λ in a minibatch; docs/tdc.md has the equations.

    :param target: the target of the minibatch
    :return: scalars by name; the quantiles of λ* only if λ* is finite for some transition
    """
    _, mean, std, selected = target
    column = selected.unsqueeze(1)
    added = (mean.gather(1, column) - mean.amin(dim=1, keepdim=True)).mean()
    critical = critical_lam(mean, std)
    found = {
        "lam_changes": (mean.argmin(dim=1) != selected).float().mean(),
        "lam_adds": added,
        "lam_adds_in_std": added / std.gather(1, column).mean().clamp(min=1e-12),
        "lam_can_change": critical.isfinite().float().mean(),
    }
    finite = critical[critical.isfinite()]
    if len(finite):
        at = th.tensor(QUANTILES, dtype=finite.dtype, device=finite.device)
        quantiles = finite.quantile(at)
        found |= {f"lam_critical_q{round(100 * q)}": quantiles[i] for i, q in enumerate(QUANTILES)}
    return found
