"""
Small runs that are stopped and resumed, and fingerprints of everything that they leave.

``python -m tests.tools.runs {whole,stopped,resumed} FOLDER CASE...`` runs cases in a separate process.
"""

import hashlib
import json
import multiprocessing
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from sb3_contrib import TQC
from stable_baselines3 import SAC, TD3, HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecNormalize
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_tdc import MEOW, TDC
from sb3_tdc.ablations import calibration
from sb3_tdc.advb import AdvBSAC, AdvBTD3, AdvBTDC, BoardCallback
from sb3_tdc.envs.registry import require_env, simulator_of
from sb3_tdc.resume import Restorable, ResumeCallback

STEPS = 300
MUJOCO = ("HalfCheetah-v4", "Hopper-v4", "Walker2d-v4", "Ant-v4", "Humanoid-v4")
# Fields that depend on the wall clock
_TIMES = ("t", "time/fps", "time/time_elapsed", "time/critics_elapsed")


class Reach(gym.Env):
    """A point that has to reach a goal: a custom environment, with its state in Python objects."""

    def __init__(self):
        box = gym.spaces.Box(-1, 1, (2,), np.float64)
        keys = ("observation", "achieved_goal", "desired_goal")
        self.observation_space = gym.spaces.Dict(dict.fromkeys(keys, box))
        self.action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def _observe(self):
        return {"observation": self.position.copy(), "achieved_goal": self.position.copy(), "desired_goal": self.goal}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position, self.goal, self.steps = np.zeros(2), self.np_random.uniform(-1, 1, 2), 0
        return self._observe(), {}

    def step(self, action):
        self.steps += 1
        self.position = np.clip(self.position + 0.1 * action + 0.01 * self.np_random.normal(size=2), -1, 1)
        info = {"steps": self.steps, "is_success": bool(self.steps % 3)}
        reward = float(self.compute_reward(self.position, self.goal, info))
        return self._observe(), reward, False, self.steps == 30, info

    def compute_reward(self, achieved_goal, desired_goal, info):
        return -np.linalg.norm(achieved_goal - desired_goal, axis=-1)


def bullet(env_id: str) -> Callable[..., gym.Env]:
    """Return a function that makes one of PyBullet's tasks, as a run does."""

    def make(**env_kwargs):
        require_env(env_id)
        return simulator_of(env_id).make(gym.spec(env_id), env_kwargs)

    return make


@dataclass
class Case:
    """
    One small run.

    :param wrap: wraps the vectorised environment
    """

    env: Any = "Pendulum-v1"
    algorithm: Any = TDC
    n_envs: int = 1
    vec_env: type = DummyVecEnv
    wrap: Callable | None = None
    wrapper_class: Any = None
    env_kwargs: dict[str, Any] = field(default_factory=lambda: {"max_episode_steps": 90})
    policy: str = "MlpPolicy"
    kwargs: dict[str, Any] = field(default_factory=dict)
    steps: int = STEPS


def _make_case(env: str, n_envs: int, vec_env: type, stochastic: bool) -> Case:
    wrapper_class = Restorable if vec_env is SubprocVecEnv else None
    kwargs = {"stochastic_actor": stochastic}
    return Case(env, TDC, n_envs, vec_env, wrapper_class=wrapper_class, kwargs=kwargs)


# {HalfCheetah, Hopper, Walker2d, Ant, Humanoid} × {one, two} × {in this process, in subprocesses} × both heads
CROSS = {
    f"{env}-{'subproc' if vec_env is SubprocVecEnv else 'dummy'}{n_envs}-{'gaussian' if stochastic else 'plain'}":
    _make_case(env, n_envs, vec_env, stochastic)
    for env in MUJOCO
    for n_envs, vec_env in ((1, DummyVecEnv), (2, DummyVecEnv), (1, SubprocVecEnv), (2, SubprocVecEnv))
    for stochastic in (False, True)
}  # fmt: skip

_HER = {"replay_buffer_class": HerReplayBuffer, "learning_starts": 70}
OTHERS = {
    "readable update": Case("Hopper-v4", kwargs={"fused": False}),
    "VecNormalize": Case("Hopper-v4", n_envs=2, wrap=lambda env: VecNormalize(VecFrameStack(env, 2))),
    "ring overwritten": Case("Walker2d-v4", kwargs={"buffer_size": 150}),
    "ring overwritten, two environments": Case(n_envs=2, kwargs={"buffer_size": 90}),
    "n-step": Case("Hopper-v4", kwargs={"n_steps": 3, "buffer_size": 230}),
    "small memory": Case(
        "Hopper-v4",
        kwargs={
            "optimize_memory_usage": True,
            "replay_buffer_kwargs": {"handle_timeout_termination": False},
            "buffer_size": 130,
        },
    ),
    "HER": Case(Reach, policy="MultiInputPolicy", n_envs=2, env_kwargs={}, kwargs={**_HER, "buffer_size": 300}),
    "HER with infos": Case(
        Reach,
        policy="MultiInputPolicy",
        env_kwargs={},
        kwargs={**_HER, "replay_buffer_kwargs": {"copy_info_dict": True}},
    ),
    "schedules, train_freq": Case(
        kwargs={
            "lam": LinearSchedule(1, 0, 1),
            "learning_rate": lambda left: 1e-3 * max(left, 0),
            "train_freq": (7, "step"),
        }
    ),
    "episodes": Case("Hopper-v4", kwargs={"train_freq": (2, "episode"), "gradient_steps": -1}),
    "OU noise": Case(
        n_envs=2,
        kwargs={"action_noise": OrnsteinUhlenbeckActionNoise(np.zeros(1), 0.3 * np.ones(1), initial_noise=np.ones(1))},
    ),
    "TD3": Case("Hopper-v4", TD3),
    "SAC": Case("Hopper-v4", SAC),
    "MEOW": Case("Hopper-v4", MEOW),
    "MEOW, n-step, schedule": Case(
        "Hopper-v4",
        MEOW,
        n_envs=2,
        wrap=VecNormalize,
        kwargs={"n_steps": 3, "learning_rate": LinearSchedule(1e-3, 0, 1), "policy_kwargs": {"dropout": 0.3}},
    ),
    "AdvB-TD3": Case("Hopper-v4", AdvBTD3, kwargs={"formation_period": 3}),
    "AdvB-SAC": Case("Hopper-v4", AdvBSAC, n_envs=2, wrap=VecNormalize),
    "calibrated λ": Case(
        "Hopper-v4", calibration.CalibratedTDC, n_envs=2, kwargs={"lam": 0.5, "gamma": 0.5, "tau": 1.0}
    ),
    "AdvB-TDC": Case("Hopper-v4", AdvBTDC, kwargs={"formation_period": 2, "lam": LinearSchedule(1.0, 0, 1)}),
    "SAC, gSDE": Case("Hopper-v4", SAC, n_envs=2, kwargs={"use_sde": True, "sde_sample_freq": 4}),
    "TQC, gSDE": Case("Hopper-v4", TQC, kwargs={"use_sde": True}),
    "Ant-v5": Case("Ant-v5"),
    "wrappers": Case(
        "Hopper-v4",
        env_kwargs={"max_episode_steps": 60},
        wrapper_class=lambda env: gym.wrappers.NormalizeReward(gym.wrappers.DelayObservation(env, 2)),
    ),
}
BULLET = (
    "HalfCheetah",
    "Hopper",
    "Ant",
    "Humanoid",
    "Walker2D",
    "InvertedPendulum",
    "InvertedDoublePendulum",
    "Reacher",
    "Pusher",
)
PYBULLET = {
    f"{name}BulletEnv-{n_envs}": Case(
        bullet(f"{name}BulletEnv-v0"), n_envs=n_envs, vec_env=vec_env, wrapper_class=wrapper_class
    )
    for name in BULLET
    for n_envs, vec_env, wrapper_class in ((1, DummyVecEnv, None), (2, SubprocVecEnv, Restorable))
}
CASES = {**CROSS, **OTHERS, **PYBULLET}


class Trace(BaseCallback):
    """Digests every transition into a list that grows, as callbacks of users have."""

    def __init__(self):
        super().__init__()
        self.digests: list[str] = []

    def _on_step(self):
        parts = [self.locals[name] for name in ("actions", "buffer_actions", "new_obs", "rewards", "dones")]
        self.digests.append(digest(parts))
        return True


class Stop(Exception):  # noqa: N818
    """Ends a run as suddenly as a kill, but the process stays for the next case."""


class StopAt(BaseCallback):
    """
    Stops a run in the middle of a step.

    :param step: the timestep to stop at; None for no stop
    """

    is_captured = False

    def __init__(self, step: int | None):
        super().__init__()
        self.step = step

    def _on_step(self):
        if self.step is not None and self.num_timesteps >= self.step:
            raise Stop
        return True


def digest(value: Any) -> str:
    """Return a hash of the bits of arrays, tensors and plain values, in any nesting."""
    hashed = hashlib.sha256()

    def add(item: Any) -> None:
        if isinstance(item, dict):
            for key in (key for key in item if key not in _TIMES):
                hashed.update(repr(key).encode())
                add(item[key])
        elif isinstance(item, (list, tuple)):
            for part in item:
                add(part)
        elif isinstance(item, th.Tensor):
            add(item.detach().numpy())
        elif isinstance(item, np.ndarray) and item.dtype != object:
            hashed.update(str((item.dtype, item.shape)).encode() + np.ascontiguousarray(item).tobytes())
        elif isinstance(item, np.ndarray):
            add(item.tolist())
        else:
            hashed.update(repr(item).encode())

    add(value)
    return hashed.hexdigest()


def _wrap(case: Case, env: Any) -> Any:
    return env if case.wrap is None else case.wrap(env)


def make_model(case: Case, folder: Path) -> Any:
    """Return the model of a case, with its environments and its logger."""
    env = make_vec_env(
        case.env,
        case.n_envs,
        seed=3,
        monitor_dir=str(folder),
        env_kwargs=case.env_kwargs,
        vec_env_cls=case.vec_env,
        wrapper_class=case.wrapper_class,
    )
    net_arch: dict[str, Any] = {"net_arch": [8, 8]}
    if issubclass(case.algorithm, TDC):
        net_arch["n_quantiles"] = 5
    defaults = {"learning_starts": 50, "batch_size": 16, "buffer_size": 1000, "policy_kwargs": net_arch}
    kwargs = {**defaults, **case.kwargs}
    model = case.algorithm(case.policy, _wrap(case, env), seed=5, device="cpu", **kwargs)
    model.set_logger(configure(str(folder), ["csv", "tensorboard"]))
    return model


def make_callbacks(case: Case, folder: Path, stop_at: int | None) -> list[BaseCallback]:
    """Return callbacks: resume states, the trace, an evaluation, a board where there is one, and the stop."""
    eval_env = _wrap(case, make_vec_env(case.env, 1, seed=4, env_kwargs=case.env_kwargs))
    if isinstance(eval_env, VecNormalize):
        eval_env.training = False
    evaluation = EvalCallback(
        eval_env,
        n_eval_episodes=1,
        eval_freq=max(110 // case.n_envs, 1),
        log_path=str(folder),
        best_model_save_path=str(folder),
        verbose=0,
        warn=False,
    )
    board = []
    if case.algorithm in (AdvBTD3, AdvBSAC, AdvBTDC):
        eval_env = _wrap(case, make_vec_env(case.env, 1, seed=6, env_kwargs=case.env_kwargs))
        board = [BoardCallback(eval_env)]
    return [ResumeCallback(folder / "resume", freq=40, verbose=0), Trace(), evaluation, *board, StopAt(stop_at)]


def run(case: Case, folder: Path, stop_at: int | None = None) -> dict[str, Any]:
    """Run a case, and return its fingerprints; none if it was stopped."""
    folder.mkdir(parents=True, exist_ok=True)
    model = make_model(case, folder)
    callbacks = make_callbacks(case, folder, stop_at)
    callbacks[0].select(model)
    try:
        model.learn(case.steps, callback=callbacks, log_interval=1)
    except Stop:
        return {}
    finally:
        callbacks[0].store.close()
        model.logger.close()
        model.env.close()
    return fingerprints(model, callbacks[1], callbacks[2], folder)


def fingerprints(model: Any, trace: Trace, evaluation: EvalCallback, folder: Path) -> dict[str, Any]:
    """Return fingerprints of everything that must not differ, by name."""
    state_dicts, tensors = model._get_torch_save_params()
    found: dict[str, Any] = {"transitions": digest(trace.digests), "number of transitions": len(trace.digests)}
    for name in state_dicts:
        found[name] = digest(_attribute(model, name).state_dict())
    for name in tensors:
        found[name] = digest(_attribute(model, name))
    for name, value in vars(model.replay_buffer).items():
        if isinstance(value, (np.ndarray, dict, int, bool)):
            found[f"replay_buffer.{name}"] = digest(value)
    for name in ("_n_updates", "_episode_num", "num_timesteps", "_last_obs", "_last_original_obs"):
        found[name] = digest(getattr(model, name))
    if isinstance(model.env, VecNormalize):
        statistics = [model.env.obs_rms.mean, model.env.obs_rms.var, model.env.ret_rms.var, model.env.returns]
        found["VecNormalize"] = digest(statistics)
    found["numpy"] = digest(list(np.random.get_state()))
    found["torch"] = digest(th.get_rng_state())
    found["spaces"] = digest([model.action_space.sample(), model.action_space.np_random.bit_generator.state])
    found["evaluations"] = digest([evaluation.evaluations_results, evaluation.evaluations_timesteps])
    found["evaluation's counters"] = digest([evaluation.n_calls, evaluation.best_mean_reward])
    found.update(files(folder))
    return found


def _attribute(model: Any, name: str) -> Any:
    for part in name.split("."):
        model = getattr(model, part)
    return model


def files(folder: Path) -> dict[str, Any]:
    """Return the contents of the run's logs and evaluations, except what depends on the wall clock."""
    found: dict[str, Any] = {}
    for path in sorted(folder.glob("*.csv")):
        lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
        header = lines[0].split(",")
        rows = [dict(zip(header, line.split(","), strict=True)) for line in lines[1:]]
        found[path.name] = [sorted((k, v) for k, v in row.items() if k not in _TIMES) for row in rows]
    with np.load(folder / "evaluations.npz") as evaluations:
        found["evaluations.npz"] = digest({name: evaluations[name] for name in sorted(evaluations.files)})
    best = th.load(_member(folder / "best_model.zip", "policy.pth"), weights_only=True)
    found["best_model"] = digest(best)
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0}).Reload()
    for tag in sorted(set(events.Tags()["scalars"]) - set(_TIMES)):
        found[f"TensorBoard {tag}"] = [[event.step, event.value] for event in events.Scalars(tag)]
    return found


def _member(path: Path, name: str) -> Any:
    import io
    import zipfile

    with zipfile.ZipFile(path) as archive:
        return io.BytesIO(archive.read(name))


def stopping_step(name: str, steps: int) -> int:
    """Return a step that looks random, after the first state with a weight update and before the last."""
    return 90 + int(hashlib.sha256(name.encode()).hexdigest(), 16) % (steps - 100)


def main(mode: str, folder: Path, names: list[str]) -> None:
    """Write the fingerprints of the cases to ``FOLDER/<mode>.json``."""
    th.set_num_threads(1)
    results = {}
    for name in names:
        case, place = CASES[name], folder / ("whole" if mode == "whole" else "resumed") / name
        results[name] = run(case, place, stopping_step(name, case.steps) if mode == "stopped" else None)
    (folder / f"{mode}.json").write_text(json.dumps(results))


if __name__ == "__main__":
    multiprocessing.set_forkserver_preload(["tests.tools.runs"])  # imported once for all processes of environments
    calibration.PERIOD = 20  # so that λ moves within the few steps of a case
    main(sys.argv[1], Path(sys.argv[2]), sys.argv[3:])
