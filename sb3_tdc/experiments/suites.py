"""
Suites of runs: the paper's experiments by figure, and further experiments of this package.

A suite lists algorithms and tasks, with the hyperparameters that differ from ``hyperparams/``.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from sb3_tdc.experiments.groups import is_as_shipped
from sb3_tdc.experiments.results import Run

MUJOCO = ("HalfCheetah-v4", "Hopper-v4", "Walker2d-v4", "Ant-v4", "Humanoid-v4")
PYBULLET = ("HalfCheetahBulletEnv-v0", "HopperBulletEnv-v0", "AntBulletEnv-v0", "HumanoidBulletEnv-v0")
ISAAC = ("Isaac-Repose-Cube-Allegro-v0", "Isaac-Franka-Cabinet-Direct-v0")


@dataclass(frozen=True)
class Cell:
    """
    One algorithm on one task with one choice of settings, to be run with several seeds.

    :param settings: hyperparameters that override those of ``hyperparams/``
    :param n_timesteps: environment steps; None for those of ``hyperparams/``, which are the paper's
    """

    algo: str
    env_id: str
    settings: dict[str, Any] = field(default_factory=dict)
    n_timesteps: int | None = None

    def includes(self, run: Run) -> bool:
        """Return whether a run, of any length, has the cell's settings and otherwise those of ``hyperparams/``."""
        return (
            (run.algo, run.env_id) == (self.algo, self.env_id)
            and all(run.setting(key) == value for key, value in self.settings.items())
            and is_as_shipped(run, but=self.settings)
        )


def _cells(algos: Sequence[str], env_ids: Sequence[str], **settings: Any) -> list[Cell]:
    return [Cell(algo, env_id, settings if algo == "tdc" else {}) for env_id in env_ids for algo in algos]


_LAMBDAS = (0.0, 0.25, 0.5, 0.75, 1.0)

PAPER: dict[str, list[Cell]] = {
    "fig1": _cells(("tdc", "sac", "meow", "ddpg", "td3"), MUJOCO, stochastic_actor=False),
    "fig2": [cell for head in (False, True) for cell in _cells(("tdc",), MUJOCO, stochastic_actor=head)],
    "fig3": [cell for lam in _LAMBDAS for cell in _cells(("tdc",), ("Humanoid-v4", "HalfCheetah-v4"), lam=lam)],
    "fig5": _cells(("tdc", "sac"), PYBULLET + ISAAC),
    "figS1": [cell for lam in (0.0, 1.0) for cell in _cells(("tdc",), ("Hopper-v4",), lam=lam)],
}


def _shorter(n_timesteps: int, env_ids: Sequence[str], *variants: tuple[str, dict[str, Any]]) -> list[Cell]:
    return [Cell(algo, env_id, settings, n_timesteps) for env_id in env_ids for algo, settings in variants]


_STEPS = 300_000
_TASKS = ("Hopper-v4", "HalfCheetah-v4", "Walker2d-v4")
_TABLE_1: tuple[str, dict[str, Any]] = ("tdc", {})

# Fewer steps than in the paper, so that two cores complete these runs in days
EVIDENCE: dict[str, list[Cell]] = {
    "evidence": _shorter(_STEPS, _TASKS, _TABLE_1, ("td3", {}), ("sac", {}), ("tdc", {"lam": 0.0})),
    "evidence-heads": _shorter(_STEPS, _TASKS, ("meow", {}), ("tdc", {"stochastic_actor": True})),
    "pybullet": _shorter(100_000, PYBULLET, _TABLE_1, ("sac", {})),
    "evidence-long": _shorter(1_000_000, ("Hopper-v4",), _TABLE_1, ("td3", {})),
    # What keeps Hopper at a return of 300 for so long? Each cell changes one thing in TDC or TD3 of the first suite
    "hopper": _shorter(
        _STEPS,
        ("Hopper-v4",),
        ("td3", {"learning_starts": 25_000}),  # with this, everything is as in TD3's original code
        ("tdc", {"learning_starts": 25_000}),
        ("tdc", {"kappa": 10.0}),
        ("tdc", {"learning_rate": 3e-4, "qf_learning_rate": 3e-4}),
    ),
}
# What λ does, whether it should tune itself, and what else λ and κ could be (docs/lambda.md)
LAMBDA: dict[str, list[Cell]] = {
    "lambda": _shorter(
        100_000,
        ("Hopper-v4", "HalfCheetah-v4"),
        *(("tdc", {"lam": lam}) for lam in (0.0, 0.5, 1.0)),
        ("tdc-auto", {"lam": 1.0}),
        ("tdc-shift", {"lam": 1.0}),
        ("tdc-pessimism", {"lam": 1.0}),
        ("tdc-kappa", {"lam": 1.0}),
    )
}
SUITES = {**PAPER, **EVIDENCE, **LAMBDA}
