"""How many threads PyTorch computes on."""

import os

import torch as th


def set_threads(number: int) -> None:
    """Set the threads of PyTorch; -1: at most two, unless ``OMP_NUM_THREADS`` says otherwise."""
    if number > 0:
        th.set_num_threads(number)
    elif "OMP_NUM_THREADS" not in os.environ:  # networks of this size gain nothing from more
        th.set_num_threads(min(2, th.get_num_threads()))
