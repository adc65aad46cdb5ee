"""Where the fused update applies."""

from typing import TYPE_CHECKING, Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import FlattenExtractor, get_actor_critic_arch
from stable_baselines3.sac.policies import Actor as TanhGaussianActor
from stable_baselines3.td3.policies import Actor as DeterministicActor
from torch import nn

from sb3_tdc.tdc.policies import QuantileCritic, TDCPolicy

if TYPE_CHECKING:
    from sb3_tdc.tdc.tdc import TDC

# What a subclass of TDC may override, and then expects to be called
_METHODS = ("train", "update_critics", "update_actor", "update_targets", "_sample_target_actions")
_OPTIONS = ("bfloat16", "compile_loss")
_CLASSES = (TDCPolicy, DeterministicActor, TanhGaussianActor, QuantileCritic)


def obstacles(model: "TDC") -> list[str]:
    """:return: what stands in the way of the fused update, in words; nothing where it applies"""
    from sb3_tdc.tdc.tdc import TDC

    policy, found = model.policy, []
    space = model.observation_space
    if not (isinstance(space, spaces.Box) and len(space.shape) == 1):
        found.append("the observations are not flat vectors")
    if policy.features_extractor_class is not FlattenExtractor:
        found.append(f"the features extractor is {name_of(policy.features_extractor_class)}")
    if policy.activation_fn is not nn.ReLU:
        found.append(f"the activation is {name_of(policy.activation_fn)}, not ReLU")
    if not all(len(arch) > 0 for arch in get_actor_critic_arch(policy.net_arch)):
        found.append("a network has no hidden layer")
    found += [f"{name} is overridden" for name in _METHODS if getattr(type(model), name) is not getattr(TDC, name)]
    networks = (policy, policy.actor, policy.actor_target, policy.critic, policy.critic_target)
    found += [f"{type(n).__qualname__} is a class of its own" for n in networks if type(n) not in _CLASSES]
    if any(hooks(policy)):
        found.append("a network has hooks")
    if not all(is_plain_adam(network.optimizer) for network in (policy.actor, policy.critic)):
        kind = f"{name_of(policy.optimizer_class)} with {policy.optimizer_kwargs}"
        found.append(f"an optimizer is not a plain Adam (the policy's: {kind})")
    if not all(p.requires_grad for network in (policy.actor, policy.critic) for p in network.parameters()):
        found.append("a parameter is frozen")
    if model.device.type == "cuda" and not model.fused:
        found.append("on CUDA it must be demanded (fused=True): it has not been measured there")
    elif model.device.type not in ("cpu", "cuda"):
        found.append(f"the device is {model.device}")
    return found


def name_of(make: Any) -> str:
    """:return: how to call a class, or a function or object that stands for one"""
    return getattr(make, "__name__", repr(make))


def is_plain_adam(optimizer: Any) -> bool:
    """:return: whether a step of this optimizer is one of Adam, without extras"""
    if type(optimizer) is not th.optim.Adam or len(optimizer.param_groups) != 1:
        return False
    group = optimizer.param_groups[0]
    return not (group["weight_decay"] or group["amsgrad"] or group["maximize"] or isinstance(group["lr"], th.Tensor))


def hooks(network: nn.Module) -> list[dict[int, Any]]:
    """:return: where modules keep who wants to be told of their passes"""
    return [
        kept
        for m in network.modules()
        for kept in (m._forward_hooks, m._forward_pre_hooks, m._backward_hooks, m._backward_pre_hooks)
    ]


def check_options(fused_kwargs: dict[str, Any]) -> None:
    """:raises ValueError: for an option of the fused update that is not one"""
    for name, value in fused_kwargs.items():
        if name not in _OPTIONS:
            raise ValueError(f"fused_kwargs may have {', '.join(_OPTIONS)}, got {name!r}")
        if not isinstance(value, bool):
            raise ValueError(f"fused_kwargs[{name!r}] must be True or False, got {value!r}")
