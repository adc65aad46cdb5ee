"""Reader of ``.npz`` files."""

import zipfile
from pathlib import Path

import numpy as np

from sb3_tdc.common.words import listed


def read_arrays(path: Path, *names: str) -> list[np.ndarray]:
    """
    Read arrays of a ``.npz`` file without unpickling anything.

    :raises ValueError: if the file is missing or damaged, or an array is missing
    """
    try:
        with path.open("rb") as file:
            if not zipfile.is_zipfile(file):  # NumPy would take it for a pickle, and advise opening it as one
                raise zipfile.BadZipFile
            file.seek(0)
            with np.load(file) as saved:
                return [saved[name] for name in names]
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror or error}") from error
    except Exception as error:  # whatever a damaged file makes NumPy raise
        raise ValueError(f"{path} is damaged: it is no .npz file with {listed(names)}") from error
