"""The number of threads that PyTorch uses."""

import os

import torch as th


def set_threads(number: int) -> None:
    """Set the number of threads of PyTorch; -1 stands for at most two, unless ``OMP_NUM_THREADS`` sets the number."""
    if number > 0:
        th.set_num_threads(number)
    elif "OMP_NUM_THREADS" not in os.environ:  # networks of this size gain nothing from more
        th.set_num_threads(min(2, th.get_num_threads()))
