"""Read the evaluations that a run has left."""

from dataclasses import dataclass

import numpy as np

from sb3_tdc.common.arrays import read_arrays
from sb3_tdc.runs.folder import RunFolder


@dataclass(frozen=True)
class Evaluations:
    """
    The evaluations of one run.

    :param timesteps: (evaluations,)
    :param returns: (evaluations, episodes), of the mean action
    """

    timesteps: np.ndarray
    returns: np.ndarray


def read_evaluations(run: RunFolder) -> Evaluations | None:
    """
    Read the evaluations of a run.

    :return: None if it has not been evaluated
    :raises ValueError: if the file cannot be read
    """
    path = run.evaluations
    return Evaluations(*read_arrays(path, "timesteps", "results")) if path.is_file() else None
