"""Gaussian exploration noise of many environments, drawn at once, and perhaps of another size in each."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise, VectorizedActionNoise

from sb3_tdc.common.checks import check_number


class NormalNoiseRange(NormalActionNoise):
    """
    Gaussian noise that is small in the first environment and large in the last, evenly spaced between (as in FastTD3).

    :param mean: (n_actions,)
    :param sigma: (n_actions,), the standard deviation in the first environment
    :param largest: the same in the last
    """

    def __init__(self, mean: np.ndarray, sigma: np.ndarray, largest: np.ndarray):
        super().__init__(mean, sigma)
        self.largest = largest

    def __repr__(self) -> str:
        return f"NormalNoiseRange(mu={self._mu}, sigma={self._sigma} to {self.largest})"


class VectorizedNormalNoise(VectorizedActionNoise):
    """
    SB3's ``VectorizedActionNoise`` of Gaussian noise with one draw for all environments: the same numbers, sooner.

    :param base_noise: of one environment
    :param n_envs: how many there are
    """

    def __init__(self, base_noise: NormalActionNoise, n_envs: int):
        self.n_envs = int(check_number("n_envs", n_envs, 1))
        self.base_noise = base_noise
        self.mean = np.stack([base_noise._mu] * self.n_envs)
        largest = getattr(base_noise, "largest", base_noise._sigma)
        self.sigma = np.linspace(base_noise._sigma, largest, self.n_envs)  # (n_envs, *actions)

    def __call__(self) -> np.ndarray:
        dtype: Any = self.base_noise._dtype  # type: ignore[attr-defined]
        return np.random.normal(self.mean, self.sigma).astype(dtype)

    def reset(self, indices: Iterable[int] | None = None) -> None:
        """Do nothing: what is drawn does not depend on what was drawn before."""

    @property  # type: ignore[misc]
    def noises(self) -> tuple[NormalActionNoise, ...]:  # type: ignore[override]
        """The noise of every environment; changes of its arrays in place take effect."""
        return tuple(NormalActionNoise(mean, sigma) for mean, sigma in zip(self.mean, self.sigma, strict=True))

    def __repr__(self) -> str:
        return f"VecNoise(BaseNoise={self.base_noise!r}), n_envs={self.n_envs})"


def noise_of_all(noise: ActionNoise, n_envs: int) -> ActionNoise:
    """
    Return the noise of several environments, made of that of one.

    :raises ValueError: for a range of sizes and one environment
    """
    if n_envs > 1:
        # A subclass may draw otherwise
        if isinstance(noise, NormalActionNoise) and type(noise) in (NormalActionNoise, NormalNoiseRange):
            return VectorizedNormalNoise(noise, n_envs)
        return VectorizedActionNoise(noise, n_envs)
    if isinstance(noise, NormalNoiseRange):
        raise ValueError("noise_std from one value to another needs several environments: n_envs is 1")
    return noise
