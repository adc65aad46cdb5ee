"""
What a calibrated λ costs: ``python -m benchmarks.calibration`` prints the time of a training step next to a fixed λ's.

Processor time on one thread, in interleaved rounds on Hopper-v4.
"""

import time
from statistics import median

import gymnasium as gym
import torch as th

from sb3_tdc import TDC

WARM_UP, ROUNDS, STEPS = 900, 30, 150


def main() -> None:
    """Train both in turns, and print the ratio of their times."""
    th.set_num_threads(1)
    models = {
        lam: TDC("MlpPolicy", gym.make("Hopper-v4"), lam=lam, learning_starts=500, seed=0) for lam in (1.0, "auto")
    }
    times: dict[float | str, list[float]] = {lam: [] for lam in models}
    for model in models.values():
        model.learn(WARM_UP)
    for i in range(ROUNDS):
        for lam, model in sorted(models.items(), key=str, reverse=bool(i % 2)):
            start = time.process_time()
            model.learn(STEPS, reset_num_timesteps=False)
            times[lam].append((time.process_time() - start) / STEPS)
    fixed, calibrated = times[1.0], times["auto"]
    print(f"fixed λ: {1e3 * median(fixed):.3g} ms a step; calibrated: {1e3 * median(calibrated):.3g} ms")
    print(f"ratio of medians {median(calibrated) / median(fixed):.3f}, of minima {min(calibrated) / min(fixed):.3f}")


if __name__ == "__main__":
    main()
