"""Every compiled loop computes what its twin in PyTorch does, on any values and shapes; NaN included."""

import inspect
import subprocess
import sys

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_tdc.tdc import kernels
from sb3_tdc.tdc.compiled import load_kernels
from sb3_tdc.tdc.fused import passes
from sb3_tdc.tdc.fused.passes import Passes

TWINS = {
    name: function
    for name, function in vars(passes).items()
    if callable(function) and name.islower() and getattr(function, "__module__", "") == passes.__name__
    if not name.startswith("_")
}
sizes = st.integers(1, 9)


def arguments_of(name, rng, c, b, n, m):
    """
    Make the arguments of a pass for C = c, B = b, N = n, M = m.

    :return: tensors, numbers, and how many tensors at the end are results
    """

    def real(*shape, scale=3.0):
        return th.from_numpy(rng.normal(size=shape, scale=scale).astype(np.float32))

    def bits(*shape):
        return th.from_numpy(rng.integers(0, 2, shape).astype(np.float32))

    if name == "quantile_huber_gradient":
        return [real(c, b, n), real(b, m), real(c, b, n), real(c, 1, n)], [float(rng.choice([0, 0.1, 1, 10]))], 2
    if name == "lcb_target":
        columns = [real(b, 1), bits(b, 1), bits(b, 1), real(1).abs()]
        return [real(c, b, n), *columns, real(c, b), real(c, b), th.zeros(b, dtype=th.int64), real(b, n)], [], 4
    if name == "squash":
        return [real(b, n), real(b, n + 2)[:, 1:-1]], [], 2
    if name == "tanh_backward":
        return [real(b, n), real(b, n).tanh(), real(1, n)], [], 3
    if name == "smooth_actions":
        noise = real(b, n)
        return [noise, real(b, n).tanh()], [0.5], 1
    if name == "sample_actions":
        return [real(b, n), real(b, n, scale=10), real(b, n), real(b, n), real(b, n)], [], 5
    sample = real(b, n, scale=1).tanh()  # away from ±1, where 1 − a² is lost to rounding in float32
    if name == "log_density":
        return [sample, real(b, n, scale=10), real(b, n), real(b)], [], 1
    if name == "tanh_gaussian_backward":
        results = real(b, n), real(1, n), real(1, n)
        return [real(b, n), real(1).abs(), sample, real(b, n, scale=10), real(b, n), *results], [], 8
    if name == "mean_value":
        return [real(b, n).relu(), real(n, m), real(1, m), real(b, n), real(b)], [], 2
    if name == "gather":
        rows, batch = real(20, 2 * n + m + 3), real(b, 2 * n + m + 3)
        rows[:, -2:] = bits(20, 2)
        drawn, dones, timeouts = batch[:, n + m : 2 * n + m], batch[:, -2:-1], batch[:, -1:]
        return [rows, batch, drawn, real(b, n + m)[:, :n], dones, timeouts], [rng.integers(0, 20, b)], 5
    raise AssertionError(f"{name} needs arguments here")


@pytest.mark.parametrize("name", TWINS)
@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), c=st.integers(1, 3), b=sizes, n=sizes, m=sizes, broken=st.booleans())
def test_a_compiled_loop_is_its_twin(name, seed, c, b, n, m, broken):
    results = []
    for loops in (kernels, None):
        tensors, numbers, n_results = arguments_of(name, np.random.default_rng(seed), c, b, n, m)
        if broken:  # a NaN must show in the same results
            tensors[0].view(-1)[seed % tensors[0].numel()] = float("nan")
        Passes(loops)(TWINS[name], *tensors)(*numbers)
        results.append(tensors[-n_results:])
    for compiled, expected in zip(*results, strict=True):
        scale = float(expected.double().nan_to_num().abs().max()) + 1e-3
        # A sum over the minibatch may cancel to a result much smaller than its terms
        th.testing.assert_close(compiled / scale, expected / scale, rtol=1e-4, atol=1e-4, equal_nan=True)


def test_every_twin_takes_the_same_arguments():
    assert len(TWINS) >= 10
    for name, twin in TWINS.items():
        parameters = list(inspect.signature(twin).parameters)
        if isinstance(twin, type):
            parameters += list(inspect.signature(twin.__call__).parameters)[1:]
        assert list(inspect.signature(getattr(kernels, name).py_func).parameters) == parameters, name


def test_a_linear_layer_of_one_row():
    rng = np.random.default_rng(0)
    x, weight, bias = (rng.normal(size=shape).astype(np.float32) for shape in ((5,), (7, 5), (7,)))
    out = np.empty(7, np.float32)
    for relu in (False, True):
        kernels.affine_row(x, weight, bias, out, relu)
        expected = weight.astype(np.float64) @ x + bias
        np.testing.assert_allclose(out, np.maximum(expected, 0) if relu else expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    "without",
    ["import sys; sys.modules['numba'] = None", "import os; os.environ['NUMBA_DISABLE_JIT'] = '1'"],
    ids=["Numba is missing", "its compiler is disabled"],
)
def test_without_numba_there_are_no_compiled_loops(without):
    code = f"{without}\nfrom sb3_tdc.tdc.compiled import load_kernels; print(load_kernels())"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "None"
    assert load_kernels() is kernels
