"""
The cost of calibrating λ: ``python -m benchmarks.calibration`` prints its share of training time.

Measures processor time on one thread, on Hopper-v4 after a warm-up. On a shared machine, two whole trainings differ by
more than this share, so the calibration is timed within a training.
"""

import time
from typing import Any

import gymnasium as gym
import torch as th

from sb3_tdc.ablations.calibration import CalibratedTDC

WARM_UP, STEPS = 1_000, 5_000


def main() -> None:
    """Train, and print the share of the time that calibration takes."""
    th.set_num_threads(1)
    # A large τ, so that the calibration begins within the warm-up
    model = CalibratedTDC("MlpPolicy", gym.make("Hopper-v4"), learning_starts=100, tau=0.2, seed=0)
    model.learn(WARM_UP)
    follow, seconds = model._follow_episodes, 0.0

    def timed(*args: Any) -> None:
        nonlocal seconds
        start = time.process_time()
        follow(*args)
        seconds += time.process_time() - start

    vars(model)["_follow_episodes"] = timed
    start = time.process_time()
    model.learn(STEPS, reset_num_timesteps=False)
    total = time.process_time() - start
    print(f"{1e3 * total / STEPS:.3g} ms a step, of which calibration takes {seconds / total:.2%}")


if __name__ == "__main__":
    main()
