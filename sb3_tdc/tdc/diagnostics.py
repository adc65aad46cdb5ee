"""Measurements of the critics and the networks on a minibatch; docs/tdc.md describes each of them."""

from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.sac.policies import Actor as TanhGaussianActor
from stable_baselines3.td3.policies import Actor as DeterministicActor
from torch import nn

from sb3_tdc.common.layers import StackedLinear
from sb3_tdc.tdc.dormant import dormant_share, relu_activations
from sb3_tdc.tdc.lam import describe_selection
from sb3_tdc.tdc.policies import QuantileCritic
from sb3_tdc.tdc.quantiles import Target, quantile_huber_loss

# Modules whose forward pass changes no state
_PLAIN = (nn.Linear, StackedLinear, nn.ReLU, nn.Tanh, nn.Flatten, nn.Sequential, nn.ModuleList, FlattenExtractor)


def describe_critics(current: th.Tensor, target: Target, kappa: float) -> dict[str, th.Tensor]:
    """
    Measure the loss, the target and the selection of critics.

    :param current: (B, C, N), quantiles of the critics
    :param target: the target of the same minibatch
    :param kappa: κ
    :return: scalars by name
    """
    y, mean, std, selected = target
    td_errors = y.mean(dim=1, keepdim=True) - current.mean(dim=2)  # δ of Fig. S1, (B, C)
    return {
        "critic_loss": quantile_huber_loss(current, y, kappa),  # Eq. 10
        "target_mean": y.mean(),
        "target_std": std.gather(1, selected.unsqueeze(1)).mean(),
        "critic_disagreement": (mean.amax(dim=1) - mean.amin(dim=1)).mean(),
        "td_error_var": td_errors.var(dim=0, correction=0).mean(),
        **{f"critic_{i + 1}_selected": (selected == i).float().mean() for i in range(mean.shape[1])},
        **describe_selection(target),
    }


def describe_units(model: Any, observations: Any) -> dict[str, th.Tensor]:
    """
    Measure the share of dormant units in the actor, and in the critics at the actor's mean actions.

    :param model: a :class:`~sb3_tdc.tdc.tdc.TDC`
    :param observations: observations of a minibatch
    :return: scalars by name; none unless the networks are linear layers and ReLUs on flat observations
    """
    actor, critic = model.actor, model.critic
    if not _has_plain_units(model):
        return {}
    features = actor.extract_features(observations, actor.features_extractor)
    of_actor, outputs = relu_activations(actor.latent_pi if model.stochastic_actor else actor.mu, features)
    actions = actor.mu(outputs).tanh() if model.stochastic_actor else outputs
    features = critic.extract_features(observations, critic.features_extractor)
    of_critics, _ = relu_activations(critic.layers, th.cat([features, actions.detach()], dim=1))
    if not (of_actor and of_critics):
        return {}
    return {"actor_dormant": dormant_share(of_actor), "critic_dormant": dormant_share(of_critics)}


def _has_plain_units(model: Any) -> bool:
    """Return whether the networks are TDC's own: sequences of linear layers and ReLUs on flat observations."""
    actor, critic = model.actor, model.critic
    own_actor = TanhGaussianActor if model.stochastic_actor else DeterministicActor
    if not (isinstance(actor, own_actor) and isinstance(critic, QuantileCritic)):
        return False
    sequences = (actor.latent_pi if isinstance(actor, TanhGaussianActor) else actor.mu, critic.layers)
    inner = [module for network in (actor, critic) for module in network.modules() if module not in (actor, critic)]
    return (
        isinstance(model.observation_space, spaces.Box)
        and all(isinstance(sequence, (nn.Sequential, nn.ModuleList)) for sequence in sequences)
        and all(type(module) in _PLAIN for module in inner)
    )
