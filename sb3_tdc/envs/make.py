"""From an environment id and hyperparameters to vectorised, wrapped, seeded environments."""

import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack, VecMonitor, VecNormalize

from sb3_tdc.common.exceptions import describe_exception
from sb3_tdc.envs.checked import CheckedEnv, CheckedSubprocVecEnv, EnvironmentFaultError
from sb3_tdc.envs.mujoco import print_warnings_once
from sb3_tdc.envs.processes import ignore_signals
from sb3_tdc.envs.registry import has_vector_env, simulator_of
from sb3_tdc.envs.vector import GymnasiumVecEnv
from sb3_tdc.hyperparams import Hyperparams
from sb3_tdc.resume import Restorable
from sb3_tdc.safe_load import load_normalization

# Errors that constructors of environments, wrappers, algorithms and callbacks raise for arguments they do not allow
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
    Make the environments of a run, with the wrappers of its hyperparameters.

    :param env_kwargs: keyword arguments of the environment's constructor; override those of the hyperparameters
    :param vec_env: "dummy" (one process), "subproc" (one process each), or "gymnasium" (``gymnasium.make_vec``)
    :param monitor_folder: folder of the files ``*.monitor.csv``
    :param normalization: saved statistics for ``VecNormalize``; its options are those of the hyperparameters
    :param training: if False, the statistics do not change and rewards are not normalised
    :param trust: whether the saved statistics may run code, as in ``VecNormalize.load``
    :raises ValueError: if the saved statistics are of other observations than those that are to be normalised
    """
    kwargs = {**hyperparams.env_kwargs, **(env_kwargs or {})}
    env = _make(_Wanted(env_id, hyperparams, seed, n_envs, kwargs, vec_env, monitor_folder))
    for wrapper in hyperparams.vec_env_wrapper:
        env = wrapper(env)
    if hyperparams.frame_stack is not None:  # inside VecNormalize, whose input the replay buffer stores
        env = VecFrameStack(env, hyperparams.frame_stack)
    if hyperparams.normalize is not None:
        inner, env = env, VecNormalize(env, **hyperparams.normalize)
        if normalization is not None:
            load = VecNormalize.load if trust else load_normalization
            _take_statistics(env, load(str(normalization), inner), normalization)
        if not training:
            env.training, env.norm_reward = False, False
    return env


def _take_statistics(env: VecNormalize, saved: VecNormalize, path: Path) -> None:
    for name in ("norm_obs", "norm_obs_keys"):
        now, then = getattr(env, name), getattr(saved, name)
        if now != then:
            raise ValueError(f"normalize: {name} must be {then!r}, as in {path}, got {now!r}")
    env.ret_rms = saved.ret_rms
    if env.norm_obs:
        env.obs_rms = saved.obs_rms


@dataclass(frozen=True)
class _Wanted:
    """The arguments of :func:`make_envs` that single environments depend on."""

    env_id: str
    hyperparams: Hyperparams
    seed: int
    n_envs: int
    env_kwargs: dict[str, Any]
    vec_env: str
    monitor_folder: Path | None

    def require_no_wrappers(self) -> None:
        if self.hyperparams.env_wrapper:
            raise ValueError(f"{self.env_id} is vectorised by itself: env_wrapper cannot wrap its single environments")

    def monitored(self, env: VecEnv) -> VecEnv:
        file = str(self.monitor_folder / "0") if self.monitor_folder is not None else None
        return VecMonitor(env, file, tuple(self.hyperparams.monitor_kwargs.get("info_keywords", ())))


def _make(wanted: _Wanted) -> VecEnv:
    make_vec = simulator_of(wanted.env_id).make_vec
    if make_vec is None:
        return _make_gymnasium(wanted) if wanted.vec_env == "gymnasium" else _make_sb3(wanted)
    if wanted.vec_env != "dummy":
        raise ValueError(
            f"{wanted.env_id} steps all environments in one simulation: leave out --vec-env {wanted.vec_env}"
        )
    wanted.require_no_wrappers()
    return wanted.monitored(make_vec(wanted.env_id, wanted.n_envs, wanted.seed, wanted.env_kwargs))


def _make_sb3(wanted: _Wanted) -> VecEnv:
    if gym.spec(wanted.env_id).entry_point is None:
        raise ValueError(f"{wanted.env_id} is a vector environment: add --vec-env gymnasium")
    is_subproc = wanted.vec_env == "subproc"
    return make_vec_env(
        _maker(wanted.env_id, wanted.hyperparams, ignores_signals=is_subproc),
        n_envs=wanted.n_envs,
        seed=wanted.seed,
        monitor_dir=str(wanted.monitor_folder) if wanted.monitor_folder else None,
        monitor_kwargs=wanted.hyperparams.monitor_kwargs,
        env_kwargs=wanted.env_kwargs,
        vec_env_cls=CheckedSubprocVecEnv if is_subproc else DummyVecEnv,
        wrapper_class=Restorable if is_subproc else None,
    )


def _make_gymnasium(wanted: _Wanted) -> VecEnv:
    """Make the vector environment that is registered for an id, or else single environments stepped in turn."""
    if not hasattr(gym.vector, "AutoresetMode"):
        raise ValueError(f"--vec-env gymnasium needs Gymnasium 1.1 or newer: this is {gym.__version__}")
    print_warnings_once()
    if has_vector_env(wanted.env_id):
        wanted.require_no_wrappers()
        vector = gym.make_vec(wanted.env_id, num_envs=wanted.n_envs, **wanted.env_kwargs)
    else:
        single = _maker(wanted.env_id, wanted.hyperparams, ignores_signals=False)
        makers = [lambda: single(**wanted.env_kwargs)] * wanted.n_envs
        vector = gym.vector.SyncVectorEnv(makers, autoreset_mode="SameStep")
    env = GymnasiumVecEnv(vector)
    env.seed(wanted.seed)
    return wanted.monitored(env)


def _maker(env_id: str, hyperparams: Hyperparams, ignores_signals: bool) -> Any:
    """Return a function that makes one environment, possibly in a new process. The caller adds a monitor around it."""
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
