"""Exploration noise for any action space, drawn for all environments at once; its scale may differ between them."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise, VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_tdc.common.checks import check_number


class NormalNoiseRange(NormalActionNoise):
    """
    Gaussian noise that is small in the first environment and large in the last, evenly spaced between (as in FastTD3).

    On its own, as in a single environment, the noise has the average of the smallest and largest standard deviation.

    :param mean: (n_actions,), the mean in every environment
    :param smallest: (n_actions,), the standard deviation in the first environment
    :param largest: (n_actions,), the standard deviation in the last environment
    """

    def __init__(self, mean: np.ndarray, smallest: np.ndarray, largest: np.ndarray):
        super().__init__(mean, (smallest + largest) / 2)
        self.smallest, self.largest = smallest, largest

    def __repr__(self) -> str:
        return f"NormalNoiseRange(mu={self._mu}, sigma={self.smallest} to {self.largest})"


class VectorizedNormalNoise(VectorizedActionNoise):
    """
    Gaussian ``VectorizedActionNoise`` that draws once for all environments: the same numbers as SB3's, but faster.

    ``mean`` and ``sigma``, (n_envs, *actions), may be changed in place.

    :param base_noise: noise of one environment
    :param n_envs: number of environments
    """

    def __init__(self, base_noise: NormalActionNoise, n_envs: int):
        self.n_envs = int(check_number("n_envs", n_envs, 1))
        self.base_noise = base_noise
        ends = [getattr(base_noise, name, base_noise._sigma) for name in ("smallest", "largest")]
        mean, smallest, largest = np.broadcast_arrays(base_noise._mu, *ends)
        self.mean = np.array(np.broadcast_to(mean, (self.n_envs, *mean.shape)), dtype=float)
        self.sigma = np.linspace(smallest, largest, self.n_envs)

    def __call__(self) -> np.ndarray:
        dtype: Any = self.base_noise._dtype  # type: ignore[attr-defined]
        return np.random.normal(self.mean, self.sigma).astype(dtype)

    def reset(self, indices: Iterable[int] | None = None) -> None:
        """Do nothing: each draw is independent of those before."""

    @property  # type: ignore[override]
    def noises(self) -> "tuple[_NoiseOfOne, ...]":
        """Return the noise of every environment, as views: changing one changes ``mean`` and ``sigma``."""
        return tuple(_NoiseOfOne(self, i) for i in range(self.n_envs))

    @noises.setter  # type: ignore[override]
    def noises(self, noises: Sequence[NormalActionNoise]) -> None:
        if len(noises) != self.n_envs or not all(isinstance(noise, NormalActionNoise) for noise in noises):
            raise ValueError(f"noises must be {self.n_envs} of NormalActionNoise, got {noises!r}")
        self.mean[:], self.sigma[:] = [noise._mu for noise in noises], [noise._sigma for noise in noises]

    def __repr__(self) -> str:
        return f"VecNoise(BaseNoise={self.base_noise!r}), n_envs={self.n_envs})"


class _NoiseOfOne(NormalActionNoise):
    """The noise of one of several environments: a view of its ``mean`` and ``sigma``."""

    def __init__(self, noise: VectorizedNormalNoise, index: int):
        self.noise, self.index = noise, index
        super().__init__(self._mu, self._sigma, noise.base_noise._dtype)  # type: ignore[attr-defined]

    @property
    def _mu(self) -> np.ndarray:
        return self.noise.mean[self.index]

    @_mu.setter
    def _mu(self, mean: np.ndarray) -> None:
        self.noise.mean[self.index] = mean

    @property
    def _sigma(self) -> np.ndarray:
        return self.noise.sigma[self.index]

    @_sigma.setter
    def _sigma(self, sigma: np.ndarray) -> None:
        self.noise.sigma[self.index] = sigma


def noise_of_all(noise: ActionNoise, n_envs: int) -> ActionNoise:
    """Return noise for several environments, made from the noise of one; for one environment, the noise itself."""
    if n_envs > 1:
        # A subclass may draw differently
        if isinstance(noise, NormalActionNoise) and type(noise) in (NormalActionNoise, NormalNoiseRange):
            return VectorizedNormalNoise(noise, n_envs)
        return VectorizedActionNoise(noise, n_envs)
    return noise


def _of_every_action(noise: ActionNoise, shape: tuple[int, ...]) -> ActionNoise:
    """
    Expand Gaussian noise with a scalar mean and standard deviation to all actions; return other noise unchanged.

    NumPy would otherwise draw one number for all actions.
    """
    one: Any = noise.base_noise if isinstance(noise, VectorizedActionNoise) else noise
    if type(one) is not NormalActionNoise or np.ndim(one._mu) > 0 or np.ndim(one._sigma) > 0:
        return noise
    return NormalActionNoise(np.full(shape or (1,), one._mu), np.full(shape or (1,), one._sigma), one._dtype)


class NoisyOffPolicyAlgorithm(OffPolicyAlgorithm):
    """Off-policy algorithm whose ``action_noise`` may be a number, and is adapted to the actions and environments."""

    @property
    def action_noise(self) -> ActionNoise | None:
        """
        Return the exploration noise.

        An assigned number becomes Gaussian noise. Assigned noise of one environment becomes noise of all environments.
        """
        try:
            return vars(self)["action_noise"]
        except KeyError:
            raise AttributeError("action_noise") from None

    @action_noise.setter
    def action_noise(self, noise: ActionNoise | float | None) -> None:
        n_envs, action_space = vars(self).get("n_envs", 1), vars(self).get("action_space")
        if noise is not None and not isinstance(noise, ActionNoise):
            sigma = check_number("action_noise (if not an ActionNoise or None)", noise, 0.0)
            if action_space is not None:  # without a space, a saved model is being loaded
                noise = NormalActionNoise(np.zeros(()), np.full((), sigma))
        if isinstance(noise, VectorizedActionNoise) and noise.n_envs != n_envs:
            noise = noise.base_noise
        if isinstance(noise, ActionNoise) and action_space is not None:
            noise = _of_every_action(noise, action_space.shape)
        if isinstance(noise, ActionNoise) and not isinstance(noise, VectorizedActionNoise):
            noise = noise_of_all(noise, n_envs)
        vars(self)["action_noise"] = noise

    def _setup_model(self) -> None:
        self.action_noise = self.action_noise  # the setter adapts a saved model's noise to the environments of this one
        super()._setup_model()

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        scaled_action = self._sample_scaled_action(learning_starts, n_envs)
        if action_noise is not None:
            noise = action_noise()
            if not self.action_space.shape:  # otherwise (n,) and (n, 1) would broadcast to (n, n)
                noise = noise.reshape(scaled_action.shape)
            scaled_action = np.clip(scaled_action + noise, -1, 1)
        return self.policy.unscale_action(scaled_action), scaled_action

    def _sample_scaled_action(self, learning_starts: int, n_envs: int) -> np.ndarray:
        """Return actions in [-1, 1], before the noise."""
        return super()._sample_action(learning_starts, None, n_envs)[1]
