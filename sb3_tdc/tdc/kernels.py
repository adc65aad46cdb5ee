"""
Compiled loops (Numba, the extra ``[fast]``), each of which replaces several passes of PyTorch over memory.

The functions take float32 arrays and write their results into arguments (*written* below). Those of the fused update
have a PyTorch twin with the same name and arguments in ``fused/passes.py``. Shapes: C critics, B transitions,
N quantiles, M targets, A action dimensions, n units of a layer. Import this module through
:func:`~sb3_tdc.tdc.compiled.load_kernels`.

Sums may be reordered, but unlike with ``fastmath=True``, NaN and infinities are kept: a divergence must show.
"""
# mypy: disable-error-code="no-untyped-def"

import math
from collections.abc import Callable
from typing import Any

import numba
import numpy as np

from sb3_tdc.tdc.policies import LOG_SQRT_2_PI, LOG_STD_MAX, LOG_STD_MIN, TANH_EPSILON

_ZERO, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
_LOG_SQRT_2_PI = np.float32(LOG_SQRT_2_PI)
_TANH_EPSILON = np.float32(TANH_EPSILON)
_LOG_STD_MIN, _LOG_STD_MAX = np.float32(LOG_STD_MIN), np.float32(LOG_STD_MAX)


def _compile(function: Callable[..., Any]) -> Callable[..., Any]:
    options = {"fastmath": {"contract", "nsz", "reassoc"}, "error_model": "numpy"}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # Numba finds no writable folder for its cache
        return numba.njit(**options)(function)


@_compile
def _clamp(x, low, high):
    x = high if x > high else x
    return low if x < low else x


@_compile
def _huber_derivative(delta, kappa):
    """Return L'_κ(δ)."""
    if kappa > _ZERO:
        return _clamp(delta, -kappa, kappa)
    return _ONE if delta > _ZERO else (-_ONE if delta < _ZERO else _ZERO)


@_compile
def quantile_huber_gradient(current, target, gradient, bias_gradient, kappa):
    """
    Compute the gradient of the quantile-Huber loss (Eq. 8–10), and its sum over transitions.

    With c = L'_κ(y_j − z_k), the derivative at z_k summed over the targets is ½·((1 − 2τ_k)·Σ_j |c| − Σ_j c).

    :param current: (C, B, N), z
    :param target: (B, M), y
    :param gradient: (C, B, N), written
    :param bias_gradient: (C, 1, N), written
    :param kappa: κ ≥ 0; for 0, L' is the sign
    """
    n_critics, batch_size, n_quantiles = current.shape
    n_targets = target.shape[1]
    kappa = np.float32(kappa)
    scale = np.float32(0.5 / (batch_size * n_quantiles * n_targets))
    weight = np.empty(n_quantiles, np.float32)
    total = np.empty(n_quantiles, np.float32)
    size = np.empty(n_quantiles, np.float32)
    for k in range(n_quantiles):
        weight[k] = scale * (_ONE - np.float32(2 * k + 1) / np.float32(n_quantiles))
    bias_gradient[:] = _ZERO
    for c in range(n_critics):
        for b in range(batch_size):
            z, y = current[c, b], target[b]
            total[:] = _ZERO
            size[:] = _ZERO
            for j in range(0, n_targets - 3, 4):  # four at a time, so that the sums are loaded and stored less often
                y0, y1, y2, y3 = y[j], y[j + 1], y[j + 2], y[j + 3]
                for k in range(n_quantiles):
                    s0, s1 = _huber_derivative(y0 - z[k], kappa), _huber_derivative(y1 - z[k], kappa)
                    s2, s3 = _huber_derivative(y2 - z[k], kappa), _huber_derivative(y3 - z[k], kappa)
                    total[k] += (s0 + s1) + (s2 + s3)
                    size[k] += (abs(s0) + abs(s1)) + (abs(s2) + abs(s3))
            for j in range(n_targets - n_targets % 4, n_targets):
                for k in range(n_quantiles):
                    s = _huber_derivative(y[j] - z[k], kappa)
                    total[k] += s
                    size[k] += abs(s)
            for k in range(n_quantiles):
                g = weight[k] * size[k] - scale * total[k]
                gradient[c, b, k] = g
                bias_gradient[c, 0, k] += g


@_compile
def _huber(distance, kappa):
    """Return L_κ of a distance ≥ 0."""
    if kappa > _ZERO:
        c = kappa if distance > kappa else distance
        return c * (distance - _HALF * c)
    return distance


@_compile
def quantile_huber_loss(current, target, kappa):
    """
    Return the quantile-Huber loss (Eq. 8–10).

    :param current: (C, B, N), z
    :param target: (B, M), y
    :param kappa: κ ≥ 0
    """
    n_critics, batch_size, n_quantiles = current.shape
    n_targets = target.shape[1]
    kappa = np.float32(kappa)
    above = np.empty(n_quantiles, np.float32)
    below = np.empty(n_quantiles, np.float32)
    loss = 0.0
    for c in range(n_critics):
        for b in range(batch_size):
            z, y = current[c, b], target[b]
            above[:] = _ZERO
            below[:] = _ZERO
            for j in range(n_targets):
                for k in range(n_quantiles):
                    delta = y[j] - z[k]
                    h = _huber(abs(delta), kappa)
                    above[k] += h if delta > _ZERO else _ZERO
                    below[k] += _ZERO if delta > _ZERO else h
            for k in range(n_quantiles):  # |τ_k − 1{δ<0}| is τ_k above and 1 − τ_k below
                level = (k + 0.5) / n_quantiles
                loss += level * above[k] + (1 - level) * below[k]
    return loss / (batch_size * n_quantiles * n_targets)


@_compile
def lcb_target(next_quantiles, rewards, dones, discounts, lam, mean, std, selected, target):
    """
    Compute the λ-LCB target (Eq. 4–7).

    :param next_quantiles: (C, B, N)
    :param rewards: (B, 1)
    :param dones: (B, 1)
    :param discounts: (B, 1)
    :param lam: (1,), λ
    :param mean: (C, B), written
    :param std: (C, B), written, the population standard deviation
    :param selected: (B,), int64, written; the first of equal critics
    :param target: (B, N), written
    """
    n_critics, batch_size, n_quantiles = next_quantiles.shape
    for b in range(batch_size):
        choice, smallest = 0, np.float32(np.inf)
        for c in range(n_critics):
            z = next_quantiles[c, b]
            total = _ZERO
            for k in range(n_quantiles):
                total += z[k]
            mean[c, b] = total / np.float32(n_quantiles)
            squares = _ZERO
            for k in range(n_quantiles):
                centred = z[k] - mean[c, b]
                squares += centred * centred
            std[c, b] = math.sqrt(squares / np.float32(n_quantiles))
            score = mean[c, b] - lam[0] * std[c, b]
            if score < smallest or (math.isnan(score) and not math.isnan(smallest)):  # as in PyTorch's min
                choice, smallest = c, score
        selected[b] = choice
        factor = discounts[b, 0] * (_ONE - dones[b, 0])
        for k in range(n_quantiles):
            target[b, k] = rewards[b, 0] + factor * next_quantiles[choice, b, k]


@_compile
def tanh_backward(grad_output, activation, bias_gradient):
    """
    Backpropagate a gradient through a tanh, in place, and sum the result over transitions.

    :param grad_output: (B, A), gradient at the output; becomes the gradient at the input
    :param activation: (B, A), the output of the tanh
    :param bias_gradient: (1, A), written
    """
    bias_gradient[:] = _ZERO
    for b in range(grad_output.shape[0]):
        for k in range(grad_output.shape[1]):
            s = grad_output[b, k] * (_ONE - activation[b, k] * activation[b, k])
            grad_output[b, k] = s
            bias_gradient[0, k] += s


@_compile
def squash(outputs, actions):
    """
    Apply the tanh in place, and copy the result.

    :param outputs: (B, A)
    :param actions: (B, A), written
    """
    for b in range(outputs.shape[0]):
        for k in range(outputs.shape[1]):
            outputs[b, k] = math.tanh(outputs[b, k])
            actions[b, k] = outputs[b, k]


@_compile
def smooth_actions(noise, actions, clip):
    """
    Add clipped noise to actions, in place, and clip them to [-1, 1] (Eq. 1).

    :param noise: (B, A); may be overwritten
    :param actions: (B, A)
    :param clip: c
    """
    clip = np.float32(clip)
    for b in range(actions.shape[0]):
        for k in range(actions.shape[1]):
            actions[b, k] = _clamp(actions[b, k] + _clamp(noise[b, k], -clip, clip), -_ONE, _ONE)


@_compile
def sample_actions(mean, raw_log_std, noise, scaled_noise, actions):
    """
    Sample tanh-Gaussian actions (Eq. 21).

    :param mean: (B, A); the tanh of the sample is written here too
    :param raw_log_std: (B, A), log σ before it is clipped
    :param noise: (B, A), ε
    :param scaled_noise: (B, A), σ·ε, written
    :param actions: (B, A), written
    """
    for b in range(mean.shape[0]):
        for k in range(mean.shape[1]):
            scaled_noise[b, k] = math.exp(_clamp(raw_log_std[b, k], _LOG_STD_MIN, _LOG_STD_MAX)) * noise[b, k]
            mean[b, k] = math.tanh(mean[b, k] + scaled_noise[b, k])
            actions[b, k] = mean[b, k]


@_compile
def log_density(sample, raw_log_std, noise, log_prob):
    """
    Compute the log density of tanh-Gaussian samples.

    :param sample: (B, A), after the tanh
    :param raw_log_std: (B, A)
    :param noise: (B, A), ε
    :param log_prob: (B,), written
    """
    for b in range(sample.shape[0]):
        total = _ZERO
        for k in range(sample.shape[1]):
            log_std = _clamp(raw_log_std[b, k], _LOG_STD_MIN, _LOG_STD_MAX)
            total -= _HALF * noise[b, k] * noise[b, k] + log_std + _LOG_SQRT_2_PI
            total -= math.log(_ONE - sample[b, k] * sample[b, k] + _TANH_EPSILON)
        log_prob[b] = total


@_compile
def tanh_gaussian_backward(
    grad_output, ent_coef, sample, raw_log_std, scaled_noise, grad_log_std, mean_bias_gradient, log_std_bias_gradient
):
    """
    Backpropagate through a tanh-Gaussian sample, adding the gradient of mean(α·log π) (see ``TanhGaussianHead``).

    :param grad_output: (B, A), gradient at the actions; becomes the gradient at the mean
    :param ent_coef: (1,), α
    :param sample: (B, A), after the tanh
    :param raw_log_std: (B, A)
    :param scaled_noise: (B, A), σ·ε
    :param grad_log_std: (B, A), written
    :param mean_bias_gradient: (1, A), written
    :param log_std_bias_gradient: (1, A), written
    """
    coefficient = ent_coef[0] / np.float32(grad_output.shape[0])
    mean_bias_gradient[:] = _ZERO
    log_std_bias_gradient[:] = _ZERO
    for b in range(grad_output.shape[0]):
        for k in range(grad_output.shape[1]):
            a = sample[b, k]
            squeeze = _ONE - a * a
            s = (grad_output[b, k] + _TWO * coefficient * a / (squeeze + _TANH_EPSILON)) * squeeze
            grad_output[b, k] = s
            mean_bias_gradient[0, k] += s
            inside = _ONE if _LOG_STD_MIN <= raw_log_std[b, k] <= _LOG_STD_MAX else _ZERO
            t = (s * scaled_noise[b, k] - coefficient) * inside
            grad_log_std[b, k] = t
            log_std_bias_gradient[0, k] += t


@_compile
def mean_value(hidden, weight, bias, grad_hidden, values):
    """
    Compute Q₁, the mean of the first critic's quantiles (Eq. 11), and the gradient of −mean Q₁ before the last ReLU.

    :param hidden: (B, n), after the ReLU
    :param weight: (n, N), of the layer that outputs the quantiles
    :param bias: (1, N)
    :param grad_hidden: (B, n), written
    :param values: (B,), written
    """
    batch_size, width = hidden.shape
    n_quantiles = weight.shape[1]
    mean_weight = np.empty(width, np.float32)
    mean_bias = _ZERO
    for j in range(n_quantiles):
        mean_bias += bias[0, j]
    mean_bias /= np.float32(n_quantiles)
    for k in range(width):
        total = _ZERO
        for j in range(n_quantiles):
            total += weight[k, j]
        mean_weight[k] = total / np.float32(n_quantiles)
    share = -_ONE / np.float32(batch_size)
    for b in range(batch_size):
        value = _ZERO
        for k in range(width):
            value += hidden[b, k] * mean_weight[k]
            grad_hidden[b, k] = _ZERO if hidden[b, k] <= _ZERO else share * mean_weight[k]
        values[b] = value + mean_bias


@_compile
def gather(rows, batch, drawn_next_observations, next_observations, dones, timeouts, indices):
    """
    Gather a minibatch from packed rows, copy its next observations, and clear ``dones`` at time-outs.

    :param rows: (size, columns)
    :param batch: (B, columns), written
    :param drawn_next_observations: (B, D), columns of ``batch``
    :param next_observations: (B, D), written
    :param dones: (B, 1), a column of ``batch``; time-outs become 0
    :param timeouts: (B, 1), a column of ``batch``
    :param indices: (B,), the rows to gather
    """
    for b in range(batch.shape[0]):
        for k in range(batch.shape[1]):
            batch[b, k] = rows[indices[b], k]
        for k in range(next_observations.shape[1]):
            next_observations[b, k] = drawn_next_observations[b, k]
        dones[b, 0] *= _ONE - timeouts[b, 0]


@_compile
def affine_row(inputs, weight, bias, outputs, relu):
    """
    Apply a linear layer to one row.

    :param inputs: (m,)
    :param weight: (n, m)
    :param bias: (n,)
    :param outputs: (n,), written
    :param relu: whether to apply a ReLU
    """
    for k in range(weight.shape[0]):
        total = _ZERO
        for i in range(weight.shape[1]):
            total += weight[k, i] * inputs[i]
        total += bias[k]
        outputs[k] = _ZERO if relu and total < _ZERO else total
