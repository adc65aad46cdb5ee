"""The mathematics of TDC-λ on quantiles: functions of tensors, independent of networks and of the replay buffer.

Shapes: ``B`` transitions of a minibatch, ``C`` critics, ``N`` quantiles. Equation numbers are the paper's
(Osman et al., "Risk sensitive twin distributional critics with a lambda lower confidence bound").
"""

import math
from types import ModuleType
from typing import Any, NamedTuple

import torch as th
from torch.autograd.function import once_differentiable

from sb3_tdc.tdc.compiled import load_kernels

# Number of floats in the all-pairs differences of one chunk of rows (1 MiB). Smaller chunks need more calls; larger
# ones are not faster.
_CHUNK_ELEMENTS = 2**18


def quantile_midpoints(n_quantiles: int, device: th.device | str = "cpu") -> th.Tensor:
    """
    Return the fixed quantile levels (2k − 1) / 2N of a critic's outputs.

    :param n_quantiles: N, at least 1
    :return: (N,)
    """
    return (th.arange(n_quantiles, dtype=th.float32, device=device) + 0.5) / n_quantiles


def mean_and_std(quantiles: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """
    Return the mean and the *population* standard deviation over the quantiles (Eq. 4).

    :param quantiles: (..., N)
    :return: two tensors (...,)
    """
    mean = quantiles.mean(dim=-1)
    # vector_norm after centring is faster than torch.std
    std = th.linalg.vector_norm(quantiles - mean.unsqueeze(-1), dim=-1) / math.sqrt(quantiles.shape[-1])
    return mean, std


def select_critic(mean: th.Tensor, std: th.Tensor, lam: th.Tensor | float) -> th.Tensor:
    """
    Return, per transition, the critic with the smallest mean − λ·std (Eq. 5), the first of equal ones.

    :param mean: (B, C)
    :param std: (B, C)
    :return: (B,) indices
    """
    return (mean - lam * std).min(dim=1).indices  # the same index as argmin, in a sixth of the time


def take_critic(quantiles: th.Tensor, index: th.Tensor) -> th.Tensor:
    """
    Return the quantiles of one critic per transition (Eq. 6).

    :param quantiles: (B, C, N)
    :param index: (B,) indices of critics
    :return: (B, N)
    """
    return quantiles[th.arange(len(index), device=index.device), index]


def td_target(
    rewards: th.Tensor, dones: th.Tensor, discounts: th.Tensor | float, next_quantiles: th.Tensor
) -> th.Tensor:
    """
    Return y_j = r + γ(1 − d)·z_j (Eq. 7).

    :param rewards: (B, 1)
    :param dones: (B, 1), 1 where the episode terminated (not where it was truncated)
    :param discounts: γ, or (B, 1) for n-step returns
    :param next_quantiles: (B, N)
    :return: (B, N)
    :raises ValueError: if rewards, dones or discounts are not (B, 1): broadcasting (B,) to (B, N) would mix transitions
    """
    column = (next_quantiles.shape[0], 1)
    for name, tensor in (("rewards", rewards), ("dones", dones), ("discounts", discounts)):
        if isinstance(tensor, th.Tensor) and tensor.shape != column:
            raise ValueError(f"{name} must have shape {column}, got {tuple(tensor.shape)}")
    return rewards + (1 - dones) * discounts * next_quantiles


class Target(NamedTuple):
    """
    The λ-LCB target of a minibatch.

    :param quantiles: (B, N), y_j (Eq. 7)
    :param mean: (B, C), means of the target critics (Eq. 4)
    :param std: (B, C), their population standard deviations (Eq. 4)
    :param selected: (B,), indices of the selected critics (Eq. 5)
    """

    quantiles: th.Tensor
    mean: th.Tensor
    std: th.Tensor
    selected: th.Tensor


def lcb_target(
    next_quantiles: th.Tensor,
    rewards: th.Tensor,
    dones: th.Tensor,
    discounts: th.Tensor | float,
    lam: th.Tensor | float,
) -> Target:
    """
    Return the λ-LCB target: per transition, that of the critic with the smallest mean − λ·std (Eq. 4–7).

    :param next_quantiles: (B, C, N), of the target critics at (s', ã)
    :param rewards: (B, 1)
    :param dones: (B, 1)
    :param discounts: γ, or (B, 1)
    :param lam: λ ≥ 0
    :raises ValueError: if rewards, dones or discounts are not (B, 1)
    """
    mean, std = mean_and_std(next_quantiles)
    selected = select_critic(mean, std, lam)
    return Target(td_target(rewards, dones, discounts, take_critic(next_quantiles, selected)), mean, std, selected)


def _check_shapes(current: th.Tensor, target: th.Tensor) -> None:
    if current.ndim != 3 or target.ndim != 2 or current.shape[0] != target.shape[0]:
        raise ValueError(
            "current must be (B, C, N) and target (B, M) with the same B, "
            f"got {tuple(current.shape)} and {tuple(target.shape)}"
        )


def _row_chunks(n_rows: int, pairs: int) -> list[slice]:
    """Return slices of rows, each with all-pairs differences that fit into the cache."""
    size = max(1, _CHUNK_ELEMENTS // pairs)
    return [slice(i, min(i + size, n_rows)) for i in range(0, n_rows, size)]


class QuantileHuberGradient:
    """
    :func:`quantile_huber_gradient` of two preallocated tensors, in closed form, with one small buffer for all chunks.

    With c = clamp(y_j − z_k, ±κ) (the sign for κ = 0), the derivative of ρ at z_k summed over the targets is
    ½·((1 − 2τ_k)·Σ_j |c| − Σ_j c). Autograd through all pairs would take most of the time of an update.

    :param current: (C, B, N), read at each call
    :param target: (B, M), read at each call
    :param out: (C, B, N), buffer for the gradient; None to allocate one
    """

    def __init__(self, current: th.Tensor, target: th.Tensor, out: th.Tensor | None = None):
        (n_critics, batch_size, n_quantiles), n_targets = current.shape, target.shape[1]
        self.total, self.size = th.empty_like(current), th.empty_like(current) if out is None else out
        scale = 0.5 / (batch_size * n_quantiles * n_targets)
        self.weight = (1 - 2 * quantile_midpoints(n_quantiles, current.device).to(current.dtype)) * scale
        self.scale = scale
        chunks = _row_chunks(batch_size, n_quantiles * n_targets)
        # Axes [row, j, k]: a sum over j reads the memory in order
        delta = current.new_empty(chunks[0].stop, n_targets, n_quantiles)
        self.chunks = [
            (y, z, delta[: len(y)], self.total[critic, rows], self.size[critic, rows])
            for critic in range(n_critics)
            for rows in chunks
            for y, z in [(target[rows, :, None], current[critic, rows, None, :])]
        ]

    def __call__(self, kappa: float) -> th.Tensor:
        """Return the gradient, (C, B, N), which the next call overwrites."""
        for y, z, delta, total, size in self.chunks:
            th.sub(y, z, out=delta)  # Eq. 8
            clamped = delta.clamp_(-kappa, kappa) if kappa > 0 else delta.sign_()
            th.sum(clamped, dim=1, out=total)
            th.sum(clamped.abs_(), dim=1, out=size)
        return self.size.mul_(self.weight).sub_(self.total, alpha=self.scale)


def _find_kernels(*tensors: th.Tensor) -> ModuleType | None:
    """Return the compiled loops, or None if there are none or the tensors are not float32 on the CPU."""
    fit = all(tensor.device.type == "cpu" and tensor.dtype == th.float32 for tensor in tensors)
    return load_kernels() if fit else None


def quantile_huber_gradient(current: th.Tensor, target: th.Tensor, kappa: float = 1.0) -> th.Tensor:
    """
    Return the gradient of :func:`quantile_huber_loss` with respect to ``current`` (see :class:`QuantileHuberGradient`).

    :param current: (B, C, N)
    :param target: (B, M)
    :param kappa: κ ≥ 0, in units of return
    :return: (B, C, N), exact to float32 rounding
    :raises ValueError: if the shapes do not fit
    """
    _check_shapes(current, target)
    by_critic, target = current.detach().transpose(0, 1).contiguous(), target.detach().contiguous()
    kernels = _find_kernels(by_critic, target)
    if kernels is None:
        return QuantileHuberGradient(by_critic, target)(kappa).transpose(0, 1)
    gradient = th.empty_like(by_critic)
    sums = by_critic.new_empty(len(by_critic), 1, by_critic.shape[2])
    kernels.quantile_huber_gradient(by_critic.numpy(), target.numpy(), gradient.numpy(), sums.numpy(), kappa)
    return gradient.transpose(0, 1)


class _QuantileHuberLoss(th.autograd.Function):
    @staticmethod
    def forward(ctx: Any, current: th.Tensor, target: th.Tensor, kappa: float) -> th.Tensor:
        ctx.save_for_backward(current, target)
        ctx.kappa = kappa
        if (kernels := _find_kernels(current, target)) is not None:
            arrays = current.transpose(0, 1).contiguous().numpy(), target.contiguous().numpy()
            return current.new_tensor(kernels.quantile_huber_loss(*arrays, kappa))
        rows, target_rows = current.flatten(0, 1), target.repeat_interleave(current.shape[1], dim=0)
        sums = th.empty_like(rows), th.empty_like(rows)
        chunks = _row_chunks(len(rows), rows.shape[1] * target.shape[1])
        # Preallocated: fresh buffers of this size cost more than the arithmetic
        distance, clamped = (rows.new_empty(chunks[0].stop, rows.shape[1], target.shape[1]) for _ in range(2))
        for chunk in chunks:
            y, z = target_rows[chunk, None, :], rows[chunk, :, None]
            for near, far, total in ((z, y, sums[0]), (y, z, sums[1])):
                d = th.sub(far, near, out=distance[: len(z)]).clamp_(min=0)  # Eq. 8: |δ| for δ > 0, then for δ < 0
                if kappa > 0:  # L_κ = c·(|δ| − c/2) with c = min(|δ|, κ)
                    c = th.clamp(d, max=kappa, out=clamped[: len(z)])
                    d.sub_(c, alpha=0.5).mul_(c)
                th.sum(d, dim=-1, out=total[chunk])
        sum_above, sum_below = sums
        levels = quantile_midpoints(current.shape[2], current.device).to(current.dtype)
        # Eq. 9: |τ_k − 1{δ<0}| is τ_k above and 1 − τ_k below. Eq. 10: mean over pairs and batch, sum over critics
        pairs = (levels * sum_above + (1 - levels) * sum_below).mean() / target.shape[1]
        return pairs * current.shape[1]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: th.Tensor) -> tuple[th.Tensor, None, None]:
        current, target = ctx.saved_tensors
        return quantile_huber_gradient(current, target, ctx.kappa) * grad_outputs[0], None, None


def quantile_huber_loss(current: th.Tensor, target: th.Tensor, kappa: float = 1.0) -> th.Tensor:
    """
    Return the quantile-Huber loss over all pairs of current and target quantiles (Eq. 8–10).

    δ_kj = y_j − z_k, ρ = |τ_k − 1{δ<0}|·L_κ(δ), L_κ(δ) = δ²/2 for |δ| ≤ κ, else κ(|δ| − κ/2); for κ = 0, |δ|.
    Mean over pairs and transitions, summed over critics, not divided by κ. Differentiable once, with respect
    to ``current``; ``target`` is a constant.

    :param current: (B, C, N) quantiles z_k at the levels of :func:`quantile_midpoints`
    :param target: (B, M) targets y_j, the same for all critics
    :param kappa: κ ≥ 0, in units of return
    :return: scalar, in units of return squared (for κ = 0, of return)
    :raises ValueError: if the shapes do not fit, or the target requires a gradient
    """
    _check_shapes(current, target)
    if target.requires_grad:
        raise ValueError("the target must not require a gradient: it is a constant of the loss")
    return _QuantileHuberLoss.apply(current, target, kappa)
