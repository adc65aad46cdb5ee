"""Callbacks that save models during training. A full disk does not end training."""

import warnings

from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback

from sb3_tdc.runs.callbacks.finite_guard import check_before_saving
from sb3_tdc.runs.folder import RunFolder
from sb3_tdc.runs.models import DISK_ERRORS, save_model


class SaveBestCallback(BaseCallback):
    """A callback that saves a new best model, with the statistics of ``VecNormalize``."""

    def __init__(self, folder: RunFolder):
        super().__init__()
        self.folder = folder

    def _on_step(self) -> bool:
        try:
            save_model(self.model, self.folder, self.folder.best_model)
        except DISK_ERRORS as error:
            warnings.warn(f"The best model of step {self.num_timesteps:,} was not saved: {error}", stacklevel=2)
        return True


class SavePeriodicallyCallback(CheckpointCallback):
    """SB3's ``CheckpointCallback`` that refuses to save weights that are not finite."""

    def _on_step(self) -> bool:
        if self.n_calls % self.save_freq == 0:
            check_before_saving(self.model)
        try:
            return super()._on_step()
        except DISK_ERRORS as error:
            warnings.warn(f"The model of step {self.num_timesteps:,} was not saved: {error}", stacklevel=2)
        return True
