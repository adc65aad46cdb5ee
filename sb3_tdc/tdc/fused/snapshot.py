"""
Whether anything that can influence an update is still what it was.

Modules, parameters, their storage, the state and options of the optimizers, methods on classes and instances, and hooks
are compared by identity, at every call of ``train``, after matrix products that have emptied the caches. So as few
objects as possible are looked at: of a module its children, its parameters and how many attributes it has (one more
where a method is replaced on the instance); of hooks, only how many have been registered in this process.
"""

import operator
from collections.abc import Iterable
from itertools import chain
from typing import Any

import torch as th
from torch import nn
from torch.utils.hooks import RemovableHandle

from sb3_tdc.tdc.fused.applicability import REPLACED_METHODS

_options_of = operator.itemgetter(  # the learning rate may change
    *("params", "betas", "eps", "weight_decay", "amsgrad", "maximize", "differentiable", "capturable")
)
_settings_of = operator.attrgetter(
    *("policy", "actor", "actor_target", "critic", "critic_target", "actor.optimizer", "critic.optimizer"),
    *("kappa", "tau", "target_policy_noise", "target_noise_clip"),
)
_requires_grad = operator.attrgetter("requires_grad")
_METHODS_OF = [(cls, operator.attrgetter(*methods)) for cls, methods in REPLACED_METHODS.items()]
_METHODS = [methods_of(cls) for cls, methods_of in _METHODS_OF]


def _values(contents: list[dict[Any, Any]]) -> list[Any]:
    return list(chain.from_iterable(map(dict.values, contents)))


def _equal(current: list[Any], copy: list[Any]) -> bool:
    try:
        return current == copy  # by identity first; other tensors do not have a truth value
    except (RuntimeError, ValueError, TypeError):
        return False


class ModuleSnapshot:
    """
    Modules as they are now.

    :param modules: all modules of some networks
    """

    def __init__(self, modules: Iterable[nn.Module]):
        modules = list(modules)
        self.n_hooks = RemovableHandle.next_id
        self.attributes = [vars(module) for module in modules]
        self.n_attributes = list(map(len, self.attributes))
        self.contents = [d for module in modules for d in (module._modules, module._parameters) if d]
        self.values = _values(self.contents)
        self.parameters = [p for module in modules for p in module._parameters.values() if p is not None]
        self.storage = list(map(th.Tensor.data_ptr, self.parameters))

    def is_current(self) -> bool:
        """Return whether the modules are the same; a hook registered anywhere counts as a change."""
        return (
            RemovableHandle.next_id == self.n_hooks
            and list(map(len, self.attributes)) == self.n_attributes
            and _equal(_values(self.contents), self.values)
            and list(map(th.Tensor.data_ptr, self.parameters)) == self.storage
        )


class Snapshot:
    """
    The networks and optimizers of a model as they are now, and the settings that an update reads from Python.

    :param model: a :class:`~sb3_tdc.tdc.tdc.TDC` in whose way :func:`~sb3_tdc.tdc.fused.applicability.obstacles` found
        nothing, with the state of its optimizers in place
    """

    def __init__(self, model: Any):
        policy = model.policy
        self.model, self.settings = model, _settings_of(model)
        self.modules = ModuleSnapshot(policy.modules())
        optimizers = [policy.actor.optimizer, policy.critic.optimizer]
        self.contents: list[dict[Any, Any]] = []
        for optimizer in optimizers:
            self.contents += [vars(optimizer), optimizer.state, *optimizer.state.values()]
        self.values = _values(self.contents)
        self.groups = [optimizer.param_groups[0] for optimizer in optimizers]
        self.options = [(list(params), *rest) for params, *rest in map(_options_of, self.groups)]
        self.learning = [parameter for params, *_ in self.options for parameter in params]
        self.overridden = model.overridden_methods

    def is_current(self) -> bool:
        """Return whether all of it is still the same; a hook registered anywhere counts as a change."""
        return (
            _settings_of(self.model) == self.settings
            and self.modules.is_current()
            and _equal(_values(self.contents), self.values)
            and _equal(list(map(_options_of, self.groups)), self.options)
            and all(map(_requires_grad, self.learning))
            and [methods_of(cls) for cls, methods_of in _METHODS_OF] == _METHODS
            and not self.overridden()
        )
