"""TDC-λ as a Stable-Baselines3 algorithm. ``train()`` follows Algorithm 1 of the paper, phase by phase."""

import io
import math
import pathlib
from collections.abc import Collection, Iterable
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, ReplayBufferSamples, Schedule
from stable_baselines3.common.utils import get_parameters_by_name
from torch import nn

from sb3_tdc.common.checks import (
    OFF_POLICY_LIMITS,
    Limits,
    check_action_space,
    check_boolean,
    check_layers,
    check_number,
    check_within,
)
from sb3_tdc.common.off_policy import discounts_of
from sb3_tdc.common.saved_fields import SavedField, boolean, integer, none, number, or_none, schedule, text_or_number
from sb3_tdc.tdc.diagnostics import describe_critics, describe_units
from sb3_tdc.tdc.fused import FusedUpdateAlgorithm
from sb3_tdc.tdc.policies import CnnPolicy, MlpPolicy, MultiInputPolicy, TDCPolicy
from sb3_tdc.tdc.quantiles import Target, lcb_target, quantile_huber_gradient

SelfTDC = TypeVar("SelfTDC", bound="TDC")

# The critics' diagnostics (docs/tdc.md) are computed at every fiftieth update only: at every update they would slow
# training down. The first update is included, so that the first line of a log has them
DIAGNOSTICS_INTERVAL = 50
# Counting dormant units (docs/tdc.md) needs extra forward passes, and their number changes slowly. The number in new
# networks says nothing, so the first count comes after this many updates
UNITS_INTERVAL = 500

# Where the gradient stays zero (dead ReLUs), Adam's moments decay to denormal numbers and never reach 0: 0.9 times the
# smallest denormal rounds to itself. Intel's processors are many times slower with denormals. Compared with Adam's ε,
# they are as good as 0
FLUSH_INTERVAL, SMALLEST_MOMENT = 500, 1e-30


class TDC(FusedUpdateAlgorithm):
    """
    Twin Distributional Critics with a λ-lower confidence bound (TDC-λ), Osman et al.

    TD3 with quantile critics. Per transition, the target comes from the target critic with the smallest
    mean − λ·std of its quantiles. The actor's head is deterministic (as in TD3) or tanh-Gaussian (as in SAC).

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param learning_rate: η_π, learning rate of the actor (and of the temperature), or a schedule of the
        progress remaining (from 1 to 0)
    :param buffer_size: size of the replay buffer, in transitions
    :param learning_starts: random steps before learning starts
    :param batch_size: minibatch size for each gradient update
    :param tau: τ, the Polyak coefficient, between 0 and 1
    :param gamma: γ, the discount factor
    :param train_freq: Update the model every ``train_freq`` steps, or ``(5, "step")``, ``(2, "episode")``
    :param gradient_steps: How many gradient steps to do after each rollout;
        -1: as many as steps done in the environment
    :param action_noise: exploration noise added to the mean action: an ``ActionNoise``, or σ_explore, the standard
        deviation of Gaussian noise in normalised action units ([-1, 1]), or None for no noise
    :param replay_buffer_class: Replay buffer class to use (for instance ``HerReplayBuffer``)
    :param replay_buffer_kwargs: Keyword arguments to pass to the replay buffer on creation
    :param optimize_memory_usage: Enable a memory efficient variant of the replay buffer
    :param n_steps: if > 1, the target uses n-step returns (with the ``NStepReplayBuffer``)
    :param lam: λ ≥ 0, the weight of the spread in the selection of the target critic (Eq. 5), or a schedule. λ only
        selects; 0 takes the smaller mean (TD3's clipped double), and a larger λ never gives a smaller target mean
    :param stochastic_actor: ζ: a tanh-Gaussian head trained with entropy (True), or a deterministic one (False).
        Exploration and evaluation use the mean action with either head
    :param qf_learning_rate: η_Q, learning rate of the critics, or a schedule; None: the same as ``learning_rate``
    :param kappa: κ ≥ 0, threshold of the quantile-Huber loss, in units of return; 0: plain quantile regression
    :param policy_delay: d, updates of the critics per update of the actor and the targets
    :param target_policy_noise: σ_tgt, standard deviation of the target policy smoothing noise (deterministic head),
        in normalised action units
    :param target_noise_clip: c, the limit of that noise, in normalised action units
    :param ent_coef: α, temperature (stochastic head): ``"auto"`` learns it, ``"auto_0.1"`` learns it
        from an initial 0.1, a number fixes it
    :param target_entropy: H_target for a learned temperature; ``"auto"`` is −dim(A)
    :param fused: whether to use the fused update (the same update on preallocated buffers, faster). None: where it
        applies (plain ReLU networks, flat observations, Adam, on the CPU). True: always, also on CUDA, where it uses
        CUDA graphs; an error where it does not apply. False: never
    :param stats_window_size: Window size, in episodes, of the rollout statistics
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments of the policy: ``n_quantiles`` (N_q, 64), ``n_critics`` (2),
        ``net_arch`` ([256, 256]), ... (see :class:`~sb3_tdc.tdc.policies.TDCPolicy`)
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
        **dict.fromkeys(("lam", "kappa", "qf_learning_rate"), (0.0, math.inf)),
        "n_quantiles": (1, math.inf),
    }
    schedules: ClassVar[tuple[str, ...]] = ("lam", "learning_rate", "qf_learning_rate")
    saved_fields: ClassVar[dict[str, SavedField]] = {
        "lam": SavedField(schedule),
        "kappa": SavedField(number(0.0)),
        "qf_learning_rate": SavedField(or_none(schedule)),
        "stochastic_actor": SavedField(boolean),
        "policy_delay": SavedField(integer(1)),
        "target_policy_noise": SavedField(number(0.0)),
        "target_noise_clip": SavedField(number(0.0)),
        "ent_coef": SavedField(text_or_number),
        "target_entropy": SavedField(text_or_number),
        "fused": SavedField(or_none(boolean), is_required=False),
        "_built_stochastic_actor": SavedField(boolean, is_required=False),
        # None here: the tensors of a temperature are stored elsewhere in the file
        "log_ent_coef": SavedField(none, is_required=False),
        "ent_coef_optimizer": SavedField(none, is_required=False),
        "ent_coef_tensor": SavedField(none, is_required=False),
        "policy_kwargs.n_critics": SavedField(integer(1, 256), is_required=False),
    }
    changeable: ClassVar[tuple[str, ...]] = (
        *("lam", "kappa", "qf_learning_rate", "policy_delay", "target_policy_noise", "target_noise_clip"),
    )
    # Without it, a temperature that was replaced and then learned would be replaced again
    captured_attributes: ClassVar[tuple[str, ...]] = (*FusedUpdateAlgorithm.captured_attributes, "_built_ent_coef")
    color: ClassVar[str | None] = "#0072B2"
    policy: TDCPolicy
    replay_buffer: ReplayBuffer

    def __init__(
        self,
        policy: str | type[TDCPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        buffer_size: int = 1_000_000,
        learning_starts: int = 5_000,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | float | None = 0.1,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        lam: float | Schedule = 1.0,
        stochastic_actor: bool = False,
        qf_learning_rate: float | Schedule | None = None,
        kappa: float = 1.0,
        policy_delay: int = 2,
        target_policy_noise: float = 0.2,
        target_noise_clip: float = 0.5,
        ent_coef: str | float = "auto",
        target_entropy: str | float = "auto",
        fused: bool | None = None,
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
            policy_kwargs=dict(policy_kwargs or {}),
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
            sde_support=False,
            supported_action_spaces=(spaces.Box,),
            support_multi_env=True,
        )
        self.lam = lam
        self.stochastic_actor = stochastic_actor
        self.qf_learning_rate = qf_learning_rate
        self.kappa = kappa
        self.policy_delay = policy_delay
        self.target_policy_noise = target_policy_noise
        self.target_noise_clip = target_noise_clip
        self.ent_coef = ent_coef
        self.target_entropy = target_entropy
        # As in SAC: the first two are None unless the temperature is learned, the third unless it is fixed
        self.log_ent_coef: Any = None
        self.ent_coef_optimizer: Any = None
        self.ent_coef_tensor: Any = None
        self.fused = fused

        if _init_setup_model:
            self._setup_model()

    # ---------------------------------------------------------------- set-up

    def _check_arguments(self) -> None:
        super()._check_arguments()
        self.stochastic_actor = bool(check_boolean("stochastic_actor", self.stochastic_actor))
        self.fused = check_boolean("fused", self.fused, or_none=True)
        self._check_limits("kappa", "target_policy_noise", "target_noise_clip", "policy_delay")
        for name in ("n_quantiles", "n_critics"):
            check_within(self.limits, name, self.policy_kwargs.get(name, 1), f"policy_kwargs[{name!r}]")
        if self.policy_kwargs.get("net_arch") is not None:
            check_layers("policy_kwargs['net_arch']", self.policy_kwargs["net_arch"], ("pi", "qf"))
        self.target_entropy = self._current_target_entropy()
        self._initial_ent_coef()
        if "stochastic_actor" in self.policy_kwargs:
            raise ValueError("stochastic_actor must be an argument of TDC itself, not one of policy_kwargs")
        saved = getattr(self, "_built_stochastic_actor", self.stochastic_actor)
        if self.stochastic_actor is not saved:
            raise ValueError(f"stochastic_actor must be {saved}, as in the saved model, got {self.stochastic_actor!r}")

    def scheduled(self, name: str, progress_remaining: float | None = None) -> float:
        if name == "qf_learning_rate" and self.qf_learning_rate is None:
            name = "learning_rate"
        return super().scheduled(name, progress_remaining)

    def _setup_model(self) -> None:
        self._check_arguments()
        # Only the policy gets stochastic_actor: SB3 compares the user's policy_kwargs when a model is loaded
        policy_kwargs = self.policy_kwargs
        self.policy_kwargs = {**policy_kwargs, "stochastic_actor": self.stochastic_actor}
        super()._setup_model()
        self.policy_kwargs = policy_kwargs
        self._built_stochastic_actor = self.stochastic_actor
        self.actor, self.actor_target = self.policy.actor, self.policy.actor_target
        self.critic, self.critic_target = self.policy.critic, self.policy.critic_target
        self._setup_fused_update()
        self._setup_temperature()

    def _setup_temperature(self) -> None:
        initial = th.tensor([self._initial_ent_coef()], device=self.device)
        self.log_ent_coef = self.ent_coef_optimizer = self.ent_coef_tensor = None
        self._built_ent_coef = self.ent_coef
        if not self.stochastic_actor:
            return
        if isinstance(self.ent_coef, str) and self.ent_coef.startswith("auto"):
            self.log_ent_coef = initial.log().requires_grad_(True)
            learning_rate = self.scheduled("learning_rate")
            self.ent_coef_optimizer = th.optim.Adam([self.log_ent_coef], lr=learning_rate, fused=True)
        else:
            self.ent_coef_tensor = initial

    def _initial_ent_coef(self) -> float:
        coefficient = self.ent_coef
        learned = isinstance(coefficient, str) and coefficient.startswith("auto")
        if isinstance(coefficient, str) and learned:
            coefficient = coefficient.removeprefix("auto").removeprefix("_") or "1.0"
        try:
            value = check_number("ent_coef", float(coefficient), 0.0)
            if value > 0 or not learned:
                return value
        except (TypeError, ValueError):
            pass
        raise ValueError(
            'ent_coef must be "auto", "auto_" and a positive number (as in "auto_0.1"), '
            f"or a number of at least 0, got {self.ent_coef!r}"
        )

    def _renew_temperature(self) -> None:
        """Build the temperature again if ``ent_coef`` has changed since it was built."""
        if self.ent_coef != self._built_ent_coef:
            self._setup_temperature()

    def prepare_to_restore(self, names: Collection[str]) -> None:
        is_learned = "ent_coef_optimizer" in names
        if self.stochastic_actor and is_learned != self._learns_ent_coef:
            self.ent_coef = "auto" if is_learned else 0.0  # the state's own value is restored after the weights
            self._setup_temperature()

    # ---------------------------------------------------------------- Algorithm 1

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        """
        Run ``gradient_steps`` iterations of Algorithm 1, with :meth:`update` or its fused twin.

        :param gradient_steps: number of updates
        :param batch_size: B, transitions per update
        :raises ValueError: if a schedule returns a value that is not allowed
        :raises NonFiniteError: if a loss was found to be NaN or infinite
        """
        lam = self.scheduled("lam")
        self._pass_gamma_to_replay_buffer()
        self._renew_temperature()
        self._update_learning_rate(self._optimizers())
        fused_update = self._bind_fused_update(batch_size)
        if fused_update is None:
            self.policy.set_training_mode(True)

        for _ in range(gradient_steps):
            self._n_updates += 1
            if fused_update is None:
                self.update(self.replay_buffer.sample(batch_size, env=self._vec_normalize_env), lam)
            else:
                fused_update.step(lam)  # the same computation
            if self._n_updates % FLUSH_INTERVAL == 0:
                self._flush_moments()
        self._record_training()

    def update(self, replay_data: ReplayBufferSamples, lam: float) -> None:
        """
        Run one iteration of Algorithm 1.

        :param replay_data: a minibatch
        :param lam: λ
        """
        self.update_critics(replay_data, lam)
        if self._n_updates % self.policy_delay == 0:
            self.update_actor(replay_data)
            self.update_targets()
        if self.diagnoses_units:
            self.diagnose_units(replay_data.observations)

    def update_critics(self, replay_data: ReplayBufferSamples, lam: float) -> None:
        """Take one step of the critics (Eq. 1–10)."""
        with th.no_grad():
            next_actions = self._sample_target_actions(replay_data)
            next_quantiles = self.critic_target(replay_data.next_observations, next_actions)  # Eq. 3
            target = self.make_target(next_quantiles, replay_data, lam)
        current_quantiles = self.critic(replay_data.observations, replay_data.actions)

        # Learning needs only the gradient of the loss (Eq. 8–10), not its value
        grad_output = quantile_huber_gradient(current_quantiles, target.quantiles, self.kappa)
        self._minimize(current_quantiles, self.critic.optimizer, grad_output)
        if self.diagnoses_critics:
            self.diagnose_critics(current_quantiles.detach(), target)

    def _sample_target_actions(self, replay_data: ReplayBufferSamples) -> th.Tensor:
        """Return ã at s' from the target actor, (B, A): a sample (Eq. 2), or the mean with clipped noise (Eq. 1)."""
        if self.stochastic_actor:
            return self.actor_target(replay_data.next_observations, deterministic=False)
        noise = th.randn_like(replay_data.actions).mul_(self.target_policy_noise)
        noise.clamp_(-self.target_noise_clip, self.target_noise_clip)
        return noise.add_(self.actor_target(replay_data.next_observations)).clamp_(-1, 1)

    def make_target(self, next_quantiles: th.Tensor, replay_data: ReplayBufferSamples, lam: float) -> Target:
        """
        Return the λ-LCB target (Eq. 4–7).

        :param next_quantiles: (B, C, N), of the target critics at (s', ã)
        """
        discounts = discounts_of(replay_data, self.gamma)
        return lcb_target(next_quantiles, replay_data.rewards, replay_data.dones, discounts, lam)

    def update_actor(self, replay_data: ReplayBufferSamples) -> None:
        """Take one step of the actor (Eq. 11–13), then of the temperature."""
        if self.stochastic_actor:
            actions, log_prob = self.actor.action_log_prob(replay_data.observations)  # type: ignore[operator]
            ent_coef = self.current_ent_coef()
            q_values = self.critic.q1_forward(replay_data.observations, actions)  # Eq. 11
            actor_loss = (ent_coef * log_prob.unsqueeze(1) - q_values).mean()  # Eq. 13
            self._minimize(actor_loss, self.actor.optimizer)  # type: ignore[arg-type]
            self.update_temperature(log_prob.detach(), ent_coef, actor_loss.detach())
        else:
            actions = self.actor(replay_data.observations)
            actor_loss = -self.critic.q1_forward(replay_data.observations, actions).mean()  # Eq. 11–12
            self._minimize(actor_loss, self.actor.optimizer)  # type: ignore[arg-type]
            self.diagnose(actor_loss=actor_loss.detach())

    def update_temperature(self, log_prob: th.Tensor, ent_coef: th.Tensor, actor_loss: th.Tensor) -> None:
        """
        Take one step of the temperature, if it is learned (Eq. 14).

        :param log_prob: (B,), log π of the actions in the actor's update
        :param ent_coef: (1,), α of the actor's update
        :param actor_loss: scalar, for the log
        """
        entropy = -log_prob.mean()
        self.diagnose(actor_loss=actor_loss, entropy=entropy, ent_coef=ent_coef.squeeze())
        if self._learns_ent_coef:
            loss = self.log_ent_coef * (entropy - self._current_target_entropy())
            self._minimize(loss, self.ent_coef_optimizer)
            self.diagnose(ent_coef_loss=loss.detach().squeeze())

    def current_ent_coef(self) -> th.Tensor:
        """Return α, (1,)."""
        return self.log_ent_coef.detach().exp() if self._learns_ent_coef else self.ent_coef_tensor

    @property
    def _learns_ent_coef(self) -> bool:
        return self.ent_coef_optimizer is not None

    def _current_target_entropy(self) -> float:
        if self.target_entropy == "auto":
            return -float(np.prod(self.action_space.shape))  # type: ignore[arg-type]
        return check_number('target_entropy (if not "auto")', self.target_entropy)

    @th.no_grad()
    def update_targets(self) -> None:
        """Move the target critics and the target actor by Polyak averaging (Eq. 16)."""
        online, target = (self.critic, self.actor), (self.critic_target, self.actor_target)
        th._foreach_lerp_(_parameters(target), _parameters(online), self.tau)
        for of_online, of_target in zip(online, target, strict=True):  # the running statistics of batch norm
            pairs = (get_parameters_by_name(network, ["running_"]) for network in (of_target, of_online))
            for statistic, source in zip(*pairs, strict=True):
                statistic.copy_(source)

    # ---------------------------------------------------------------- optimizers

    @staticmethod
    def _minimize(output: th.Tensor, optimizer: th.optim.Optimizer, grad_output: th.Tensor | None = None) -> None:
        """Take one step on a loss: the output itself, or the loss with the gradient ``grad_output`` at the output."""
        parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
        learning = [parameter for parameter in parameters if parameter.requires_grad]
        for parameter in parameters:
            parameter.grad = None
        # Only the gradients of these parameters: others stay as they are, and cost nothing
        if learning:
            output.backward(grad_output, inputs=learning)
        optimizer.step()

    def _optimizers(self) -> list[th.optim.Optimizer]:
        of_temperature = [self.ent_coef_optimizer] if self._learns_ent_coef else []
        return [self.actor.optimizer, self.critic.optimizer, *of_temperature]

    def _schedule_of(self, optimizer: th.optim.Optimizer) -> str:
        return "qf_learning_rate" if optimizer is self.critic.optimizer else super()._schedule_of(optimizer)

    def _flush_moments(self) -> None:
        """Set those moments of Adam to zero that are about to become denormal numbers."""
        for state in (state for optimizer in self._optimizers() for state in optimizer.state.values()):
            for moment in (state[name] for name in ("exp_avg", "exp_avg_sq") if name in state):
                moment.masked_fill_(moment.abs() < SMALLEST_MOMENT, 0)

    # ---------------------------------------------------------------- learn

    def learn(
        self: SelfTDC,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "TDC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfTDC:
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)

    # ---------------------------------------------------------------- logging

    @property
    def diagnoses_critics(self) -> bool:
        """Return whether the critics' diagnostics are computed at this update."""
        return self._n_updates % DIAGNOSTICS_INTERVAL == 1

    @property
    def diagnoses_units(self) -> bool:
        """Return whether dormant units are counted after this update."""
        return self._n_updates % UNITS_INTERVAL == 0

    def diagnose_critics(self, current: th.Tensor, target: Target) -> None:
        """
        Add the critics' diagnostics to the log.

        :param current: (B, C, N), quantiles of the critics
        :param target: the target of the same minibatch
        """
        self.diagnose(**describe_critics(current, target, self.kappa))

    def diagnose_units(self, observations: Any) -> None:
        """
        Add the shares of dormant units to the log.

        :param observations: those of a minibatch
        """
        self.diagnose(**describe_units(self, observations))

    # ---------------------------------------------------------------- saving

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        self._renew_temperature()
        super().save(path, exclude, include)

    @classmethod
    def load(
        cls: type[SelfTDC],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfTDC:
        """
        Load the model from a zip-file, as SB3 does.

        :param path: path to the file (or a file-like) to load from
        :param env: the environment to train on; None if only predictions are needed
        :param device: device on which the code should run
        :param custom_objects: objects that replace those in the file, by name
        :param print_system_info: whether to print the system information of the saved model and of the current system
        :param force_reset: whether to reset the environment before training
        :param kwargs: attributes that override the file's; an ``ent_coef`` that differs from the file's also replaces
            its temperature
        """
        given = {**(custom_objects or {}), **kwargs}
        custom_objects, kwargs = (
            {name: value for name, value in objects.items() if name != "ent_coef"}
            for objects in (custom_objects or {}, kwargs)
        )
        model = super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)
        if "ent_coef" in given:
            model.ent_coef = given["ent_coef"]
            model._renew_temperature()
        return model

    def _non_finite_weights(self) -> list[str]:
        # α may be infinite where log α is not
        temperature_diverged = self._learns_ent_coef and not self.current_ent_coef().isfinite()
        return [*super()._non_finite_weights(), *(["ent_coef"] if temperature_diverged else [])]

    def _excluded_save_params(self) -> list[str]:
        networks = ["actor", "actor_target", "critic", "critic_target"]
        return [*super()._excluded_save_params(), *networks, "_built_ent_coef"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts = ["policy", "actor.optimizer", "critic.optimizer"]
        if not self.stochastic_actor:
            return state_dicts, []
        if self.ent_coef_optimizer is None:
            return state_dicts, ["ent_coef_tensor"]
        return [*state_dicts, "ent_coef_optimizer"], ["log_ent_coef"]


def _parameters(networks: tuple[nn.Module, ...]) -> list[th.Tensor]:
    """Return the parameters of networks without duplicates: actor and critics may share a features extractor."""
    return list({id(parameter): parameter for network in networks for parameter in network.parameters()}.values())
