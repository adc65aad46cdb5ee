"""
Environment steps per second against the number of environments, compared with SB3's TD3.

``python -m benchmarks.collecting`` measures MuJoCo in one process and in one process per environment, and a task on
tensors whose environments are stepped together. It prints a table and writes it to ``docs/benchmarks/collecting.md``.
The models take turns, on one thread; each cell is the median of several rounds.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from stable_baselines3 import TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecMonitor

from benchmarks.speed import hardware
from sb3_tdc import TDC
from sb3_tdc.envs.vector import GymnasiumVecEnv

OBSERVATION, ACTION, LIMIT = 72, 16, 200  # of the Allegro hand
WARM_UP = 3  # steps of all environments


class Points(VectorEnv):
    """A very cheap task: linear dynamics on tensors, in episodes of 200 steps that end at different times."""

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, num_envs: int):
        self.num_envs = num_envs
        self.single_observation_space = spaces.Box(-np.inf, np.inf, (OBSERVATION,), np.float32)
        self.single_action_space = spaces.Box(-1, 1, (ACTION,), np.float32)
        self.generator = th.Generator().manual_seed(0)
        self.effect = self._draw(ACTION) / ACTION

    def _draw(self, n: int) -> th.Tensor:
        return th.randn((n, OBSERVATION), generator=self.generator)

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        self.state = self._draw(self.num_envs)
        self.steps = th.randint(0, LIMIT, (self.num_envs,), generator=self.generator)
        return self.state, {}

    def step(self, actions: Any) -> Any:
        self.state = 0.95 * self.state + th.as_tensor(actions) @ self.effect
        self.steps += 1
        truncated, infos = self.steps >= LIMIT, {}
        if truncated.any():
            ended = truncated.nonzero().flatten()
            infos = {"final_obs": self.state.clone(), "_final_obs": truncated.numpy()}
            self.state[ended], self.steps[ended] = self._draw(len(ended)), 0
        rewards, terminated = -self.state.square().mean(dim=1), th.zeros(self.num_envs, dtype=th.bool)
        return self.state, rewards, terminated, truncated, infos


@dataclass(frozen=True)
class Cell:
    """
    One row of the table.

    :param steps: steps of all environments together, in one round
    :param updates: gradient steps for each of these steps
    """

    what: str
    make_envs: Callable[[int], VecEnv]
    n_envs: int
    steps: int
    updates: int


def make_points(n_envs: int) -> VecEnv:
    return VecMonitor(GymnasiumVecEnv(Points(n_envs)))


def cells() -> Iterator[Cell]:
    for what, kind in (("HalfCheetah-v4, one process", DummyVecEnv), ("HalfCheetah-v4, processes", SubprocVecEnv)):
        for n_envs in (1, 2, 4, 8):

            def make(n: int, kind: Any = kind) -> VecEnv:
                return make_vec_env("HalfCheetah-v4", n, seed=0, vec_env_cls=kind)

            yield Cell(what, make, n_envs, 800 // n_envs, 0)
            yield Cell(what, make, n_envs, 320 // n_envs, 1)
    for n_envs in (1, 16, 256, 1024, 4096):
        steps = max(40, 400 // n_envs)
        for updates in (0, 1):
            yield Cell("tensors, 72 observations", make_points, n_envs, steps, updates)


class Clock(BaseCallback):
    """A callback that measures the seconds of the steps after the warm-up."""

    def _on_training_start(self) -> None:
        self.start, self.first = 0.0, self.num_timesteps

    def _on_rollout_start(self) -> None:
        if self.num_timesteps == self.first + WARM_UP * self.training_env.num_envs:
            self.start = time.perf_counter()

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        self.seconds = time.perf_counter() - self.start


def make_model(algorithm: Any, cell: Cell) -> Any:
    env = cell.make_envs(cell.n_envs)
    size = env.action_space.shape or ()
    return algorithm(
        "MlpPolicy",
        env,
        learning_starts=1,
        buffer_size=max(10_000, 8 * cell.n_envs),
        batch_size=256,
        gradient_steps=cell.updates,
        policy_kwargs={"net_arch": [256, 256]},
        action_noise=NormalActionNoise(np.zeros(size), 0.1 * np.ones(size)),
        seed=0,
        device="cpu",
    )


def measure(cell: Cell, rounds: int) -> dict[str, float]:
    """Return environment steps per second by algorithm, as medians of interleaved rounds."""
    models = {"TDC": make_model(TDC, cell), "TD3": make_model(TD3, cell)}
    rates: dict[str, list[float]] = {name: [] for name in models}
    for i in range(rounds + 1):
        for name, model in models.items():
            clock = Clock()
            model.learn((WARM_UP + cell.steps) * cell.n_envs, callback=clock, reset_num_timesteps=False)
            if i > 0:  # the first round allocates and compiles
                rates[name].append(cell.steps * cell.n_envs / clock.seconds)
    for model in models.values():
        model.env.close()
    return {name: median(values) for name, values in rates.items()}


def main() -> None:
    """Measure all cells and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--output", type=Path, default=Path("docs/benchmarks/collecting.md"))
    args = parser.parse_args()
    th.set_num_threads(1)
    lines = [
        "# Environment steps per second, against the number of environments",
        "",
        f"{hardware()}, one thread of PyTorch; medians of {args.rounds} interleaved rounds.",
        "Batch 256, networks 256-256. The update ratio is gradient steps for each environment step.",
        "",
        "| environments | n | update ratio | TDC, steps/s | SB3's TD3, steps/s | ratio |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for cell in cells():
        rates = measure(cell, args.rounds)
        ratio = "0" if cell.updates == 0 else f"1/{cell.n_envs}" if cell.n_envs > 1 else "1"
        lines.append(
            f"| {cell.what} | {cell.n_envs} | {ratio} | {rates['TDC']:,.0f} | {rates['TD3']:,.0f} "
            f"| {rates['TDC'] / rates['TD3']:.2f} |"
        )
        print(lines[-1], flush=True)
    lines += ["", "```bash", f"python -m benchmarks.collecting --rounds {args.rounds}", "```", ""]
    args.output.write_text("\n".join(lines))


if __name__ == "__main__":
    main()
