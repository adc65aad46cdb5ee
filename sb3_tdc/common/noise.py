"""Gaussian exploration noise of many environments, drawn at once, and perhaps of another size in each."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise, VectorizedActionNoise

from sb3_tdc.common.checks import check_number


class NormalNoiseRange(NormalActionNoise):
    """
    Gaussian noise that is small in the first environment and large in the last, evenly spaced between (as in FastTD3).

    By itself, and so in a single environment, it has the size in the middle.

    :param mean: (n_actions,)
    :param smallest: (n_actions,), the standard deviation in the first environment
    :param largest: the same in the last
    """

    def __init__(self, mean: np.ndarray, smallest: np.ndarray, largest: np.ndarray):
        super().__init__(mean, (smallest + largest) / 2)
        self.smallest, self.largest = smallest, largest

    def __repr__(self) -> str:
        return f"NormalNoiseRange(mu={self._mu}, sigma={self.smallest} to {self.largest})"


class VectorizedNormalNoise(VectorizedActionNoise):
    """
    SB3's ``VectorizedActionNoise`` of Gaussian noise with one draw for all environments: the same numbers, sooner.

    ``mean`` and ``sigma``, (n_envs, *actions), may be changed in place.

    :param base_noise: of one environment
    :param n_envs: how many there are
    """

    def __init__(self, base_noise: NormalActionNoise, n_envs: int):
        self.n_envs = int(check_number("n_envs", n_envs, 1))
        self.base_noise = base_noise
        ends = [getattr(base_noise, name, base_noise._sigma) for name in ("smallest", "largest")]
        mean, smallest, largest = np.broadcast_arrays(base_noise._mu, *ends)
        self.mean, self.sigma = np.stack([mean] * self.n_envs), np.linspace(smallest, largest, self.n_envs)

    def __call__(self) -> np.ndarray:
        dtype: Any = self.base_noise._dtype  # type: ignore[attr-defined]
        return np.random.normal(self.mean, self.sigma).astype(dtype)

    def reset(self, indices: Iterable[int] | None = None) -> None:
        """Do nothing: what is drawn does not depend on what was drawn before."""

    @property  # type: ignore[misc]
    def noises(self) -> tuple[NormalActionNoise, ...]:  # type: ignore[override]
        """The noise of every environment, of views of ``mean`` and ``sigma``."""
        return tuple(NormalActionNoise(mean, sigma) for mean, sigma in zip(self.mean, self.sigma, strict=True))

    def __repr__(self) -> str:
        return f"VecNoise(BaseNoise={self.base_noise!r}), n_envs={self.n_envs})"


def noise_of_all(noise: ActionNoise, n_envs: int) -> ActionNoise:
    """Return the noise of several environments, made of that of one."""
    if n_envs > 1:
        # A subclass may draw otherwise
        if isinstance(noise, NormalActionNoise) and type(noise) in (NormalActionNoise, NormalNoiseRange):
            return VectorizedNormalNoise(noise, n_envs)
        return VectorizedActionNoise(noise, n_envs)
    return noise
