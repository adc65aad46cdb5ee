"""MEOW as a Stable-Baselines3 algorithm: soft Q-learning whose Q-functions and policy are one normalising flow."""

import math
from typing import Any, ClassVar, TypeVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, ReplayBufferSamples, Schedule
from stable_baselines3.common.utils import get_parameters_by_name, polyak_update
from torch import nn

from sb3_tdc.common.checks import (
    ABOVE_ZERO,
    OFF_POLICY_LIMITS,
    Limits,
    check_action_space,
    check_layers,
    check_number,
    check_within,
)
from sb3_tdc.common.off_policy import CheckedOffPolicyAlgorithm, discounts_of
from sb3_tdc.common.saved_fields import SavedField, integer, number
from sb3_tdc.meow.policies import CnnPolicy, MEOWPolicy, MlpPolicy, MultiInputPolicy

SelfMEOW = TypeVar("SelfMEOW", bound="MEOW")


class MEOW(CheckedOffPolicyAlgorithm):
    """
    Maximum entropy reinforcement learning with an energy-based normalising flow (MEow), Chao et al., NeurIPS 2024.

    One conditional flow is the policy, the soft Q-functions and the soft value functions at once. There is no actor
    to train, and the soft values of a target need no samples: they are known in closed form.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param learning_rate: learning rate of the flow, or a schedule of the progress remaining (from 1 to 0)
    :param buffer_size: size of the replay buffer, in transitions
    :param learning_starts: random steps before learning starts
    :param batch_size: minibatch size for each gradient update
    :param tau: τ, the Polyak coefficient, between 0 and 1
    :param gamma: γ, the discount factor
    :param train_freq: Update the model every ``train_freq`` steps, or ``(5, "step")``, ``(2, "episode")``
    :param gradient_steps: How many gradient steps to do after each rollout;
        -1: as many as steps done in the environment
    :param action_noise: noise on top of the sampled action: an ``ActionNoise``, or the standard deviation of Gaussian
        noise in normalised action units, or None for no noise
    :param replay_buffer_class: Replay buffer class to use (for instance ``HerReplayBuffer``)
    :param replay_buffer_kwargs: Keyword arguments to pass to the replay buffer on creation
    :param optimize_memory_usage: Enable a memory efficient variant of the replay buffer
    :param n_steps: if > 1, the target uses n-step returns (with the ``NStepReplayBuffer``)
    :param ent_coef: α > 0, the temperature: the weight of the entropy relative to rewards. It is not learned
    :param max_grad_norm: largest norm of the gradient; a larger gradient is scaled down to it
    :param stats_window_size: Window size, in episodes, of the rollout statistics
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments of the policy: ``log_std_max`` (−0.3), ``net_arch`` ([64, 64]),
        ``shift_arch`` ([256, 256]), ... (see :class:`~sb3_tdc.meow.policies.MEOWPolicy`)
    :param verbose: Verbosity level: 0 for no output, 1 for info messages, 2 for debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    :raises ValueError: if an argument is out of range, with its name, before the networks and the buffer are built
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    limits: ClassVar[Limits] = {
        **OFF_POLICY_LIMITS,
        **dict.fromkeys(("shift_arch", "n_shifts", "n_blocks"), (1, math.inf)),
        **dict.fromkeys(("ent_coef", "max_grad_norm"), (ABOVE_ZERO, math.inf)),
        "dropout": (0.0, 1.0),
    }
    saved_fields: ClassVar[dict[str, SavedField]] = {
        "ent_coef": SavedField(number(above=0.0)),
        "max_grad_norm": SavedField(number(above=0.0)),
        "policy_kwargs.n_blocks": SavedField(integer(1, 256), is_required=False),
    }
    changeable: ClassVar[tuple[str, ...]] = ("ent_coef", "max_grad_norm")
    color: ClassVar[str | None] = "#E69F00"
    policy: MEOWPolicy
    replay_buffer: ReplayBuffer

    def __init__(
        self,
        policy: str | type[MEOWPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-3,
        buffer_size: int = 1_000_000,
        learning_starts: int = 5_000,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | float | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        ent_coef: float = 0.25,
        max_grad_norm: float = 30.0,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        if env is not None:  # None when a model is loaded without one
            env = self._wrap_env(maybe_make_env(env, verbose), verbose)  # it also converts environments of OpenAI Gym
            check_action_space(env.action_space)
        super().__init__(
            policy,
            env,
            learning_rate,
            buffer_size,
            learning_starts,
            batch_size,
            tau,
            gamma,
            train_freq,
            gradient_steps,
            action_noise=action_noise,  # type: ignore[arg-type]  # a number becomes noise in its setter
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            optimize_memory_usage=optimize_memory_usage,
            n_steps=n_steps,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
            sde_support=False,
            supported_action_spaces=(spaces.Box,),
            support_multi_env=True,
        )
        self.ent_coef = ent_coef
        self.max_grad_norm = max_grad_norm
        if _init_setup_model:
            self._setup_model()

    def _check_arguments(self) -> None:
        super()._check_arguments()
        self._check_limits("ent_coef", "max_grad_norm")
        arguments = self.policy_kwargs
        for name in ("n_shifts", "n_blocks", "dropout"):
            check_within(self.limits, name, arguments.get(name, 1), f"policy_kwargs[{name!r}]")
        for name in ("net_arch", "shift_arch"):
            if arguments.get(name) is not None:
                check_layers(f"policy_kwargs[{name!r}]", arguments[name])
        low, high = arguments.get("log_std_min", -5.0), arguments.get("log_std_max", -0.3)
        low = check_number("policy_kwargs['log_std_min']", low)
        check_number("policy_kwargs['log_std_max']", high, low)

    def _setup_model(self) -> None:
        self._check_arguments()
        super()._setup_model()
        self.network, self.network_target = self.policy.network, self.policy.network_target

    # ---------------------------------------------------------------- the update

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        """
        Update the flow and its target, ``gradient_steps`` times.

        :param gradient_steps: number of updates
        :param batch_size: B, transitions per update
        :raises ValueError: if a schedule returns a value that is not allowed
        :raises NonFiniteError: if the loss was found to be NaN or infinite
        """
        ent_coef = check_within(self.limits, "ent_coef", self.ent_coef)
        self._pass_gamma_to_replay_buffer()
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        statistics, target_statistics = (
            get_parameters_by_name(network, ["running_"]) for network in (self.network, self.network_target)
        )

        for _ in range(gradient_steps):
            self._n_updates += 1
            replay_data = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            target = self.compute_target(replay_data, ent_coef)
            current = self.network(replay_data.observations, replay_data.actions)
            q_values = ent_coef * current.q
            loss = (q_values - target).square().mean()  # over both Q-functions

            self.policy.optimizer.zero_grad()
            loss.backward()
            parameters = self.network.parameters()
            grad_norm = nn.utils.clip_grad_norm_(parameters, self.max_grad_norm)
            self.policy.optimizer.step()

            polyak_update(self.network.parameters(), self.network_target.parameters(), self.tau)
            polyak_update(statistics, target_statistics, 1.0)
            self.diagnose(
                loss=loss.detach(),
                grad_norm=grad_norm,
                q_value=q_values.detach().mean(),
                target=target.mean(),
                log_prob=(current.q - current.v).detach()[:, 0].mean(),
            )
        self._record_training()

    @th.no_grad()
    def compute_target(self, replay_data: ReplayBufferSamples, ent_coef: float) -> th.Tensor:
        """
        Compute y = r + γ(1 − d)·min_i V_i(s') with the target network.

        :param replay_data: a minibatch
        :param ent_coef: α
        :return: (B, 1)
        """
        discounts = discounts_of(replay_data, self.gamma)
        next_values = ent_coef * self.network_target.values(replay_data.next_observations)
        next_value = next_values.amin(dim=1, keepdim=True)
        return replay_data.rewards + discounts * (1 - replay_data.dones) * next_value

    def learn(
        self: SelfMEOW,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "MEOW",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfMEOW:
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "network", "network_target"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer"], []
