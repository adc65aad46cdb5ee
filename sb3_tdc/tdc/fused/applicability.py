"""Where the fused update applies: all that it computes itself must be unmodified code of SB3, PyTorch and TDC."""

from collections.abc import Iterator
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.sac import policies as sac_policies
from stable_baselines3.sac.policies import Actor as TanhGaussianActor
from stable_baselines3.td3.policies import Actor as DeterministicActor
from torch import nn
from torch.nn.modules import module as global_hooks
from torch.optim import optimizer as global_optimizer_hooks

from sb3_tdc.tdc.policies import (
    LOG_STD_MAX,
    LOG_STD_MIN,
    TANH_EPSILON,
    QuantileCritic,
    StackedLinear,
    TanhGaussian,
    TDCPolicy,
)

# The first optimizer of a class wraps the class's step. To make a whole one would import torch._dynamo: a second
th.optim.Adam._patch_step_function(th.optim.Adam.__new__(th.optim.Adam))

_DENSITY = ("proba_distribution", "log_prob", "sample", "mode")
# Methods whose work the fused update does itself, as they were when this module was imported: class → name → function
REPLACED_METHODS: dict[type, dict[str, Any]] = {
    cls: {name: getattr(cls, name) for name in names}
    for cls, names in {
        TDCPolicy: (
            *("predict", "_predict", "set_training_mode", "obs_to_tensor", "extract_features"),
            *("scale_action", "unscale_action"),
        ),
        DeterministicActor: ("forward", "_predict", "extract_features"),
        TanhGaussian: ("actions_from_params", "log_prob_from_params", "get_actions", *_DENSITY),
        DiagGaussianDistribution: _DENSITY,
        TanhGaussianActor: ("forward", "_predict", "get_action_dist_params", "action_log_prob", "extract_features"),
        QuantileCritic: ("forward", "q1_forward", "extract_features"),
        StackedLinear: ("forward", "forward_first"),
        **dict.fromkeys((nn.Sequential, nn.Linear, nn.ReLU, nn.Tanh, nn.Flatten, FlattenExtractor), ("forward",)),
        nn.Module: ("__call__",),
        th.optim.Adam: ("step",),
    }.items()
}
_HOOKS = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")
_OPTIMIZER_HOOKS = ("_optimizer_step_pre_hooks", "_optimizer_step_post_hooks")
_GLOBAL_HOOKS: list[dict[int, Any]] = [
    *(getattr(global_hooks, f"_global{name}") for name in _HOOKS),
    global_optimizer_hooks._global_optimizer_pre_hooks,
    global_optimizer_hooks._global_optimizer_post_hooks,
]


def obstacles(model: Any) -> list[str]:
    """
    Return the reasons why the fused update does not apply to a model.

    :param model: a :class:`~sb3_tdc.tdc.tdc.TDC`
    :return: a phrase for each reason; none where it applies
    """
    policy, space = model.policy, model.observation_space
    found = [f"{name} is overridden" for name in model.overridden_methods()]
    for cls, methods in REPLACED_METHODS.items():
        found += [
            f"{cls.__name__}.{name} is replaced" for name, own in methods.items() if getattr(cls, name) is not own
        ]
    if not (isinstance(space, spaces.Box) and len(space.shape) == 1):
        found.append("the observations are not flat vectors")
    networks = {"actor": policy.actor, "critic": policy.critic}
    targets = {"actor_target": policy.actor_target, "critic_target": policy.critic_target}
    for name, network in (networks | targets).items():
        if getattr(model, name) is not network:
            found.append(f"model.{name} is not model.policy.{name}")
    if type(policy) is not TDCPolicy:
        found.append(f"{type(policy).__qualname__} is a custom class")
    found += [f"{name} of the policy is replaced" for name in _replaced_methods(policy)]
    found += [text for name, network in networks.items() for text in _network_obstacles(name, network)]
    if not found:
        found += [text for name, network in targets.items() for text in _network_obstacles(name, network)]
    if not found:  # the structure is known, so the parameters can be compared
        found += [text for name in networks for text in _parameter_obstacles(name, policy)]
    for name, network in networks.items():
        if not is_plain_adam(network.optimizer):
            found.append(f"the {name}'s optimizer is not a plain Adam: {_describe(network.optimizer)}")
    if any(_hooks(policy)) or any(_GLOBAL_HOOKS):
        found.append("a network, a parameter or an optimizer has hooks")
    if model.device.type == "cuda" and not model.fused:
        found.append("on CUDA it must be demanded (fused=True): it has not been measured there")
    elif model.device.type not in ("cpu", "cuda"):
        found.append(f"the device is {model.device}")
    return found


def _network_obstacles(name: str, network: Any) -> Iterator[str]:
    """Yield the reasons why a network is not one of the known ReLU networks."""
    if type(network) not in (DeterministicActor, TanhGaussianActor, QuantileCritic):
        yield f"the {name} is a custom class, {type(network).__qualname__}"
        return
    for module in network.modules():
        for method in _replaced_methods(module):
            yield f"{method} of a module of the {name} is replaced"
    if isinstance(network, TanhGaussianActor):
        for method in _replaced_methods(network.action_dist):
            yield f"{method} of the {name}'s distribution is replaced"
        constants = constants_of(network.action_dist)
        if constants != (LOG_STD_MIN, LOG_STD_MAX, TANH_EPSILON):
            yield f"the limits of log σ, or the ε of its density, are not those of SB3: {constants}"
    extractor = [type(module) for module in network.features_extractor.modules()]
    if extractor != [FlattenExtractor, nn.Flatten]:
        yield f"the {name}'s features extractor is {', '.join(cls.__name__ for cls in extractor)}"
    if _stacks(network) is None:
        layers = [type(m).__name__ for m in network.modules() if not list(m.children())]
        yield f"the {name}'s layers are not linear ones with ReLU between them: {', '.join(layers)}"


def constants_of(distribution: Any) -> tuple[float, ...]:
    """Return the constants of SB3's tanh-Gaussian density: the limits of log σ in SB3's module, and the object's ε."""
    return sac_policies.LOG_STD_MIN, sac_policies.LOG_STD_MAX, distribution.epsilon


def _replaced_methods(instance: Any) -> list[str]:
    """Return the names of methods of a class that are replaced on this instance."""
    return [name for name in vars(instance) if callable(getattr(type(instance), name, None))]


def _stacks(network: Any) -> list[Any] | None:
    """Return the linear layers of a network in the order of its forward pass, or None if it has another structure."""
    kind: type[nn.Module]
    linear: type[nn.Module] = nn.Linear
    ending: list[type[nn.Module]] = []
    heads: list[nn.Module] = []
    container: Any
    if type(network) is QuantileCritic:
        container, kind, linear = network.layers, nn.ModuleList, StackedLinear
    elif type(network) is DeterministicActor:
        container, kind, ending = network.mu, nn.Sequential, [nn.Tanh]
    elif type(network.action_dist) is TanhGaussian:
        container, kind, heads = network.latent_pi, nn.Sequential, [network.mu, network.log_std]
    else:
        return None
    if type(container) is not kind:
        return None
    layers = [*container, *heads]
    if set(network.modules()) != {network, container, *layers, *network.features_extractor.modules()}:
        return None
    return _linear_layers(layers, linear, ending, n_outputs=len(heads) or 1)


def _linear_layers(
    layers: list[Any], linear: type[nn.Module], ending: list[type[nn.Module]], n_outputs: int = 1
) -> list[Any] | None:
    kinds = [type(layer) for layer in layers]
    n_hidden = (len(kinds) - n_outputs - len(ending)) // 2
    if n_hidden < 1 or kinds != [linear, nn.ReLU] * n_hidden + [linear] * n_outputs + ending:
        return None
    return [layer for layer in layers if type(layer) is linear]


def _parameter_obstacles(name: str, policy: TDCPolicy) -> Iterator[str]:
    """Yield what is unusual about the parameters of a network, its target and its optimizer."""
    network, target = getattr(policy, name), getattr(policy, f"{name}_target")
    stacks = [_stacks(network), _stacks(target)]
    parameters, targets = ([p for layer in stack or [] for p in (layer.weight, layer.bias)] for stack in stacks)
    if any(p is None for p in (*parameters, *targets)):
        yield f"a layer of the {name} has no bias"
    elif not _same(list(network.parameters()), parameters) or not _same(list(target.parameters()), targets):
        yield f"the {name} has parameters of its own, or some twice"
    elif [p.shape for p in parameters] != [p.shape for p in targets]:
        yield f"the {name} and its target differ in shape"
    elif not _same([p for group in network.optimizer.param_groups for p in group["params"]], parameters):
        yield f"the {name}'s optimizer does not have the parameters of the {name}, in their order"
    elif not all(p.requires_grad for p in parameters):
        yield f"a parameter of the {name} is frozen"
    elif not all(_is_plain(p) for p in (*parameters, *targets)):
        yield f"a parameter of the {name} is not a contiguous float32 tensor without hooks"
    elif len({p.data_ptr() for p in (*parameters, *targets)}) < len(parameters) + len(targets):
        yield f"parameters of the {name} share memory"


def _same(a: list[Any], b: list[Any]) -> bool:
    return len(a) == len(b) and all(x is y for x, y in zip(a, b, strict=True))


def _is_plain(parameter: Any) -> bool:
    hooks = parameter._backward_hooks or getattr(parameter, "_post_accumulate_grad_hooks", None)
    plain = type(parameter) is nn.Parameter and parameter.dtype == th.float32 and parameter.is_contiguous()
    return plain and not hooks


def is_plain_adam(optimizer: Any) -> bool:
    """Return whether a step of this optimizer is a plain one of Adam, without options such as weight decay."""
    if type(optimizer) is not th.optim.Adam or len(optimizer.param_groups) != 1 or "step" in vars(optimizer):
        return False
    group = optimizer.param_groups[0]
    extras = ("weight_decay", "amsgrad", "maximize", "differentiable")
    numbers = (group["lr"], *group["betas"])
    return not any(group.get(name) for name in extras) and not any(isinstance(n, th.Tensor) for n in numbers)


def _describe(optimizer: Any) -> str:
    options = {key: value for key, value in optimizer.param_groups[0].items() if key != "params" and value}
    return f"{type(optimizer).__name__} with {options}"


def _hooks(policy: TDCPolicy) -> Iterator[Any]:
    for module in policy.modules():
        yield from (getattr(module, name) for name in _HOOKS)
    for optimizer in (policy.actor.optimizer, policy.critic.optimizer):
        yield from (getattr(optimizer, name, None) for name in _OPTIMIZER_HOOKS)
