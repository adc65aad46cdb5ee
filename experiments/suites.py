"""What the paper ran: which algorithm, on which task, with what set otherwise, for which of its figures."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from experiments.results import Run

MUJOCO = ("HalfCheetah-v4", "Hopper-v4", "Walker2d-v4", "Ant-v4", "Humanoid-v4")
PYBULLET = ("HalfCheetahBulletEnv-v0", "HopperBulletEnv-v0", "AntBulletEnv-v0", "HumanoidBulletEnv-v0")
ISAAC = ("Isaac-Repose-Cube-Allegro-v0", "Isaac-Franka-Cabinet-Direct-v0")
# What registers an environment that gymnasium does not bring
PACKAGES = dict.fromkeys(PYBULLET, "pybullet_envs_gymnasium")


@dataclass(frozen=True)
class Cell:
    """
    One set of seeds.

    :param settings: hyperparameters over those of ``hyperparams/``
    """

    algo: str
    env_id: str
    settings: dict[str, Any] = field(default_factory=dict)

    def includes(self, run: Run) -> bool:
        """Whether a run is of this cell; λ and the head decide, since scale and budget may differ."""
        return (run.algo, run.env_id) == (self.algo, self.env_id) and all(
            run.setting(key) == value for key, value in self.settings.items()
        )


def _cells(algos: Sequence[str], env_ids: Sequence[str], **settings: Any) -> list[Cell]:
    return [Cell(algo, env_id, settings if algo == "tdc" else {}) for env_id in env_ids for algo in algos]


_LAMBDAS = (0.0, 0.25, 0.5, 0.75, 1.0)

SUITES: dict[str, list[Cell]] = {
    "fig1": _cells(("tdc", "sac", "meow", "ddpg", "td3"), MUJOCO, stochastic_actor=False),
    "fig2": [cell for head in (False, True) for cell in _cells(("tdc",), MUJOCO, stochastic_actor=head)],
    "fig3": [cell for lam in _LAMBDAS for cell in _cells(("tdc",), ("Humanoid-v4", "HalfCheetah-v4"), lam=lam)],
    "fig5": _cells(("tdc", "sac"), PYBULLET + ISAAC),
    "figS1": [cell for lam in (0.0, 1.0) for cell in _cells(("tdc",), ("Hopper-v4",), lam=lam)],
}
