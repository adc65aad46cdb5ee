"""Checks for values that are NaN or infinite, and the error that reports them."""

from collections.abc import Sequence
from typing import Any

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import recursive_getattr
from torch import nn

from sb3_tdc.common.words import first_of

# The end of an error message about training that has diverged
ADVICE = "Training has stopped. Look for extreme rewards or observations, or lower the learning rates."


class NonFiniteError(FloatingPointError):
    """Error for a NaN or infinite loss, action, reward or weight; the message says which, and since when."""


def find_non_finite(network: nn.Module, weights: dict[str, Any]) -> list[str]:
    """
    Find parameters and running statistics that are NaN or infinite.

    Constants are not checked: they may be infinite, for instance the mask of an attention layer.

    :param network: the network that the weights belong to; the values of its own weights are not checked
    :param weights: a state dict of the network
    :return: the names of the parameters and running statistics
    """
    parameters = {name for name, _ in network.named_parameters(remove_duplicate=False)}
    checked = (name for name in weights if name in parameters or "running_" in name)
    return [name for name in checked if not weights[name].isfinite().all()]


def find_non_finite_weights(model: BaseAlgorithm) -> list[str]:
    """Return the names of a model's weights, and of the tensors saved with them, that are NaN or infinite."""
    _, tensors = model._get_torch_save_params()
    return [
        *find_non_finite(model.policy, model.policy.state_dict()),
        *(name for name in tensors if not th.as_tensor(recursive_getattr(model, name)).isfinite().all()),
    ]


def refuse_non_finite(refusal: str, names: Sequence[str]) -> None:
    """
    Raise an error if any values are not finite.

    :param refusal: the beginning of the error's sentence, before the names
    :param names: names of the values that are NaN or infinite; if there are none, nothing happens
    :raises NonFiniteError: if there are any
    """
    if names:
        raise NonFiniteError(f"{refusal} {first_of(names)} are not finite.")


def refuse_to_save(model: BaseAlgorithm, names: Sequence[str]) -> None:
    """
    Raise an error if a model cannot be saved because its weights are not finite.

    :param names: names of its weights that are NaN or infinite
    :raises NonFiniteError: if there are any
    """
    refuse_non_finite(f"The model of step {model.num_timesteps:,} was not saved: the weights", names)
