"""
One gradient step of MEOW, transcribed transition by transition in float64, for tests only.

It shares nothing with the package but the values of the weights, which are plain lists of dicts of tensors.
"""

import math

import torch as th


def linear(layer, x):
    return layer["weight"] @ x + layer["bias"]


def layer_norm(layer, x):
    mean = sum(x) / len(x)
    variance = sum((e - mean) ** 2 for e in x) / len(x)
    return layer["norm_weight"] * (x - mean) / th.sqrt(variance + 1e-5) + layer["norm_bias"]


def network(layers, x):
    """Apply Linear, LayerNorm where there is one, and x·σ(βx) in turn."""
    for layer in layers[:-1]:
        x = linear(layer, x)
        if "norm_weight" in layer:
            x = layer_norm(layer, x)
        x = x / (1 + th.exp(-layer["beta"] * x))
    return linear(layers[-1], x)


def log_std(weights, s, low, high):
    return low + 0.5 * (high - low) * (th.tanh(network(weights["prior"], s)) + 1)


def inverse(weights, a, s):
    a = th.clamp(a, -(1 - 1e-5), 1 - 1e-5)
    z = 0.5 * th.log((1 + a) / (1 - a))
    for i in (3, 2, 1, 0):  # two blocks of two couplings, inverted in reverse order
        kept = th.tensor([1.0 if (k % 2 == 0) == (i % 2 == 0) else 0.0 for k in range(len(a))], dtype=th.float64)
        z = z - (1 - kept) * network(weights["couplings"][i], th.cat([kept * z, s]))
    return z, a


def q_values(weights, s, a, alpha, low, high):
    z, a = inverse(weights, a, s)
    sigma = th.exp(log_std(weights, s, low, high))
    energy = -0.5 * sum((z / sigma) ** 2) - sum(th.log(1 - a**2))
    return [alpha * (energy + network(shift, s)[0]) for shift in weights["shifts"]]


def values(weights, s, alpha, low, high):
    normalizer = sum(log_std(weights, s, low, high)) + len(weights["prior"][-1]["bias"]) / 2 * math.log(2 * math.pi)
    return [alpha * (normalizer + network(shift, s)[0]) for shift in weights["shifts"]]


def gradient_step(weights, target, parameters, batch, *, alpha, gamma, low, high, max_norm, lr):
    """
    Change the parameters in place by the first step of Adam.

    :param batch: (s, a, r, s', d) per transition
    :return: the loss, and the norm of its gradient before clipping
    """
    loss = th.zeros((), dtype=th.float64)
    for s, a, r, s_next, d in batch:
        y = r + gamma * (1 - d) * min(float(v) for v in values(target, s_next, alpha, low, high))
        for q in q_values(weights, s, a, alpha, low, high):
            loss = loss + (q - y) ** 2 / (2 * len(batch))
    gradients = th.autograd.grad(loss, parameters)
    norm = math.sqrt(sum(float((g**2).sum()) for g in gradients))
    for parameter, gradient in zip(parameters, gradients, strict=True):
        gradient = gradient * min(1.0, max_norm / norm)
        parameter.data -= lr * gradient / (gradient.abs() + 1e-8)  # Adam's corrected moments after one step: g, g²
    return float(loss.detach()), norm
