"""The provenance of a report, and which of the paper's experiments it has or lacks."""

import os
import platform
import re
import shlex
import sys
from collections.abc import Sequence
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version

import gymnasium as gym
import pandas as pd

from sb3_tdc.common.versions import commit_of_the_code, processor_name
from sb3_tdc.experiments.groups import Group, describe, differences
from sb3_tdc.experiments.results import Run
from sb3_tdc.experiments.suites import PAPER, Cell
from sb3_tdc.experiments.tables import number
from sb3_tdc.runs.algorithms import KNOWN_ALGORITHMS

_PACKAGES = ("sb3-tdc", "stable-baselines3", "torch", "gymnasium", "mujoco", "numpy", "scipy")
_TITLES = {
    "fig1": "Fig. 1, algorithms",
    "fig2": "Fig. 2, heads of TDC",
    "fig3": "Fig. 3, λ",
    "fig5": "Fig. 5, other simulators",
    "figS1": "Fig. S1, TD errors",
}


def compare_with_paper(runs: Sequence[Run]) -> list[tuple[str, pd.DataFrame]]:
    """Return titles and tables: the seeds of every experiment of the paper, and why absent runs are absent."""
    found = []
    absent: dict[str, dict[str, list[str]]] = {}
    for suite, cells in PAPER.items():
        table = pd.DataFrame(
            "",
            index=list(dict.fromkeys(cell.env_id for cell in cells)),
            columns=list(dict.fromkeys(map(_column, cells))),
        )
        for cell in cells:
            members = [run for run in runs if cell.includes(run)]
            table.loc[cell.env_id, _column(cell)] = _count_seeds(members)
            if not members:
                envs = absent.setdefault(_why_absent(cell), {}).setdefault(_column(cell), [])
                envs += [cell.env_id] if cell.env_id not in envs else []
        found.append((_TITLES[suite], table.rename_axis("Environment").reset_index()))
    rows = [
        {"Why": why, "Absent": "; ".join(f"{what} on {', '.join(envs)}" for what, envs in cells.items())}
        for why, cells in absent.items()
    ]
    return [*found, ("Absent runs", pd.DataFrame(rows, columns=["Why", "Absent"]))]


def _count_seeds(runs: Sequence[Run]) -> str:
    """Return ``"3 (300,000 steps), 1 (100,000 steps), 2 not averaged"``; "–" without any."""
    averaged: dict[int, set[int]] = {}
    others: dict[int, set[int]] = {}
    for run in runs:
        kind = averaged if run.is_averaged else others
        kind.setdefault(run.n_timesteps, set()).add(run.seed)
    said = [f"{len(averaged[steps])} ({steps:,} steps)" for steps in sorted(averaged, reverse=True)]
    n_others = sum(len(seeds - averaged.get(steps, set())) for steps, seeds in others.items())
    return ", ".join([*said, *([f"{n_others} not averaged"] if n_others else [])]) or "–"


def _column(cell: Cell) -> str:
    shown = describe({k: v for k, v in cell.settings.items() if k == "lam" or v})
    return f"{cell.algo.upper()}, {shown}" if shown else cell.algo.upper()


def _why_absent(cell: Cell) -> str:
    if cell.algo not in KNOWN_ALGORITHMS:
        return f"This version of the package has no {cell.algo.upper()}"
    if cell.env_id not in gym.registry:
        return "Their simulator is not installed, or not imported, where this report was made"
    return "There is no such run in the folder"


def list_unfinished(runs: Sequence[Run], unreadable: Sequence[str]) -> pd.DataFrame:
    """List the runs that are not averaged, and why; the table is empty if there are none."""
    rows = []
    for run in runs:
        if not run.is_averaged:
            if run.is_finished and not run.is_complete:
                why = "finished early: a callback ended it, or n_timesteps was edited afterwards"
            elif run.is_finished and run.evaluations is None:
                why = "finished, but was not evaluated"
            elif run.is_finished:
                why = "an evaluation has a return that is not finite"
            elif run.folder.model.is_file():
                why = "stopped early; the model was saved"
            else:
                why = "no model was saved: still running, killed or failed"
            rows.append({"Run": str(run.folder.path), "Steps": f"{run.steps:,} of {run.n_timesteps:,}", "Why": why})
    return pd.DataFrame([*rows, *({"Run": text, "Steps": "", "Why": "unreadable"} for text in unreadable)])


def describe_groups(groups: Sequence[Group]) -> pd.DataFrame:
    """Describe every group: its seeds, its commits, and the settings that differ from ``hyperparams/``."""
    return pd.DataFrame(
        [
            {
                "Environment": group.env_id,
                "Algorithm": group.label,
                "Steps": f"{group.n_timesteps:,}",
                "Finished seeds": group.seeds,
                "Commits of sb3_tdc": "; ".join(map(_short, group.commits)) or "–",
                "Differs from hyperparams/": describe(differences(group.runs[0])) or "nothing",
            }
            for group in groups
        ]
    )


def _short(commit: str) -> str:
    """Shorten a commit: ``"0123456…, with uncommitted changes"`` → "0123456, with uncommitted changes"."""
    return re.sub(r"^([0-9a-f]{7})[0-9a-f]+", r"\1", commit) or "not known"


def describe_runs(runs: Sequence[Run]) -> pd.DataFrame:
    """Describe every run: its steps, its time, its command, and the versions that it was trained with."""
    rows = []
    for run in runs:
        elapsed = run.progress("time/time_elapsed")
        rows.append(
            {
                "Run": str(run.folder.path),
                "Seed": run.seed,
                "Steps": f"{run.steps:,}",
                "Minutes": number(elapsed[-1] / 60) if len(elapsed) else "–",
                "Command": run.command,
                "Trained with": run.system,
            }
        )
    return pd.DataFrame(rows)


def describe_machine() -> dict[str, str]:
    """Describe the machine and the code that made the report."""
    versions = []
    for package in _PACKAGES:
        try:
            versions.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            versions.append(f"{package} –")
    return {
        "Made": datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z"),
        "Command": shlex.join(sys.orig_argv),
        "Commit of the code that made it": commit_of_the_code() or "not in a git repository",
        "Machine that made it": f"{processor_name()}, {os.cpu_count()} cores, {platform.platform()}",
        "Versions there": ", ".join([f"Python {platform.python_version()}", *versions]),
    }
