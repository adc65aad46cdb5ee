"""The mathematics of the flow and its exact soft values, in float64."""

import math
from itertools import pairwise

import pytest
import torch as th
from gymnasium import spaces

from sb3_tdc.meow.flow import MAX_ACTION
from sb3_tdc.meow.policies import MEOWPolicy

DIMENSIONS = pytest.mark.parametrize("action_dim", [1, 2, 5])


def draw(action_dim, n=7, obs_dim=3):
    """Observations, and actions well inside [-1, 1]."""
    return th.randn(n, obs_dim, dtype=th.float64), 1.8 * th.rand(n, action_dim, dtype=th.float64) - 0.9


@DIMENSIONS
def test_q_minus_v_is_the_log_density(make_policy, action_dim):
    """The density is computed independently: a diagonal Gaussian of z by torch, and the Jacobian by autograd."""
    network = make_policy(action_dim=action_dim).network
    obs, actions = draw(action_dim)
    q, v = network(obs, actions)
    z, _ = network.flow.inverse(actions, obs)
    prior = th.distributions.Normal(0.0, network.flow.log_std(obs).exp())
    for i in range(len(obs)):
        jacobian = th.autograd.functional.jacobian(
            lambda a, i=i: network.flow.inverse(a, obs[i : i + 1]).z, actions[i : i + 1]
        )
        log_det = th.linalg.slogdet(jacobian.reshape(action_dim, action_dim)).logabsdet
        log_prob = prior.log_prob(z)[i].sum() + log_det
        assert th.allclose((q - v)[i], log_prob.expand(2), atol=1e-10)
        assert th.allclose(network.flow.log_prob(actions, obs)[i], log_prob, atol=1e-10)


def test_v_depends_on_the_state_and_not_on_the_action(make_policy):
    network = make_policy().network
    obs, actions = draw(2)
    v = network(obs, actions).v
    assert th.equal(network(obs, -actions).v, v)
    assert th.allclose(network.values(obs), v)
    assert (network.values(obs + 1) - v).abs().min() > 1e-3
    assert (v[:, 0] - v[:, 1]).abs().min() > 1e-3  # two reward shifts


def test_the_density_integrates_to_one(make_policy):
    """∫ exp((Q − V)/α) da over (−1, 1), by the trapezoidal rule in u = atanh a."""
    network = make_policy(action_dim=1).network
    u = th.linspace(-6.1, 6.1, 20_001, dtype=th.float64)
    actions = th.tanh(u).unsqueeze(1)
    for obs in th.randn(3, 1, 3, dtype=th.float64):
        q, v = network(obs.expand(len(u), -1), actions)
        density = (q - v).exp()[:, 0] * (1 - actions[:, 0] ** 2)
        assert th.trapezoid(density, u).item() == pytest.approx(1.0, abs=1e-6)


def test_v_is_the_soft_maximum_of_q(make_policy):
    """V = α log ∫ exp(Q/α) da, from Q alone, in two dimensions."""
    network = make_policy(action_dim=2).network
    u = th.linspace(-6.1, 6.1, 401, dtype=th.float64)
    grid = th.cartesian_prod(u, u)
    obs = th.randn(1, 3, dtype=th.float64)
    actions = th.tanh(grid)
    q, v = network(obs.expand(len(grid), -1), actions)
    integrand = q.exp() * (1 - actions.square()).prod(dim=1, keepdim=True)
    assert th.allclose((integrand.sum(dim=0) * (u[1] - u[0]) ** 2).log(), v[0], atol=1e-4)


@DIMENSIONS
def test_inverse_undoes_the_flow(make_policy, action_dim):
    flow = make_policy(action_dim=action_dim).network.flow
    obs, actions = draw(action_dim)
    assert th.allclose(flow(flow.inverse(actions, obs).z, obs), actions, atol=1e-12)
    z = 0.5 * th.randn(7, action_dim, dtype=th.float64)
    assert th.allclose(flow.inverse(flow(z, obs), obs).z, z, atol=1e-9)


@DIMENSIONS
def test_log_determinant_is_that_of_autograd(make_policy, action_dim):
    flow = make_policy(action_dim=action_dim).network.flow
    obs, actions = draw(action_dim, n=1)
    z, log_det = flow.inverse(actions, obs)
    jacobian = th.autograd.functional.jacobian(lambda z: flow(z, obs), z).reshape(action_dim, action_dim)
    assert th.allclose(th.linalg.slogdet(jacobian).logabsdet, log_det, atol=1e-10)


def test_couplings_alone_preserve_volume_and_move_every_dimension(make_policy):
    flow = make_policy(action_dim=4).network.flow
    obs, z = th.randn(1, 3, dtype=th.float64), th.randn(1, 4, dtype=th.float64)

    def shifted(z):
        for coupling in flow.couplings:
            z = z + coupling.shift(z, obs)
        return z

    jacobian = th.autograd.functional.jacobian(shifted, z).reshape(4, 4)
    assert th.linalg.det(jacobian) == pytest.approx(1.0, abs=1e-10)
    assert (jacobian - th.eye(4)).abs().min() > 0  # every action depends on all latent variables


def test_masks_alternate_beginning_with_the_even_dimensions(make_policy):
    masks = [coupling.mask.tolist() for coupling in make_policy(action_dim=3).network.flow.couplings]
    assert masks == [[1, 0, 1], [0, 1, 0], [1, 0, 1], [0, 1, 0]]


def test_samples_have_the_density(make_policy):
    """Samples in each of ten intervals against the integral of exp(log π)."""
    flow = make_policy(action_dim=1, log_std_max=0.5).network.flow
    obs = th.randn(1, 3, dtype=th.float64)
    n, edges = 40_000, th.linspace(-1, 1, 11, dtype=th.float64)
    actions = flow.sample(obs.expand(n, -1))[:, 0]
    for low, high in pairwise(edges):
        fine = th.linspace(float(low), float(high), 2001, dtype=th.float64).clamp(-MAX_ACTION, MAX_ACTION)
        expected = th.trapezoid(flow.log_prob(fine.unsqueeze(1), obs.expand(len(fine), -1)).exp(), fine)
        found = ((actions >= low) & (actions < high)).double().mean()
        assert abs(found - expected) < 5 * math.sqrt(0.25 / n)


@DIMENSIONS
def test_the_deterministic_action_is_the_mode_before_the_tanh(make_policy, action_dim):
    """The density of u = atanh a is largest there, and its gradient vanishes."""
    policy = make_policy(action_dim=action_dim)
    flow, obs = policy.network.flow, th.randn(1, 3, dtype=th.float64)

    def log_density(u):
        actions = th.tanh(u)
        return flow.log_prob(actions, obs.expand(len(u), -1)) + (1 - actions.square()).log().sum(dim=1)

    mode = policy._predict(obs, deterministic=True)
    u = th.atanh(mode).detach().requires_grad_(True)
    (slope,) = th.autograd.grad(log_density(u).sum(), u)
    assert slope.abs().max() < 1e-8
    others = u.detach() + th.randn(500, action_dim, dtype=th.float64) * th.logspace(-3, 0.3, 500).unsqueeze(1)
    assert (log_density(others) < log_density(u)).all()


def test_log_std_stays_between_its_limits_and_begins_in_the_middle(make_policy):
    obs = 100 * th.randn(200, 3, dtype=th.float64)
    log_std = make_policy(log_std_min=-5, log_std_max=2, scale=3.0).network.flow.log_std(obs)
    assert log_std.min().item() == pytest.approx(-5, abs=0.1)
    assert log_std.max().item() == pytest.approx(2, abs=0.1)
    fresh = make_policy(log_std_min=-4, log_std_max=2, scale=0.0).network.flow
    assert th.allclose(fresh.log_std(obs), fresh.log_std(obs[:1]))  # weights start at 0
    with th.no_grad():
        for parameter in fresh.prior.parameters():
            parameter.zero_()
    assert fresh.log_std(obs).unique().tolist() == [-1.0]


@pytest.mark.parametrize("border", [-1.0, 1.0])
def test_actions_on_the_border_have_finite_values(make_policy, border):
    """1 − (1 − 10⁻⁵)² is 2·10⁻⁵, and its logarithm −10.8."""
    network = make_policy().float().network
    obs = th.randn(4, 3)
    actions = th.full((4, 2), border)
    assert all(value.isfinite().all() for value in network(obs, actions))
    assert network.flow.inverse(actions, obs).log_det.tolist() == pytest.approx([2 * math.log(2e-5)] * 4, rel=1e-3)


def test_dropout_acts_in_training_mode_alone(make_policy):
    policy = make_policy(dropout=0.5)
    obs, actions = draw(2)
    first = policy.network(obs, actions).q
    assert th.equal(policy.network(obs, actions).q, first)
    policy.set_training_mode(True)
    assert not th.equal(policy.network(obs, actions).q, policy.network(obs, actions).q)
    assert not any(module.training for module in policy.network_target.modules())
    policy.set_training_mode(False)
    assert th.equal(policy.network(obs, actions).q, first)


def test_halfcheetah_has_the_number_of_parameters_of_the_paper():
    """Four couplings, σ(s) and two reward shifts for 17 observations and 6 actions, counted by hand."""
    hidden = 64 + 64 + 64  # LayerNorm's weight and bias, Swish's β
    coupling = ((6 + 17) * 64 + 64 + hidden) + (64 * 64 + 64 + hidden) + (64 * 6 + 6)
    prior = (17 * 64 + 64 + 64) + (64 * 64 + 64 + 64) + (64 * 6 + 6)
    shift = (17 * 256 + 256 + 256) + (256 * 256 + 256 + 256) + (256 + 1)
    boxes = [spaces.Box(-1, 1, (n,)) for n in (17, 6)]
    policy = MEOWPolicy(*boxes, lambda _: 1e-3)
    n_parameters = sum(parameter.numel() for parameter in policy.network.parameters())
    assert n_parameters == 4 * coupling + prior + 2 * shift == 174_048
