"""The update against an independent transcription of Algorithm 1, and which weights it may change."""

import copy

import numpy as np
import pytest
import torch as th
from torch import nn

from sb3_tdc import TDC
from tests.helpers.tdc import BATCH, BatchQueue, make_model, random_batches
from tests.helpers.tdc_reference import Reference


def double(module):
    return (module.weight.detach().double().clone(), module.bias.detach().double().clone())


def reference_of(model, **kwargs):
    actor = model.actor
    if model.stochastic_actor:
        latent = [double(m) for m in actor.latent_pi if isinstance(m, th.nn.Linear)]
        networks = {"latent": latent, "mu": double(actor.mu), "log_std": double(actor.log_std)}
    else:
        networks = {"mu": [double(m) for m in actor.mu if isinstance(m, th.nn.Linear)]}
    stacked = [layer for layer in model.critic.layers if hasattr(layer, "weight")]
    critics = [
        [(la.weight[i].detach().double().T.clone(), la.bias[i, 0].detach().double().clone()) for la in stacked]
        for i in range(model.critic.n_critics)
    ]
    return Reference(networks, critics, stochastic=model.stochastic_actor, **kwargs)


def actor_weights(actor):
    return [p.detach().double() for p in actor.parameters()]


def critic_weights(critic):
    """Return (out, in) weights and biases, critic by critic, as the reference keeps them."""
    stacked = [layer for layer in critic.layers if hasattr(layer, "weight")]
    return [
        t.detach().double()
        for i in range(critic.n_critics)
        for layer in stacked
        for t in (layer.weight[i].T, layer.bias[i, 0])
    ]


def reference_actor_weights(networks):
    parts = [networks[k] for k in ("latent", "mu", "log_std") if k in networks]
    return [t.detach() for part in parts for pair in (part if isinstance(part, list) else [part]) for t in pair]


@pytest.mark.parametrize("fused", [False, True], ids=["readable", "fused"])
@pytest.mark.parametrize("stochastic", [False, True], ids=["deterministic", "stochastic"])
@pytest.mark.parametrize(("n_critics", "lam", "kappa"), [(2, 0.9, 1.0), (2, 0.0, 0.0), (1, 1.0, 0.3), (3, 0.5, 10.0)])
def test_updates_equal_algorithm_1(monkeypatch, stochastic, fused, n_critics, lam, kappa):
    """Five updates (two of them delayed): every weight, every target weight, and the temperature."""
    settings = {"lam": lam, "kappa": kappa, "gamma": 0.97, "tau": 0.05}
    model = make_model(
        stochastic_actor=stochastic,
        fused=fused,
        learning_rate=1e-2,
        qf_learning_rate=2e-2,
        policy_delay=2,
        target_policy_noise=0.5,
        target_noise_clip=0.3,
        policy_kwargs={"n_critics": n_critics},
        **settings,
    )
    reference = reference_of(model, delay=2, noise_std=0.5, noise_clip=0.3, lr=1e-2, qf_lr=2e-2, **settings)
    batches = list(random_batches(5))
    model.replay_buffer = BatchQueue(batches)

    # Noise by hand: the same standard normal numbers for both, in the order in which they are drawn
    noises = []

    def draw(shape):
        noise = th.randn(shape, generator=th.Generator().manual_seed(100 + len(noises)))
        noises.append(noise.double())
        return noise

    monkeypatch.setattr(
        th.Tensor, "normal_", lambda tensor, mean=0, std=1: tensor.copy_(mean + std * draw(tensor.shape))
    )
    monkeypatch.setattr(th, "randn_like", lambda tensor: draw(tensor.shape))
    monkeypatch.setattr(
        th.distributions.Normal, "rsample", lambda self, shape=(): self.loc + self.scale * draw(self.loc.shape)
    )
    for update, batch in enumerate(batches, start=1):
        noises.clear()
        model.train(gradient_steps=1, batch_size=BATCH)
        states, actions, next_states, dones, rewards = (t.double() for t in batch)
        transitions = list(zip(states, actions, rewards[:, 0].tolist(), next_states, dones[:, 0].tolist(), strict=True))
        assert len(noises) == (2 if stochastic and update % 2 == 0 else 1)
        reference.update(transitions, noises[0], noises[-1])

    def check(actual, expected):
        assert len(actual) == len(expected)
        for a, e in zip(actual, expected, strict=True):
            th.testing.assert_close(a, e, rtol=1e-4, atol=2e-6)

    check(critic_weights(model.critic), [t.detach() for c in reference.critics for pair in c for t in pair])
    check(critic_weights(model.critic_target), [t.detach() for c in reference.target_critics for p in c for t in p])
    check(actor_weights(model.actor), reference_actor_weights(reference.actor))
    check(actor_weights(model.actor_target), reference_actor_weights(reference.target_actor))
    if stochastic:
        check([model.log_ent_coef.detach().double()], [reference.log_alpha.detach()])


def snapshot(model):
    state = copy.deepcopy({k: v.clone() for k, v in model.policy.state_dict().items()})
    if model.stochastic_actor:
        state["log_ent_coef"] = model.log_ent_coef.detach().clone()
    return state


@pytest.mark.parametrize("fused", [False, True], ids=["readable", "fused"])
@pytest.mark.parametrize("stochastic", [False, True], ids=["deterministic", "stochastic"])
def test_delay_moves_actor_and_targets_only_every_third_update(stochastic, fused):
    model = make_model(stochastic_actor=stochastic, policy_delay=3, fused=fused)
    model.replay_buffer = BatchQueue(random_batches(6))
    for update in range(1, 7):
        before = snapshot(model)
        model.train(gradient_steps=1, batch_size=BATCH)
        after = snapshot(model)
        moved = {name.split(".")[0] for name in before if not th.equal(before[name], after[name])}
        delayed = {"actor", "actor_target", "critic_target"} | ({"log_ent_coef"} if stochastic else set())
        assert moved == {"critic"} | (delayed if update % 3 == 0 else set())


def test_actor_step_leaves_no_gradient_in_the_critics():
    model = make_model(policy_delay=1, fused=False)
    model.replay_buffer = BatchQueue(random_batches(2))
    gradients = []
    step = model.actor.optimizer.step
    model.actor.optimizer.step = lambda *a, **k: (gradients.extend(_gradients(model.critic)), step(*a, **k))
    model.critic.optimizer.step = lambda *a, **k: gradients.extend(_gradients(model.critic))
    model.train(gradient_steps=1, batch_size=BATCH)
    half = len(gradients) // 2
    assert all(th.equal(a, b) for a, b in zip(gradients[:half], gradients[half:], strict=True))


def test_gradients_lie_in_memory_as_their_parameters_do():
    """A transposed product computes them in another layout, while the fused Adam assumes that of the parameters."""
    inputs, start = th.randn(2, 5, 4), th.randn(2, 3, 4)

    def transposed_product(weight):
        return th.bmm(inputs, weight.transpose(1, 2)).square().sum()

    expected, weight = (nn.Parameter(start.clone()) for _ in range(2))
    plain = th.optim.Adam([expected], lr=0.1, foreach=False)
    fused = th.optim.Adam([weight], lr=0.1, fused=True)
    for _ in range(3):
        plain.zero_grad()
        transposed_product(expected).backward()
        plain.step()
        TDC._minimize(transposed_product(weight), fused)
    th.testing.assert_close(weight, expected)


def _gradients(module):
    return [p.grad.clone() for p in module.parameters()]


def test_only_terminations_cut_the_bootstrap():
    """Episodes end in turn by a time-out at step 5 and by termination at step 7: the target sees only the latter."""
    model = make_model(learning_starts=0, gradient_steps=0)
    model.learn(36)
    ends = [t % 12 in (5, 0) for t in range(1, 37)]
    terminations = [float(t % 12 == 0) for t in range(1, 37)]
    assert model.replay_buffer.dones[:36, 0].tolist() == [float(e) for e in ends]
    assert model.replay_buffer._get_samples(np.arange(36)).dones[:, 0].tolist() == terminations
