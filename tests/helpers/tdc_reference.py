"""
Algorithm 1 of the paper, transcribed loop by loop in float64, for tests only.

It shares nothing with the package but the values of the weights. Every network is a plain list of layers
``[(W, b), ...]`` with ``W`` of shape (out, in); gradients come from autograd through the naive all-pairs loss.
"""

import math

import torch as th

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0  # SAC's


def mlp(layers, x):
    for i, (weight, bias) in enumerate(layers):
        x = weight @ x + bias
        if i < len(layers) - 1:
            x = th.clamp(x, min=0.0)
    return x


def mean_action(actor, s, stochastic):
    if stochastic:
        h = th.clamp(mlp(actor["latent"], s), min=0.0) if actor["latent"] else s
        return th.tanh(actor["mu"][0] @ h + actor["mu"][1])
    return th.tanh(mlp(actor["mu"], s))


def sample_action(actor, s, noise):
    """Return a sample of Eq. 21 and its log density."""
    h = th.clamp(mlp(actor["latent"], s), min=0.0)
    mu = actor["mu"][0] @ h + actor["mu"][1]
    log_std = th.clamp(actor["log_std"][0] @ h + actor["log_std"][1], LOG_STD_MIN, LOG_STD_MAX)
    log_prob = th.zeros((), dtype=th.float64)
    action = []
    for m, ls, e in zip(mu, log_std, noise, strict=True):
        u = m + th.exp(ls) * e
        a = th.tanh(u)
        log_prob = log_prob - 0.5 * e**2 - ls - 0.5 * math.log(2 * math.pi) - th.log(1 - a**2 + 1e-6)
        action.append(a)
    return th.stack(action), log_prob


def quantiles(critic, s, a):
    return mlp(critic, th.cat([s, a]))


def quantile_huber(z, y, kappa):
    """Return the mean of Eq. 8–9 over all pairs (k, j)."""
    n, total = len(z), th.zeros((), dtype=th.float64)
    for k in range(n):
        level = (2 * (k + 1) - 1) / (2 * n)
        for j in range(len(y)):
            delta = y[j] - z[k]
            if kappa == 0:
                huber = abs(delta)
            elif abs(delta) <= kappa:
                huber = delta**2 / 2
            else:
                huber = kappa * (abs(delta) - kappa / 2)
            total = total + abs(level - (1.0 if delta < 0 else 0.0)) * huber
    return total / (n * len(y))


def select(critics_quantiles, lam):
    """Return the quantiles of the critic that Eq. 4–5 select."""
    best, best_score = None, None
    for z in critics_quantiles:
        mu = sum(z) / len(z)
        sigma = math.sqrt(sum((x - mu) ** 2 for x in z) / len(z))
        if best is None or mu - lam * sigma < best_score:
            best, best_score = z, mu - lam * sigma
    return best


class Adam:
    def __init__(self, parameters, lr):
        self.parameters, self.lr, self.t = parameters, lr, 0
        self.m = [th.zeros_like(p) for p in parameters]
        self.v = [th.zeros_like(p) for p in parameters]

    def step(self, gradients):
        self.t += 1
        for p, g, m, v in zip(self.parameters, gradients, self.m, self.v, strict=True):
            m.mul_(0.9).add_(0.1 * g)
            v.mul_(0.999).add_(0.001 * g**2)
            p.data -= self.lr * (m / (1 - 0.9**self.t)) / ((v / (1 - 0.999**self.t)).sqrt() + 1e-8)


def flatten(network):
    layers = [pair for part in network.values() for pair in (part if isinstance(part, list) else [part])]
    return [tensor for pair in layers for tensor in pair]


class Reference:
    """State of the algorithm and :meth:`update`, one pass of Algorithm 1 from the minibatch to the targets."""

    def __init__(self, actor, critics, *, stochastic, lam, kappa, gamma, tau, delay, noise_clip, noise_std, lr, qf_lr):
        self.actor, self.critics = actor, critics
        self.target_actor = {
            k: [(w.clone(), b.clone()) for w, b in v] if isinstance(v, list) else tuple(t.clone() for t in v)
            for k, v in actor.items()
        }
        self.target_critics = [[(w.clone(), b.clone()) for w, b in critic] for critic in critics]
        self.stochastic, self.lam, self.kappa, self.gamma = stochastic, lam, kappa, gamma
        self.tau, self.delay, self.noise_clip, self.noise_std = tau, delay, noise_clip, noise_std
        self.actor_parameters = flatten(actor)
        self.critic_parameters = [t for critic in critics for pair in critic for t in pair]
        for p in [*self.actor_parameters, *self.critic_parameters]:
            p.requires_grad_(True)
        self.actor_adam = Adam(self.actor_parameters, lr)
        self.critic_adam = Adam(self.critic_parameters, qf_lr)
        self.log_alpha = th.zeros(1, dtype=th.float64, requires_grad=True)
        self.alpha_adam = Adam([self.log_alpha], lr)
        self.t = 0

    def update(self, batch, target_noise, actor_noise):
        """
        Update the weights once.

        :param batch: (s, a, r, s', d) per transition
        :param target_noise: standard normal, per transition
        :param actor_noise: standard normal, per transition
        :return: the critics' loss
        """
        self.t += 1
        loss = th.zeros((), dtype=th.float64)
        for (s, a, r, s_next, d), noise in zip(batch, target_noise, strict=True):
            with th.no_grad():
                if self.stochastic:
                    a_next, _ = sample_action(self.target_actor, s_next, noise)  # Eq. 2
                else:  # Eq. 1
                    eps = [max(-self.noise_clip, min(self.noise_clip, float(e) * self.noise_std)) for e in noise]
                    a_next = mean_action(self.target_actor, s_next, False)
                    a_next = th.stack([th.clamp(x + e, -1, 1) for x, e in zip(a_next, eps, strict=True)])
                chosen = select([quantiles(c, s_next, a_next).tolist() for c in self.target_critics], self.lam)
                y = [r + self.gamma * (1 - d) * z for z in chosen]  # Eq. 6–7
            for critic in self.critics:
                loss = loss + quantile_huber(quantiles(critic, s, a), y, self.kappa)  # Eq. 10
        loss = loss / len(batch)
        self.critic_adam.step(th.autograd.grad(loss, self.critic_parameters))
        if self.t % self.delay == 0:
            self._update_actor(batch, actor_noise)
            self._update_targets()
        return float(loss.detach())

    def _update_actor(self, batch, actor_noise):
        actor_loss, alpha_loss = th.zeros((), dtype=th.float64), th.zeros((), dtype=th.float64)
        alpha = float(self.log_alpha.detach().exp())
        for (s, *_), noise in zip(batch, actor_noise, strict=True):
            if self.stochastic:
                a, log_prob = sample_action(self.actor, s, noise)
                actor_loss = actor_loss + alpha * log_prob - quantiles(self.critics[0], s, a).mean()  # Eq. 13
                entropy_target = -float(len(noise))
                alpha_loss = alpha_loss - self.log_alpha[0] * (log_prob.detach() + entropy_target)  # Eq. 14
            else:
                actor_loss = actor_loss - quantiles(self.critics[0], s, mean_action(self.actor, s, False)).mean()
        self.actor_adam.step(th.autograd.grad(actor_loss / len(batch), self.actor_parameters))
        if self.stochastic:
            self.alpha_adam.step(th.autograd.grad(alpha_loss / len(batch), [self.log_alpha]))

    def _update_targets(self):  # Eq. 16
        pairs = list(zip(flatten(self.actor), flatten(self.target_actor), strict=True))
        for critic, target in zip(self.critics, self.target_critics, strict=True):
            for layer, target_layer in zip(critic, target, strict=True):
                pairs += list(zip(layer, target_layer, strict=True))
        for online, target in pairs:
            target.data = self.tau * online.data + (1 - self.tau) * target.data
