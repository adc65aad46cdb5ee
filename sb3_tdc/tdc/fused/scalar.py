"""Python numbers in tensors, from which the device reads them."""

import torch as th


class Scalar:
    """
    A tensor that holds one Python number, written only when the number changes.

    :param tensor: the tensor, of any shape; every element holds the number
    """

    def __init__(self, tensor: th.Tensor):
        self.tensor = tensor
        self.value: float | None = None

    def set(self, value: float) -> None:
        """Fill the tensor with a number."""
        if value != self.value:
            self.tensor.fill_(value)
            self.value = value

    def copy_(self, values: th.Tensor) -> None:
        """Copy different numbers into the tensor, which holds them until the next :meth:`set`."""
        self.tensor.copy_(values)
        self.value = None
