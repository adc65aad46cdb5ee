"""A callback that fills TensorBoard's HParams tab."""

from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import HParam, TensorBoardOutputFormat


class RecordHyperparamsCallback(BaseCallback):
    """
    Write hyperparameters to TensorBoard's HParams tab when training begins.

    :param hyperparams: by name; a value that is neither a number nor a string is converted to a string
    """

    def __init__(self, hyperparams: dict[str, Any]):
        super().__init__()
        plain = (bool, int, float, str)
        self.hparams = {k: v if isinstance(v, plain) else str(v) for k, v in hyperparams.items()}

    def _on_training_start(self) -> None:
        metrics: dict[str, float] = {"eval/mean_reward": 0.0, "rollout/ep_rew_mean": 0.0}
        for output in self.logger.output_formats:  # not by the logger: for a screen, SB3 would warn of an empty table
            if isinstance(output, TensorBoardOutputFormat):
                output.write({"hparams": HParam(self.hparams, metrics)}, {"hparams": ()}, self.num_timesteps)

    def _on_step(self) -> bool:
        return True
