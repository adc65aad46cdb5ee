"""
Variants of TDC that the experiments compare (docs/lambda.md), but that the package does not offer as options.

Their names begin with that of TDC, whose hyperparameters they use. The commands know them; ``load_safely``
requires the class as its argument ``algorithm``.
"""

from typing import ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_tdc.ablations.calibration import MAX_LAM, CalibratedTDC
from sb3_tdc.common.off_policy import discounts_of
from sb3_tdc.common.saved_fields import SavedField, number
from sb3_tdc.tdc import TDC
from sb3_tdc.tdc.quantiles import Target

# The weight of the newest measurement in the moving average of the errors' size, which spans about 1,000 updates
_KAPPA_WEIGHT = 0.05


class ShiftedTDC(TDC):
    """TDC as the paper's abstract can also be read: the quantiles of the selected critic are moved down by λσ."""

    color: ClassVar[str | None] = "#8C564B"

    def make_target(self, next_quantiles: th.Tensor, replay_data: ReplayBufferSamples, lam: float) -> Target:
        target = super().make_target(next_quantiles, replay_data, lam)
        discounts = discounts_of(replay_data, self.gamma)
        std = target.std.gather(1, target.selected.unsqueeze(1))
        lowered = (1 - replay_data.dones) * discounts * lam * std
        self.diagnose(lowered=lowered.mean())
        return target._replace(quantiles=target.quantiles - lowered)


class PessimisticTDC(CalibratedTDC):
    """
    Two-sided calibration: where λ = 0 still overestimates, the target is lowered by β·(max μ − min μ).

    One number is calibrated: above 0 it is λ, below 0 it is −β.
    """

    saved_fields: ClassVar[dict[str, SavedField]] = {
        "_calibrated": SavedField(number(-MAX_LAM, MAX_LAM), is_required=False)
    }
    least: ClassVar[float] = -MAX_LAM
    color: ClassVar[str | None] = "#9467BD"

    @property
    def pessimism(self) -> float:
        """Return β."""
        return max(-self.calibrated, 0.0)

    def make_target(self, next_quantiles: th.Tensor, replay_data: ReplayBufferSamples, lam: float) -> Target:
        target = super().make_target(next_quantiles, replay_data, lam)
        discounts = discounts_of(replay_data, self.gamma)
        apart = target.mean.amax(dim=1, keepdim=True) - target.mean.amin(dim=1, keepdim=True)
        lowered = (1 - replay_data.dones) * discounts * self.pessimism * apart
        self.diagnose(pessimism=self.pessimism, lowered=lowered.mean())
        return target._replace(quantiles=target.quantiles - lowered)


class ScaledKappaTDC(TDC):
    """TDC whose κ follows the size of the errors: a moving average of mean |y_j − z_k|, taken at every 50th update."""

    color: ClassVar[str | None] = "#BCBD22"

    def diagnose_critics(self, current: th.Tensor, target: Target) -> None:
        super().diagnose_critics(current, target)
        scale = float((target.quantiles[:, None, None] - current[..., None]).abs().mean())
        if np.isfinite(scale):
            self.kappa = self.kappa + _KAPPA_WEIGHT * (scale - self.kappa)
        self.diagnose(kappa=self.kappa)


ABLATIONS: dict[str, type[OffPolicyAlgorithm]] = {
    "tdc-auto": CalibratedTDC,
    "tdc-shift": ShiftedTDC,
    "tdc-pessimism": PessimisticTDC,
    "tdc-kappa": ScaledKappaTDC,
}
