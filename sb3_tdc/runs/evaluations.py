"""The evaluations of a run, read from its folder."""

from dataclasses import dataclass
from pathlib import Path

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

    :return: the evaluations, or None if the run has not been evaluated
    :raises ValueError: if the file cannot be read, or holds anything other than returns of evaluations
    """
    path = run.evaluations
    if not path.is_file():
        return None
    evaluations = Evaluations(*read_arrays(path, "timesteps", "results"))
    _check(evaluations, path)
    return evaluations


def _check(evaluations: Evaluations, path: Path) -> None:
    timesteps, returns = evaluations.timesteps, evaluations.returns
    are_numbers = all(np.issubdtype(values.dtype, np.number) for values in (timesteps, returns))
    if not are_numbers or returns.ndim != 2 or not returns.size or timesteps.shape != returns.shape[:1]:
        found = f"{timesteps.dtype} {timesteps.shape} and {returns.dtype} {returns.shape}"
        raise ValueError(
            f"{path} must have one step and at least one return for each evaluation, got arrays of {found}"
        )
