"""Numbers of Python that the device reads."""

import torch as th


class Scalar:
    """
    A tensor that holds one number of Python, written only when the number changes.

    :param tensor: of any shape
    """

    def __init__(self, tensor: th.Tensor):
        self.tensor = tensor
        self.value: float | None = None

    def set(self, value: float) -> None:
        """Let the tensor hold this number."""
        if value != self.value:
            self.tensor.fill_(value)
            self.value = value

    def copy_(self, values: th.Tensor) -> None:
        """Let the tensor hold these numbers, until the next :meth:`set`."""
        self.tensor.copy_(values)
        self.value = None
