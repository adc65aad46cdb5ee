"""
Whether anything that can influence an update is still what it was.

Modules, parameters, their storage, the state and options of the optimizers, methods on classes and instances, and hooks
are compared by identity, at every call of ``train``, after matrix products that have emptied the caches. So as few
objects as possible are looked at: of a module its children, its parameters and how many attributes it has (one more
where a method is replaced on the instance); of hooks, only how many have been registered in this process.
"""

import operator
from collections.abc import Iterable
from typing import Any

import torch as th
from torch import nn
from torch.utils.hooks import RemovableHandle

from sb3_tdc.tdc.fused.applicability import REPLACED_METHODS

_OPTIONS = ("params", "betas", "eps", "weight_decay", "amsgrad", "maximize", "differentiable", "capturable")
_requires_grad = operator.attrgetter("requires_grad")
_options_of = operator.itemgetter(*_OPTIONS)  # the learning rate may change


def _equal(contents: list[Any], copies: list[Any]) -> bool:
    """Compare by identity first; tensors that are not the same object do not have a truth value."""
    try:
        return all(map(operator.eq, contents, copies))
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
        self.copies = [dict(content) for content in self.contents]
        self.parameters = [p for module in modules for p in module._parameters.values() if p is not None]
        self.storage = list(map(th.Tensor.data_ptr, self.parameters))

    def is_current(self) -> bool:
        """Return whether the modules are the same; a hook registered anywhere counts as a change."""
        return (
            RemovableHandle.next_id == self.n_hooks
            and list(map(len, self.attributes)) == self.n_attributes
            and _equal(self.contents, self.copies)
            and list(map(th.Tensor.data_ptr, self.parameters)) == self.storage
        )


class Snapshot:
    """
    The networks and optimizers of a model as they are now.

    :param model: a :class:`~sb3_tdc.tdc.tdc.TDC` in whose way :func:`~sb3_tdc.tdc.fused.applicability.obstacles` found
        nothing, with the state of its optimizers in place
    """

    def __init__(self, model: Any):
        policy = model.policy
        self.model, self.policy = model, policy
        self.networks = [policy.actor, policy.actor_target, policy.critic, policy.critic_target]
        self.optimizers = [policy.actor.optimizer, policy.critic.optimizer]
        self.modules = ModuleSnapshot(policy.modules())
        self.contents: list[dict[Any, Any]] = []
        for optimizer in self.optimizers:
            self.contents += [vars(optimizer), optimizer.state, *optimizer.state.values()]
        self.copies = [dict(content) for content in self.contents]
        self.groups = [optimizer.param_groups[0] for optimizer in self.optimizers]
        self.options = [(list(params), *rest) for params, *rest in map(_options_of, self.groups)]
        self.learning = [parameter for params, *_ in self.options for parameter in params]

    def is_current(self) -> bool:
        """Return whether all of it is still the same; a hook registered anywhere counts as a change."""
        model, policy = self.model, self.policy
        return (
            model.policy is policy
            and self.networks == [model.actor, model.actor_target, model.critic, model.critic_target]
            and self.optimizers == [policy.actor.optimizer, policy.critic.optimizer]
            and self.modules.is_current()
            and _equal(self.contents, self.copies)
            and _equal(list(map(_options_of, self.groups)), self.options)
            and all(map(_requires_grad, self.learning))
            and [getattr(cls, name) for cls, name in REPLACED_METHODS] == list(REPLACED_METHODS.values())
            and not model.overridden_methods()
        )
