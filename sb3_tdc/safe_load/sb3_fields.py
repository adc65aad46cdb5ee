"""
The fields that SB3 saves: those of every off-policy algorithm, and those of SB3's own algorithms and sb3-contrib's TQC.

These classes are not part of this package, so they cannot declare ``saved_fields``.
"""

from typing import Any

from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import TrainFreq

from sb3_tdc.common.saved_fields import (
    Check,
    SavedField,
    boolean,
    integer,
    none,
    number,
    or_none,
    schedule,
    text_or_number,
)
from sb3_tdc.common.untrusted import shown
from sb3_tdc.safe_load.reading import is_plain

MAX_ENVS = 65_536
MAX_CRITICS = 256  # all critics are built before their weights are compared


def _instance(*kinds: type) -> Check:
    def check(name: str, value: Any) -> Any:
        if isinstance(value, bool) or not isinstance(value, kinds):
            raise ValueError(f"{name} must be a {' or '.join(k.__name__ for k in kinds)}, got {shown(value)}")
        return value

    return check


def _subclass(base: type) -> Check:
    def check(name: str, value: Any) -> Any:
        if not isinstance(value, type) or not issubclass(value, base):
            raise ValueError(f"{name} must be a {base.__name__} class, got {shown(value)}")
        return value

    return check


def _noise(name: str, value: Any) -> Any:
    return value if isinstance(value, ActionNoise) else number(0.0)(name, value)


def _train_freq(name: str, value: Any) -> Any:
    if isinstance(value, TrainFreq):
        return value
    if isinstance(value, list) and len(value) == 2 and value[1] in ("step", "episode"):
        return (integer(1)(name, value[0]), value[1])
    return integer(1)(name, value)


def _arguments(name: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value) or not is_plain(value):
        raise ValueError(f"{name} must be a mapping of names to finite numbers, texts and known classes")
    return value


def _required(**checks: Check) -> dict[str, SavedField]:
    return {name: SavedField(check) for name, check in checks.items()}


def _optional(**checks: Check) -> dict[str, SavedField]:
    return {name: SavedField(check, is_required=False) for name, check in checks.items()}


# Fields of every off-policy algorithm
OFF_POLICY = {
    **_required(
        policy_class=_subclass(BasePolicy),
        learning_rate=schedule,
        gamma=number(0.0, 1.0),
        tau=number(maximum=1.0, above=0.0),
        batch_size=integer(1),
        buffer_size=integer(1),
        learning_starts=integer(0),
        train_freq=_train_freq,
        gradient_steps=integer(-1),
        num_timesteps=integer(0),
        _n_updates=integer(0),
        _episode_num=integer(0),
        seed=or_none(integer(0)),
        action_noise=or_none(_noise),
        use_sde=boolean,
        optimize_memory_usage=boolean,
        replay_buffer_kwargs=_arguments,
    ),
    **_optional(
        replay_buffer_class=or_none(_subclass(ReplayBuffer)),
        policy_kwargs=_arguments,
        observation_space=_instance(spaces.Space),
        action_space=_instance(spaces.Box),
        n_envs=integer(1, MAX_ENVS),
        n_steps=integer(1),
        verbose=integer(0, 2),
        use_sde_at_warmup=boolean,
        sde_sample_freq=integer(-1),
        remove_time_limit_termination=boolean,
        _total_timesteps=integer(0),
        _num_timesteps_at_start=integer(0),
        _stats_window_size=integer(0),
        _current_progress_remaining=number(maximum=1.0),  # below 0 if a rollout ends long after the last step
    ),
}
_N_CRITICS = {"policy_kwargs.n_critics": SavedField(integer(1, MAX_CRITICS), is_required=False)}
# log_ent_coef, ent_coef_optimizer and ent_coef_tensor are null: a temperature is a tensor, in another entry
_SAC = {
    **_required(ent_coef=text_or_number, target_entropy=or_none(text_or_number), target_update_interval=integer(1)),
    **_optional(log_ent_coef=none, ent_coef_optimizer=none, ent_coef_tensor=none),
    **_N_CRITICS,
}
# Fields of each algorithm, by the full name of its class
OF_SB3: dict[str, dict[str, SavedField]] = {
    "stable_baselines3.td3.td3.TD3": {
        **_required(policy_delay=integer(1), target_policy_noise=number(0.0), target_noise_clip=number(0.0)),
        **_N_CRITICS,
    },
    "stable_baselines3.sac.sac.SAC": _SAC,
    "sb3_contrib.tqc.tqc.TQC": {**_SAC, **_required(top_quantiles_to_drop_per_net=integer(0))},
}
