"""Shared base of this package's off-policy algorithms: checked arguments, schedules, a log, guards against NaN."""

import io
import pathlib
from collections.abc import Collection, Iterable
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import ReplayBufferSamples, Schedule
from stable_baselines3.common.utils import update_learning_rate

from sb3_tdc.common.checks import (
    OFF_POLICY_LIMITS,
    Limits,
    check_boolean,
    check_number,
    check_observation_space,
    check_within,
)
from sb3_tdc.common.diagnostics import Diagnostics
from sb3_tdc.common.finite import NonFiniteError, find_non_finite_weights, refuse_to_save
from sb3_tdc.common.noise import NoisyOffPolicyAlgorithm
from sb3_tdc.common.saved_fields import SavedField
from sb3_tdc.common.transitions import check_first_observation, check_transition

# A schedule that ends at 0, such as SB3's LinearSchedule, may fall below 0 by a rounding error
_ROUNDING = 1e-12


def discounts_of(replay_data: ReplayBufferSamples, gamma: float) -> th.Tensor | float:
    """
    Return the discounts of the values that follow the rewards of a minibatch.

    :param gamma: γ
    :return: (B, 1) if the minibatch has discounts, as one of n-step returns does; otherwise γ
    """
    return gamma if replay_data.discounts is None else replay_data.discounts


class CheckedOffPolicyAlgorithm(NoisyOffPolicyAlgorithm):
    """
    Off-policy algorithm that checks its arguments, and neither learns from nor saves values that are not finite.

    A subclass calls ``diagnose`` in its updates and ``_record_training`` after them, and declares

    - in ``limits``, the allowed values of its numeric arguments,
    - in ``schedules``, the arguments that may be schedules,
    - in ``saved_fields``, the fields that its saved models hold in addition to SB3's own,
    - in ``captured_attributes``, the attributes that a resumed run needs although saved models leave them out,
    - in ``changeable``, the arguments that may be changed when a run is resumed,
    - in ``color``, its colour in figures.
    """

    limits: ClassVar[Limits] = OFF_POLICY_LIMITS
    schedules: ClassVar[tuple[str, ...]] = ("learning_rate",)
    saved_fields: ClassVar[dict[str, SavedField]] = {}
    captured_attributes: ClassVar[tuple[str, ...]] = ("_diagnostics",)
    changeable: ClassVar[tuple[str, ...]] = ()
    color: ClassVar[str | None] = None

    # ---------------------------------------------------------------- set-up, replay buffer

    def _setup_model(self) -> None:
        given, kwargs = self.replay_buffer_class, self.replay_buffer_kwargs
        self.replay_buffer_kwargs = dict(kwargs)
        super()._setup_model()
        # The buffer class that SB3 chose, and its n and γ, are not saved: a model may be loaded with other values
        self._chose_replay_buffer, self.replay_buffer_kwargs = given is None, kwargs
        self._diagnostics = Diagnostics()

    def _pass_gamma_to_replay_buffer(self) -> None:
        """Set the discount of an n-step replay buffer that SB3 chose to the current γ."""
        if self._chose_replay_buffer and isinstance(self.replay_buffer, NStepReplayBuffer):
            self.replay_buffer.gamma = self.gamma

    # ---------------------------------------------------------------- arguments

    def _check_arguments(self) -> None:
        check_observation_space(self.observation_space)
        self._check_limits("tau", "gamma", "buffer_size", "batch_size", "n_steps", "learning_starts", "gradient_steps")
        self.optimize_memory_usage = bool(check_boolean("optimize_memory_usage", self.optimize_memory_usage))
        for name in self.schedules:
            value = self.scheduled(name, progress_remaining=1.0)
            given = getattr(self, name)
            if given is not None and not callable(given):
                setattr(self, name, value)
        self._convert_train_freq()
        check_within(self.limits, "train_freq", self.train_freq.frequency)  # type: ignore[union-attr]

    def _check_limits(self, *names: str) -> None:
        for name in names:
            setattr(self, name, check_within(self.limits, name, getattr(self, name)))

    def scheduled(self, name: str, progress_remaining: float | None = None) -> float:
        """Return the current value of one of ``schedules``, checked."""
        value = getattr(self, name)
        if name == "learning_rate" and progress_remaining is None:
            value = self._current_lr_schedule()
        if not callable(value):
            return check_number(name, value, 0.0)
        # A run overshoots its end by the rest of its last rollout, but a schedule expects a progress between 1 and 0
        progress = max(self._current_progress_remaining, 0.0) if progress_remaining is None else progress_remaining
        described = f"{name} (a schedule, at progress remaining {progress:.4g})"
        number = check_number(described, value(progress))
        return 0.0 if -_ROUNDING < number < 0 else check_number(described, number, 0.0)

    def _current_lr_schedule(self) -> Schedule:
        """Return SB3's ``lr_schedule``, after recreating it if ``learning_rate`` has been changed."""
        if self.learning_rate is not self._scheduled_learning_rate:
            self.scheduled("learning_rate", progress_remaining=1.0)  # checks the new value
            self._setup_lr_schedule()
        return self.lr_schedule

    def _setup_lr_schedule(self) -> None:
        super()._setup_lr_schedule()
        self._scheduled_learning_rate = self.learning_rate

    def _update_learning_rate(self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer) -> None:
        for optimizer in optimizers if isinstance(optimizers, list) else [optimizers]:
            update_learning_rate(optimizer, self.scheduled(self._schedule_of(optimizer)))

    def _schedule_of(self, optimizer: th.optim.Optimizer) -> str:
        """Return which of ``schedules`` is the learning rate of an optimizer."""
        return "learning_rate"

    # ---------------------------------------------------------------- logging

    def diagnose(self, **values: th.Tensor | float) -> None:
        """Add scalars of this update to the means in the log, without fetching each from the device."""
        self._diagnostics.add(self._n_updates, self.num_timesteps, values)

    def _record_training(self) -> None:
        """Record the values that callbacks read from the logger after ``train()``, as every algorithm of SB3 does."""
        logger = vars(self).get("_logger")
        if logger is None:
            return
        for name in self.schedules:
            logger.record(f"train/{name}", self.scheduled(name))
        logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self._diagnostics.is_recorded = False
        if self.device.type == "cpu":
            self._diagnostics.record(logger)  # there is no device to wait for

    @property
    def logger(self) -> Logger:
        """Return SB3's logger, after recording training scalars that are still on the device."""
        if not self._diagnostics.is_recorded:
            self._diagnostics.record(self._logger)
        return self._logger

    def dump_logs(self) -> None:
        """Write the log, and restart the means of the training scalars."""
        super().dump_logs()
        self._diagnostics.restart()

    # ---------------------------------------------------------------- finite guards

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        try:
            check_transition(self, buffer_action, new_obs, reward, dones, infos)
        except NonFiniteError:
            self._diagnostics.fetch()  # if a loss has diverged, raises that error instead
            raise
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        prepared = super()._setup_learn(*args, **kwargs)
        check_first_observation(self)
        return prepared

    def _non_finite_weights(self) -> list[str]:
        """Return the names of weights that are NaN or infinite."""
        return find_non_finite_weights(self)

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """
        Save all the attributes of the object and the model parameters in a zip-file.

        :param path: path to the file where the rl agent should be saved
        :param exclude: name of parameters that should be excluded in addition to the default ones
        :param include: name of parameters that might be excluded but should be included anyway
        :raises NonFiniteError: if a weight is NaN or infinite; an existing file stays unchanged
        """
        refuse_to_save(self, self._non_finite_weights())
        super().save(path, exclude, include)

    def _excluded_save_params(self) -> list[str]:
        chosen = ["replay_buffer_class"] if self._chose_replay_buffer else []
        own = ["_diagnostics", "_scheduled_learning_rate", "_chose_replay_buffer"]
        return [*super()._excluded_save_params(), *own, *chosen]

    # ---------------------------------------------------------------- resuming

    def forget_episodes(self) -> None:
        """Forget what a subclass has recorded of the current episodes, because the environments begin new ones."""

    def prepare_to_restore(self, names: Collection[str]) -> None:
        """
        Build the parts that a run has built anew after its beginning, before their weights are restored.

        :param names: names of the state dicts and tensors in the state
        """

    def prepare_to_continue(self) -> None:
        """Create what a model otherwise creates in its first updates, for a run that is resumed after them."""
