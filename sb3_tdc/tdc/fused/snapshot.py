"""
Snapshots that detect a change of anything that can influence an update.

Modules, parameters, their storage, the state and options of the optimizers, methods on classes and instances, and hooks
are compared by identity, at every call of ``train``, after matrix products have evicted them from the caches. So as few
objects as possible are read: of a module its class, its children, its parameters and the number of its attributes (one
more if a method is replaced on the instance); of hooks, only how many have been registered in this process.
"""

import gc
import operator
from collections.abc import Iterable
from typing import Any

import torch as th
from stable_baselines3.sac.policies import Actor as TanhGaussianActor
from torch import nn
from torch.utils.hooks import RemovableHandle

from sb3_tdc.tdc.fused.applicability import REPLACED_METHODS, constants_of

_options_of = operator.itemgetter(  # all but the learning rate, which may change
    *("betas", "eps", "weight_decay", "amsgrad", "maximize", "differentiable", "capturable")
)
_settings_of = operator.attrgetter(
    *("policy", "actor", "actor_target", "critic", "critic_target", "actor.optimizer", "critic.optimizer"),
    *("kappa", "tau", "target_policy_noise", "target_noise_clip"),
)
_requires_grad = operator.attrgetter("requires_grad")


def _same(current: list[Any], copy: list[Any]) -> bool:
    return len(current) == len(copy) and all(map(operator.is_, current, copy))


def _equal(current: list[Any], copy: list[Any]) -> bool:
    try:
        return current == copy  # two different tensors with several elements have no truth value
    except (RuntimeError, ValueError, TypeError):
        return False


class MethodSnapshot:
    """
    The methods, when the snapshot is taken, whose work the fused update does itself.

    :param parts: instances of the classes that have these methods
    """

    def __init__(self, parts: Iterable[Any]):
        classes = {cls for part in parts for cls in type(part).__mro__} & REPLACED_METHODS.keys()
        self.methods_of = [(cls, operator.attrgetter(*REPLACED_METHODS[cls])) for cls in classes]
        self.methods = [methods_of(cls) for cls, methods_of in self.methods_of]

    def is_current(self) -> bool:
        """Return whether no method has been replaced on a class."""
        return [methods_of(cls) for cls, methods_of in self.methods_of] == self.methods


class ModuleSnapshot:
    """
    The state of modules, and of the methods of their classes, when the snapshot is taken.

    :param modules: all modules of some networks
    """

    def __init__(self, modules: Iterable[nn.Module]):
        modules = list(modules)
        self.n_hooks = RemovableHandle.next_id
        self.stochastic = [module for module in modules if isinstance(module, TanhGaussianActor)]
        self.distributions = [actor.action_dist for actor in self.stochastic]
        self.constants = list(map(constants_of, self.distributions))
        self.parts = [*modules, *self.distributions]
        self.classes = list(map(type, self.parts))
        self.methods = MethodSnapshot(self.parts)
        self.attributes = list(map(vars, self.parts))
        self.n_attributes = list(map(len, self.attributes))
        self.contents = [d for module in modules for d in (module._modules, module._parameters) if d]
        self.values = gc.get_referents(*self.contents)
        self.parameters = [p for module in modules for p in module._parameters.values() if p is not None]
        self.storage = list(map(th.Tensor.data_ptr, self.parameters))

    def is_current(self) -> bool:
        """Return whether the modules are unchanged; a hook registered anywhere counts as a change."""
        # The referents of dictionaries include all their values, in order: the fastest way to compare them
        return (
            RemovableHandle.next_id == self.n_hooks
            and list(map(type, self.parts)) == self.classes
            and list(map(len, self.attributes)) == self.n_attributes
            and [actor.action_dist for actor in self.stochastic] == self.distributions
            and list(map(constants_of, self.distributions)) == self.constants
            and _same(gc.get_referents(*self.contents), self.values)
            and list(map(th.Tensor.data_ptr, self.parameters)) == self.storage
            and self.methods.is_current()
        )


class Snapshot:
    """
    The state of a model's networks and optimizers, and the settings that an update reads from Python.

    :param model: a :class:`~sb3_tdc.tdc.tdc.TDC` for which :func:`~sb3_tdc.tdc.fused.applicability.obstacles` found
        nothing, and whose optimizers already have their state
    """

    def __init__(self, model: Any):
        policy = model.policy
        self.model, self.settings = model, _settings_of(model)
        self.modules = ModuleSnapshot(policy.modules())
        optimizers = [policy.actor.optimizer, policy.critic.optimizer]
        self.contents: list[dict[Any, Any]] = []
        for optimizer in optimizers:
            self.contents += [vars(optimizer), optimizer.state, *optimizer.state.values()]
        self.values = gc.get_referents(*self.contents)
        self.group_lists = [optimizer.param_groups for optimizer in optimizers]
        self.groups = [group for groups in self.group_lists for group in groups]
        self.options = list(map(_options_of, self.groups))
        self.learning = [parameter for group in self.groups for parameter in group["params"]]
        self.methods = MethodSnapshot(optimizers)
        self.overrides_methods = model.overrides_methods

    def is_current(self) -> bool:
        """Return whether nothing has changed; a hook registered anywhere counts as a change."""
        return (
            _settings_of(self.model) == self.settings
            and self.modules.is_current()
            and _same(gc.get_referents(*self.contents), self.values)
            and _same([group for groups in self.group_lists for group in groups], self.groups)
            and _same([parameter for group in self.groups for parameter in group["params"]], self.learning)
            and _equal(list(map(_options_of, self.groups)), self.options)
            and all(map(_requires_grad, self.learning))
            and self.methods.is_current()
            and not self.overrides_methods()
        )
