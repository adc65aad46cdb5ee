"""From an environment id and hyperparameters to vectorised, wrapped, seeded environments."""

import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack, VecMonitor, VecNormalize

from sb3_tdc.envs.checked import CheckedEnv, CheckedSubprocVecEnv, EnvironmentFaultError, describe_exception
from sb3_tdc.envs.mujoco import print_warnings_once
from sb3_tdc.envs.processes import ignore_signals
from sb3_tdc.envs.registry import simulator_of
from sb3_tdc.envs.vector import GymnasiumVecEnv
from sb3_tdc.hyperparams import Hyperparams
from sb3_tdc.resume import Restorable
from sb3_tdc.safe_load import load_normalization

# What constructors of environments, wrappers, algorithms and callbacks raise for what they do not allow
SETUP_ERRORS = (ValueError, AssertionError, TypeError, RuntimeError, ImportError, OSError, EOFError, gym.error.Error)


def make_envs(
    env_id: str,
    hyperparams: Hyperparams,
    seed: int,
    n_envs: int,
    env_kwargs: dict[str, Any] | None = None,
    vec_env: str = "dummy",
    monitor_folder: Path | None = None,
    normalization: Path | None = None,
    training: bool = True,
    trust: bool = False,
) -> VecEnv:
    """
    Make the environments of a run, wrapped as its hyperparameters say.

    :param env_kwargs: of the environment's constructor, over those of the hyperparameters
    :param vec_env: "dummy" (one process), "subproc", or "gymnasium" (what ``gymnasium.make_vec`` makes)
    :param monitor_folder: for ``*.monitor.csv``
    :param normalization: saved statistics for ``VecNormalize``
    :param training: False: statistics stay as they are and rewards are not normalised
    :param trust: whether the saved statistics may run code, as in ``VecNormalize.load``
    """
    make = _how_to_make(env_id, vec_env)
    kwargs = {**hyperparams.env_kwargs, **(env_kwargs or {})}
    env = make(env_id, hyperparams, seed, n_envs, kwargs, monitor_folder, vec_env == "subproc")
    for wrapper in hyperparams.vec_env_wrapper:
        env = wrapper(env)
    if hyperparams.frame_stack is not None:  # before normalising: replay stores what VecNormalize was given
        env = VecFrameStack(env, hyperparams.frame_stack)
    if hyperparams.normalize is not None:
        if normalization is not None:
            env = VecNormalize.load(str(normalization), env) if trust else load_normalization(normalization, env)
        else:
            env = VecNormalize(env, **hyperparams.normalize)
        if not training:
            env.training, env.norm_reward = False, False
    return env


def _how_to_make(env_id: str, vec_env: str) -> Callable[..., VecEnv]:
    if simulator_of(env_id).make_vec is None:
        return _make_gymnasium if vec_env == "gymnasium" else _make_sb3
    if vec_env != "dummy":
        raise ValueError(f"{env_id} steps all environments in one simulation: leave out --vec-env {vec_env}")
    return _make_at_once


def _make_at_once(
    env_id: str,
    hyperparams: Hyperparams,
    seed: int,
    n_envs: int,
    env_kwargs: dict[str, Any],
    monitor_folder: Path | None,
    is_subproc: bool,
) -> VecEnv:
    make_vec = simulator_of(env_id).make_vec
    assert make_vec is not None
    _require_no_wrappers(env_id, hyperparams)
    return _monitored(make_vec(env_id, n_envs, seed, env_kwargs), hyperparams, monitor_folder)


def _require_no_wrappers(env_id: str, hyperparams: Hyperparams) -> None:
    if hyperparams.env_wrapper:
        raise ValueError(f"{env_id} is vectorised by itself: env_wrapper cannot wrap its single environments")


def _monitored(env: VecEnv, hyperparams: Hyperparams, monitor_folder: Path | None) -> VecEnv:
    file = str(monitor_folder / "0") if monitor_folder is not None else None
    return VecMonitor(env, file, tuple(hyperparams.monitor_kwargs.get("info_keywords", ())))


def _make_sb3(
    env_id: str,
    hyperparams: Hyperparams,
    seed: int,
    n_envs: int,
    env_kwargs: dict[str, Any],
    monitor_folder: Path | None,
    is_subproc: bool,
) -> VecEnv:
    return make_vec_env(
        _maker(env_id, hyperparams, ignores_signals=is_subproc),
        n_envs=n_envs,
        seed=seed,
        monitor_dir=str(monitor_folder) if monitor_folder else None,
        monitor_kwargs=hyperparams.monitor_kwargs,
        env_kwargs=env_kwargs,
        vec_env_cls=CheckedSubprocVecEnv if is_subproc else DummyVecEnv,
        wrapper_class=Restorable if is_subproc else None,
    )


def _make_gymnasium(
    env_id: str,
    hyperparams: Hyperparams,
    seed: int,
    n_envs: int,
    env_kwargs: dict[str, Any],
    monitor_folder: Path | None,
    is_subproc: bool,
) -> VecEnv:
    """Make the vector environment that is registered for an id, or else single ones stepped in turn."""
    spec = gym.spec(env_id)
    print_warnings_once()
    if spec.vector_entry_point is not None:
        _require_no_wrappers(env_id, hyperparams)
        vector = gym.make_vec(env_id, num_envs=n_envs, **env_kwargs)
    else:
        single = _maker(env_id, hyperparams, ignores_signals=False)
        vector = gym.vector.SyncVectorEnv([lambda: single(**env_kwargs)] * n_envs, autoreset_mode="SameStep")
    env = GymnasiumVecEnv(vector)
    env.seed(seed)
    return _monitored(env, hyperparams, monitor_folder)


def _maker(env_id: str, hyperparams: Hyperparams, ignores_signals: bool) -> Any:
    """Return what makes one environment, perhaps in a process of its own. Its ``Monitor`` will be the outermost."""
    spec, simulator = gym.spec(env_id), simulator_of(env_id)

    def make_env(**kwargs: Any) -> gym.Env:
        if ignores_signals:
            ignore_signals()
        try:
            print_warnings_once()
            env = simulator.make(spec, kwargs)
            for wrapper in hyperparams.env_wrapper:
                env = wrapper(env)
            return CheckedEnv(env)
        except Exception as error:
            reason = describe_exception(error)
            raise EnvironmentFaultError(f"{env_id} cannot be made: {reason}", traceback.format_exc()) from error

    return make_env
