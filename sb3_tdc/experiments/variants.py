"""
Variants, each compared with the control that it changes: does the change help?

The compared quantity, chosen before any run was made, is the mean of a run's evaluations in its last third, which is
less noisy than the last evaluation. Differences have Welch's interval over seeds. A verdict needs a p-value below 5 %
after Holm's correction for the number of variants with several seeds, under the same conditions (task, number of
steps, MuJoCo).
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from sb3_tdc.ablations import ABLATIONS
from sb3_tdc.common.signatures import constructor_parameters
from sb3_tdc.experiments import statistics
from sb3_tdc.experiments.groups import (
    EVALUATION,
    Group,
    by_conditions,
    have_same_settings,
    hyperparameters_not_shipped,
)
from sb3_tdc.runs.algorithms import KNOWN_ALGORITHMS
from sb3_tdc.tdc import TDC

_LEVEL = 0.05
# The keys of an entry of hyperparams/ that describe training, apart from the constructor's arguments
_OF_TRAINING = ("noise_type", "noise_std", "n_envs", "normalize")
_NAMES = {cls: name for name, cls in {"tdc": TDC, **ABLATIONS}.items()}


def _parent(algo: str) -> str:
    """Return the algorithm that an ablation derives from."""
    return next(_NAMES[base] for base in ABLATIONS[algo].__mro__[1:] if base in _NAMES)


@dataclass(frozen=True)
class Comparison:
    """
    A variant and its control.

    :param returns: late returns of the variant and of the control, each (seeds with evaluations in the last third,)
    :param difference: of the means, variant − control, with its 95 % interval; NaN where there are too few seeds
    :param p: p-value, corrected for the number of variants; NaN for too few seeds, or if all returns are equal
    """

    variant: Group
    control: Group
    returns: tuple[np.ndarray, np.ndarray]
    difference: tuple[float, float, float]
    p: float

    @property
    def verdict(self) -> str:
        fewest = min(map(len, self.returns))
        if fewest < 2:
            return "undecided: too few seeds" if fewest else "undecided: no evaluation in the last third"
        if not self.p < _LEVEL:
            return "undecided"
        return "better" if self.difference[0] > 0 else "worse"


def compare_variants(groups: Sequence[Group]) -> list[Comparison]:
    """
    Return the comparisons of variants of TDC with their controls, under all conditions.

    λ, fixed or calibrated (``tdc-auto``), is compared with λ = 0. Every other ablation is compared with the algorithm
    that it derives from. Control and variant have the same other hyperparameters.
    """
    return _compare_all(groups, _variants)


def compare_settings(groups: Sequence[Group]) -> list[Comparison]:
    """
    Return the comparisons of other hyperparameters with those of ``hyperparams/``, under all conditions.

    Control and variant have the same other settings, if possible also the same interval and number of evaluations.
    Groups that differ only in λ or the head are left out: these have their own sections. So are groups with another
    task or another start, through arguments of the environment, wrappers, or a trained model.
    """
    return _compare_all(groups, _other_settings)


def _compare_all(
    groups: Sequence[Group], pairs: Callable[[Sequence[Group]], Iterator[tuple[Group, Group]]]
) -> list[Comparison]:
    """
    Compare pairs under all conditions; the pairs under the same conditions are one family of Holm's correction.

    :param pairs: finished groups under the same conditions → pairs of variant and control
    """
    found = []
    for alike in by_conditions(group for group in groups if group.finished).values():
        compared = [_compare(variant, control) for variant, control in pairs(alike)]
        corrected = statistics.holm(np.array([comparison.p for comparison in compared]))
        found += [replace(comparison, p=float(p)) for comparison, p in zip(compared, corrected, strict=True)]
    return found


def _variants(finished: Sequence[Group]) -> Iterator[tuple[Group, Group]]:
    for variant in finished:
        for control in (group for group in finished if group is not variant):
            if _is_control(control, variant):
                yield variant, control


def _other_settings(finished: Sequence[Group]) -> Iterator[tuple[Group, Group]]:
    for group in finished:
        changed = hyperparameters_not_shipped(group.runs[0])
        controls = [
            control
            for control in finished
            if control.is_as_shipped
            and control.algo == group.algo
            and have_same_settings(group, control, but={*changed, *EVALUATION})
        ]
        if controls and _are_hyperparameters(group.algo, changed):
            yield group, max(controls, key=lambda g: (have_same_settings(group, g, but=changed), len(g.finished)))


def _are_hyperparameters(algo: str, changed: Iterable[str]) -> bool:
    """Return whether the changed settings are the algorithm's or of its training, and not λ or the head alone."""
    names = {key.partition(".")[0] for key in changed}
    if algo not in KNOWN_ALGORITHMS or not names - {"lam", "stochastic_actor"}:
        return False
    return names <= {*constructor_parameters(KNOWN_ALGORITHMS[algo]), *_OF_TRAINING}


def _is_control(control: Group, variant: Group) -> bool:
    if variant.algo in ("tdc", "tdc-auto"):
        is_zero = control.algo == "tdc" and control.setting("lam") == 0
        return is_zero and have_same_settings(variant, control, but={"lam"})
    is_parent = variant.algo in ABLATIONS and control.algo == _parent(variant.algo)
    return is_parent and have_same_settings(variant, control)


def _compare(variant: Group, control: Group) -> Comparison:
    """Compare a variant with its control; the p-value is not corrected."""
    ours, others = variant.late_returns, control.late_returns
    mean = statistics.mean(ours) - statistics.mean(others)
    if min(len(ours), len(others)) < 2:
        return Comparison(variant, control, (ours, others), (mean, np.nan, np.nan), np.nan)
    test = stats.ttest_ind(ours, others, equal_var=False)
    interval = test.confidence_interval(1 - _LEVEL)
    difference = mean, float(interval.low), float(interval.high)
    return Comparison(variant, control, (ours, others), difference, float(test.pvalue))
