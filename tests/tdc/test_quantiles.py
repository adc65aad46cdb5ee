"""The loss, its gradient and the target, against float64 all-pairs references and by hand."""

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sb3_tdc.tdc import quantiles as q

pytestmark = pytest.mark.usefixtures("loops")
KAPPAS = [0.0, 0.1, 1.0, 10.0]


def all_pairs(current, target, kappa):
    """Return Eq. 8–10 in float64 through all pairs, and its gradient by autograd."""
    z = current.detach().double().requires_grad_()
    n = z.shape[2]
    levels = (2 * th.arange(1, n + 1, dtype=th.float64) - 1) / (2 * n)
    delta = target.double()[:, None, None, :] - z[:, :, :, None]  # (B, C, k, j)
    size = delta.abs()
    huber = th.where(size <= kappa, delta**2 / 2, kappa * (size - kappa / 2)) if kappa > 0 else size
    rho = (levels[:, None] - (delta.detach() < 0).double()).abs() * huber
    loss = rho.mean(dim=(2, 3)).sum(dim=1).mean()
    loss.backward()
    return loss.detach(), z.grad


def assert_matches_reference(current, target, kappa):
    leaf = current.clone().requires_grad_()
    loss = q.quantile_huber_loss(leaf, target, kappa)
    loss.backward()
    expected, gradient = all_pairs(current, target, kappa)
    th.testing.assert_close(loss.detach().double(), expected, rtol=2e-6, atol=1e-30)
    largest = gradient.abs().max().item()
    th.testing.assert_close(leaf.grad.double(), gradient, rtol=0, atol=max(1e-6 * largest, 1e-30))
    assert th.equal(leaf.grad, q.quantile_huber_gradient(current, target, kappa))


@pytest.mark.parametrize("kappa", KAPPAS)
@pytest.mark.parametrize("n_quantiles", [1, 2, 25, 64, 200])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e2, 1e5])
def test_loss_and_gradient_are_exact_to_float32(kappa, n_quantiles, scale):
    generator = th.Generator().manual_seed(n_quantiles)
    # The critics' layout, (C, B, N) transposed: not contiguous; with N = 200 many chunks of rows
    current = (th.randn(2, 40, n_quantiles, generator=generator) * scale).transpose(0, 1)
    target = th.randn(40, n_quantiles, generator=generator) * scale
    assert_matches_reference(current, target, kappa)
    assert_matches_reference(current + 10 * scale, target + 10 * scale, kappa)  # returns far from 0
    assert_matches_reference(current, target[:, :1], kappa)  # another number of targets


@pytest.mark.parametrize("kappa", KAPPAS)
def test_ties_have_no_slope(kappa):
    current = th.tensor([[[1.0, 2.0, 2.0]], [[5.0, 5.0, 5.0]]])
    target = th.tensor([[2.0, 1.0], [5.0, 5.0]])
    assert_matches_reference(current, target, kappa)
    assert q.quantile_huber_gradient(current, target, kappa)[1].abs().sum() == 0


def test_loss_by_hand():
    # One transition, one critic, N = 2 (levels 1/4 and 3/4), κ = 1. z = (0, 3), y = (2, 2.5)
    # k=1: δ = 2, 2.5: L = 1.5, 2.0, weight 1/4 → 0.375, 0.5
    # k=2: δ = -1, -0.5: L = 0.5, 0.125, weight 1/4 → 0.125, 0.03125.  Mean of the four: 1.03125 / 4
    current, target = th.tensor([[[0.0, 3.0]]]), th.tensor([[2.0, 2.5]])
    assert q.quantile_huber_loss(current, target, 1.0).item() == pytest.approx(1.03125 / 4)
    # Slopes: k=1: -(1/4)(1 + 1)/4, k=2: +(1/4)(1 + 0.5)/4
    assert q.quantile_huber_gradient(current, target, 1.0)[0, 0].tolist() == pytest.approx([-0.125, 0.09375])


def test_loss_is_summed_over_critics_and_averaged_over_transitions():
    generator = th.Generator().manual_seed(0)
    current, target = th.randn(6, 3, 5, generator=generator), th.randn(6, 5, generator=generator)
    parts = [
        q.quantile_huber_loss(current[b : b + 1, c : c + 1], target[b : b + 1], 1.0) for b in range(6) for c in range(3)
    ]
    assert q.quantile_huber_loss(current, target, 1.0).item() == pytest.approx(sum(parts).item() / 6, rel=1e-5)


def test_gradient_scales_with_what_comes_after_the_loss():
    current, target = th.randn(4, 2, 8, requires_grad=True), th.randn(4, 8)
    (-3 * q.quantile_huber_loss(current, target, 1.0)).backward()
    th.testing.assert_close(current.grad, -3 * q.quantile_huber_gradient(current, target, 1.0))


@settings(max_examples=60, deadline=None)
@given(
    current=arrays(np.float32, (3, 2, 4), elements=st.floats(-100, 100, width=32)),
    target=arrays(np.float32, (3, 5), elements=st.floats(-100, 100, width=32)),
    kappa=st.sampled_from(KAPPAS),
)
def test_loss_matches_reference_on_any_values(current, target, kappa):
    leaf = th.from_numpy(current).requires_grad_()
    loss = q.quantile_huber_loss(leaf, th.from_numpy(target), kappa)
    expected, gradient = all_pairs(leaf, th.from_numpy(target), kappa)
    loss.backward()
    th.testing.assert_close(loss.detach().double(), expected, rtol=1e-5, atol=1e-30)
    th.testing.assert_close(leaf.grad.double(), gradient, rtol=0, atol=1e-6 * max(1.0, gradient.abs().max().item()))


def test_the_median_minimises_plain_quantile_regression():
    """An independent property: with N = 1 and κ = 0 the minimum is the sample median."""
    target = th.tensor([[1.0, 2.0, 7.0, 50.0, 60.0]])
    z = th.zeros(1, 1, 1)
    for _ in range(400):
        z -= 0.2 * q.quantile_huber_gradient(z, target, 0.0)
    assert z.item() == pytest.approx(7.0, abs=0.2)


def test_the_loss_refuses_wrong_shapes_and_a_live_target():
    with pytest.raises(ValueError, match=r"current must be \(B, C, N\).*got \(4, 8\)"):
        q.quantile_huber_loss(th.zeros(4, 8), th.zeros(4, 8))
    with pytest.raises(ValueError, match="same B"):
        q.quantile_huber_gradient(th.zeros(3, 2, 8), th.zeros(4, 8))
    with pytest.raises(ValueError, match="target must not require a gradient"):
        q.quantile_huber_loss(th.zeros(4, 2, 8), th.zeros(4, 8, requires_grad=True))


def test_std_is_the_population_one():
    mean, std = q.mean_and_std(th.tensor([[[1.0, 3.0], [2.0, 2.0]]]))
    assert mean.tolist() == [[2.0, 2.0]]
    assert std.tolist() == [[1.0, 0.0]]  # not √2


def test_midpoints():
    assert q.quantile_midpoints(4).tolist() == [0.125, 0.375, 0.625, 0.875]


def test_selection_by_hand():
    # Scores at λ = 1: (2 − 1, 1.5 − 0) → the first, with the larger mean; at λ = 0 the second
    mean, std = th.tensor([[2.0, 1.5]]), th.tensor([[1.0, 0.0]])
    assert q.select_critic(mean, std, 1.0).tolist() == [0]
    assert q.select_critic(mean, std, 0.0).tolist() == [1]
    # At equal means it is the wider critic (docs/differences.md)
    assert q.select_critic(th.tensor([[1.0, 1.0]]), th.tensor([[0.1, 0.2]]), 0.5).tolist() == [1]


quantile_sets = arrays(np.float32, (6, 3, 4), elements=st.floats(-50, 50, width=32))


@settings(max_examples=100, deadline=None)
@given(quantile_sets, st.floats(0.01, 5.0))
def test_lambda_never_lowers_the_mean_of_the_target(values, lam):
    tensor = th.from_numpy(values)
    mean, std = q.mean_and_std(tensor)
    at_zero = q.take_critic(tensor, q.select_critic(mean, std, 0.0)).mean(dim=1)
    th.testing.assert_close(at_zero, th.from_numpy(values.mean(axis=2).min(axis=1)), rtol=1e-5, atol=1e-5)
    with_lambda = q.take_critic(tensor, q.select_critic(mean, std, lam)).mean(dim=1)
    assert (with_lambda >= at_zero - 1e-5).all()


def test_target_by_hand_and_its_broadcasting_trap():
    quantiles = th.tensor([[1.0, 2.0], [3.0, 4.0]])
    rewards, dones = th.tensor([[10.0], [20.0]]), th.tensor([[0.0], [1.0]])
    assert q.td_target(rewards, dones, 0.5, quantiles).tolist() == [[10.5, 11.0], [20.0, 20.0]]
    discounts = th.tensor([[0.1], [0.2]])
    assert q.td_target(rewards, th.zeros(2, 1), discounts, quantiles).tolist() == [
        pytest.approx([10.1, 10.2]),
        pytest.approx([20.6, 20.8]),
    ]
    with pytest.raises(ValueError, match=r"rewards must have shape \(2, 1\), got \(2,\)"):
        q.td_target(rewards[:, 0], dones, 0.5, quantiles)
    with pytest.raises(ValueError, match=r"discounts must have shape \(2, 1\), got \(2, 2\)"):
        q.td_target(rewards, dones, quantiles, quantiles)
