"""
Learning curves that others have published, as data: to be shown next to ours, never mixed with them.

``published_curves.csv`` has the mean and standard deviation over seeds at each environment step, on Gymnasium's -v4
tasks. They were computed from the files of every seed in the repository DAVIAN-Robotics/SimbaV2 (commit 86899c2,
November 2025, Apache-2.0), made with MuJoCo before 3.5; of CrossQ, every tenth point is kept.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd

from sb3_tdc.experiments.statistics import interval_of

_FILE = Path(__file__).with_suffix(".csv")


@dataclass(frozen=True)
class PublishedCurve:
    """
    The learning curve of one algorithm on one task.

    :param steps: (points,), environment steps
    :param mean: (points,), over seeds
    :param std: (points,), over seeds
    """

    source: str
    algorithm: str
    seeds: int
    steps: np.ndarray
    mean: np.ndarray
    std: np.ndarray

    def interval(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return mean, low and high, each (points,): the 95 % interval of the mean by Student's t over seeds."""
        return interval_of(self.mean, self.std, self.seeds)

    def at(self, step: int) -> tuple[float, float, float]:
        """Return mean, low and high at a step, interpolated between the two nearest points; NaN outside the curve."""
        beyond = {"left": np.nan, "right": np.nan}
        mean, low, high = (float(np.interp(step, self.steps, values, **beyond)) for values in self.interval())
        return mean, low, high


@cache
def _read() -> pd.DataFrame:
    return pd.read_csv(_FILE)


def published_curves(env_id: str) -> list[PublishedCurve]:
    """Return the published curves of a task, in the order of the file."""
    rows = _read()
    rows = rows[rows["environment"] == env_id]
    curves = []
    rows = rows[rows["std"].notna()]  # a point of one seed, evaluated before training, has none
    for (source, algorithm), some in rows.groupby(["source", "algorithm"], sort=False):
        numbers = [some[name].to_numpy(float) for name in ("step", "mean", "std")]
        curves.append(PublishedCurve(source, algorithm, int(some["seeds"].iloc[0]), *numbers))
    return curves
