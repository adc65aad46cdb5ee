"""Tables: groups of runs → numbers (for CSV) → formatted cells (for the report)."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_tdc.common import plain_yaml
from sb3_tdc.common.words import count
from sb3_tdc.experiments import statistics
from sb3_tdc.experiments.claims import Interval, examine
from sb3_tdc.experiments.final_episodes import EPISODES, read_test_returns
from sb3_tdc.experiments.groups import Conditions, Group, by_conditions
from sb3_tdc.experiments.published_curves import published_curves
from sb3_tdc.experiments.results import Run
from sb3_tdc.experiments.suites import MUJOCO
from sb3_tdc.experiments.variants import Comparison

TASKS = ("HalfCheetah", "Hopper", "Walker2d", "Ant", "Humanoid")
_PUBLISHED = Path(__file__).with_name("published.yml")


def make_returns_table(groups: Sequence[Group]) -> pd.DataFrame:
    """Make one row for each group with a finished run, in units of return; NaN for what one seed cannot tell."""
    rows = []
    for group in groups:
        curves = [run.evaluations for run in group.finished if run.evaluations is not None]
        if not curves:
            continue
        final = group.final_returns
        best = np.array([statistics.best_return(curve.returns) for curve in curves])
        area = np.array([statistics.area_under_curve(curve.timesteps, curve.returns) for curve in curves])
        low, high = statistics.iqm_interval([final])
        tested = [returns for run in group.finished if (returns := read_test_returns(run)) is not None]
        tests = np.array([returns.mean() for returns in tested])
        rows.append(
            {
                "environment": group.env_id,
                "algorithm": group.name,
                "mujoco": group.conditions.mujoco,
                "steps": group.n_timesteps,
                "share": group.share,
                "seeds": len(curves),
                "episodes": curves[0].returns.shape[1],
                "final_mean": final.mean(),
                "final_std": statistics.spread(final),
                "final_min": final.min(),
                "final_max": final.max(),
                "final_iqm": statistics.interquartile_mean(final),
                "final_iqm_low": low,
                "final_iqm_high": high,
                "best_mean": best.mean(),
                "best_std": statistics.spread(best),
                "area_mean": area.mean(),
                "area_std": statistics.spread(area),
                "test_mean": statistics.mean(tests),
                "test_std": statistics.spread(tests),
                "test_seeds": len(tests),
                "test_episodes": min(map(len, tested), default=0),
            }
        )
    return pd.DataFrame(rows)


def show_returns(table: pd.DataFrame) -> pd.DataFrame:
    """Format the table of :func:`make_returns_table` for the report."""
    rows = []
    for row in table.to_dict("records"):
        interval = (
            f"{number(row['final_iqm'])} [{number(row['final_iqm_low'])}, {number(row['final_iqm_high'])}]"
            if row["seeds"] > 1
            else "–"
        )
        test = plus_minus(row["test_mean"], row["test_std"])
        if row["test_seeds"] < row["seeds"] or row["test_episodes"] < EPISODES:
            test += f" ({row['test_seeds']} of {count(row['seeds'], 'seed')}, {count(row['test_episodes'], 'episode')})"
        rows.append(
            {
                "Environment": Conditions(row["environment"], row["steps"], row["mujoco"]).task,
                "Algorithm": row["algorithm"],
                "Steps": number(row["steps"]),
                "Seeds": row["seeds"],
                "Final": plus_minus(row["final_mean"], row["final_std"]),
                "IQM [95 %]": interval,
                "Lowest, highest seed": f"{number(row['final_min'])}, {number(row['final_max'])}"
                if row["seeds"] > 1
                else "–",
                "Best": plus_minus(row["best_mean"], row["best_std"]),
                "Mean of the curve": plus_minus(row["area_mean"], row["area_std"]),
                "Test": test if row["test_seeds"] else "–",
            }
        )
    return pd.DataFrame(rows)


def make_published_table(table: pd.DataFrame) -> pd.DataFrame:
    """
    List our final returns and those that others have published, one row for each source and algorithm.

    Rows are grouped by algorithm, with ours first in each group.

    :param table: the table of :func:`make_returns_table`
    """
    rows = []
    ours = [row for row in table.to_dict("records") if row["environment"].rpartition("-")[0] in TASKS]
    for (algorithm, version), some in _rows_over_tasks(ours):
        by_task = {row["environment"].rpartition("-")[0]: row for row in some}
        rows.append(
            {
                "Algorithm": f"{algorithm}: this report",
                **{
                    task: plus_minus(by_task[task]["final_mean"], by_task[task]["final_std"])
                    if task in by_task
                    else "–"
                    for task in TASKS
                },
                "Environments": version,
                "Steps": _per_task({task: number(row["steps"]) for task, row in by_task.items()}),
                "Seeds": _per_task({task: str(row["seeds"]) for task, row in by_task.items()}),
                "What": "mean of the last evaluation ± std over seeds",
            }
        )
    published = plain_yaml.load(_PUBLISHED.read_text(), _PUBLISHED.name)
    for entry in published:
        for algorithm, returns in entry["returns"].items():
            note = entry.get("notes", {}).get(algorithm)
            steps = entry["steps"] if isinstance(entry["steps"], dict) else dict.fromkeys(TASKS, entry["steps"])
            rows.append(
                {
                    "Algorithm": f"{algorithm}: {entry['source']}",
                    **{task: _published_return(returns.get(task)) for task in TASKS},
                    "Environments": entry["version"],
                    "Steps": _per_task({task: f"{steps[task]:g}M" for task in TASKS}),
                    "Seeds": str(entry["seeds"]),
                    "What": f"{entry['how']} ({note})" if note else entry["how"],
                }
            )
    names = [re.split("[,:]|-λ", row["Algorithm"])[0] for row in rows]
    order = sorted(range(len(rows)), key=lambda i: names.index(names[i]))  # stable: ours comes first
    return pd.DataFrame([rows[i] for i in order])


def make_published_curves_table(groups: Sequence[Group]) -> pd.DataFrame:
    """List our final returns, then the published curves at the same step, by task and number of steps."""
    rows = []
    for conditions, alike in by_conditions((g for g in groups if g.finished), MUJOCO).items():
        published = [(curve, *curve.at(conditions.n_timesteps)) for curve in published_curves(conditions.env_id)]
        if not any(np.isfinite(mean) for _, mean, *_ in published):
            continue
        where = conditions.task, f"{conditions.n_timesteps:,}"
        for group in alike:
            returns = _with_interval(*map(float, statistics.mean_interval(group.final_returns)))
            rows.append((*where, f"{group.name}: this report", returns, str(len(group.finished))))
        for curve, *interval in published:
            rows.append((*where, f"{curve.algorithm}: published", _with_interval(*interval), str(curve.seeds)))
    return pd.DataFrame(rows, columns=["Environment", "Steps", "Algorithm", "Return", "Seeds"])


# What λ does: a column of the log, its title in the table, and the factor that it is multiplied by
_LAM_COLUMNS = (
    ("train/lam", "λ", 1),
    ("train/lam_can_change", "λ* exists, %", 100),
    ("train/lam_critical_q50", "Median λ*", 1),
    ("train/lam_changes", "Choices changed, %", 100),
    ("train/lam_adds_in_std", "Adds to the target, σ", 1),
    ("train/lowered", "Lowers the target by", 1),
    ("train/kappa", "κ", 1),
    ("eval/overestimation", "Overestimation", 1),
    ("eval/std_error_correlation", "Correlation of σ and error", 1),
    ("eval/std_scatter_correlation", "of σ and scatter", 1),
    ("train/actor_dormant", "Dormant units of the actor, %", 100),
    ("train/critic_dormant", "of the critics, %", 100),
)


def make_lam_table(groups: Sequence[Group]) -> pd.DataFrame:
    """Make one row for each group that logs what λ does: means over the last third of every run, then over seeds."""
    rows = []
    for group in groups:
        logged = {title: _late_means(group.finished, column) * unit for column, title, unit in _LAM_COLUMNS}
        if not np.isfinite(logged["Choices changed, %"]).any():
            continue
        rows.append(
            {
                "Environment": group.conditions.task,
                "Algorithm": group.name,
                "Steps": number(group.n_timesteps),
                "Seeds": len(group.finished),
                **{title: _over_seeds(values) for title, values in logged.items()},
            }
        )
    table = pd.DataFrame(rows)
    return table.loc[:, (table != "–").any()]


def _late_means(runs: Sequence[Run], column: str) -> np.ndarray:
    """Return the mean of a column in the last third of every run, (runs,); NaN where a run has not logged it."""
    return np.array([late.mean() if len(late := run.late(column)) else np.nan for run in runs])


def _over_seeds(values: np.ndarray) -> str:
    """Return ``"87.2 ± 35"``; without the ± if there is one seed, or all seeds have the same value."""
    known = values[np.isfinite(values)]
    if not len(known):
        return "–"
    mean, std = _rounded(known.mean(), 3), statistics.spread(known)
    is_one_value = len(known) == 1 or np.ptp(known) <= 1e-9 * np.abs(known).max()
    return (mean if is_one_value else f"{mean} ± {_rounded(std, 2)}").replace("-", "−")


def _rounded(value: float, digits: int) -> str:
    """Round for reading: 113.4 with 2 digits → "110", and not "1.1e+02"."""
    return f"{float(f'{value:.{digits}g}'):g}"


def _with_interval(mean: float, low: float, high: float) -> str:
    return number(mean) if np.isnan(low) else f"{number(mean)} [{number(low)}, {number(high)}]"


def make_claims_table(groups: Sequence[Group]) -> pd.DataFrame:
    """Make one row for each comparison that a claim of the paper requires, with its verdict."""
    rows = [
        {
            "Claim": claim.says,
            "Environment": claim.group.conditions.task,
            "Steps": f"{claim.group.n_timesteps:,}",
            "Compared": claim.what,
            "Ours": f"{claim.sides[0]}: {_of_seeds(claim.ours)}",
            "Other": f"{claim.sides[1]}: {_of_seeds(claim.other)}",
            "Verdict": claim.verdict,
        }
        for claim in examine(groups)
    ]
    return pd.DataFrame(rows)


def make_comparisons_table(comparisons: Sequence[Comparison]) -> pd.DataFrame:
    """Make one row for each variant and its control."""
    return pd.DataFrame(
        [
            {
                "Environment": comparison.variant.conditions.task,
                "Steps": number(comparison.variant.n_timesteps),
                "Variant": _of_returns(comparison.variant, comparison.returns[0]),
                "Control": _of_returns(comparison.control, comparison.returns[1]),
                "Difference": _with_interval(*comparison.difference),
                "p": "–" if np.isnan(comparison.p) else f"{comparison.p:.2g}",
                "Verdict": comparison.verdict,
            }
            for comparison in comparisons
        ]
    )


def _of_returns(group: Group, returns: np.ndarray) -> str:
    mean = plus_minus(statistics.mean(returns), statistics.spread(returns))
    return f"{group.name}: {mean} ({count(len(returns), 'seed')})"


def _of_seeds(interval: Interval) -> str:
    return f"{_with_interval(interval.value, interval.low, interval.high)} ({count(interval.n, 'seed')})"


def number(value: float) -> str:
    """Format a number: thousands separated; one decimal below 100; "–" for NaN."""
    if np.isnan(value):
        return "–"
    text = f"{value:,.1f}" if abs(value) < 100 and value != int(value) else f"{value:,.0f}"
    return text.replace("-", "−")


def plus_minus(mean: float, std: float) -> str:
    """Return ``"1,234 ± 56"``, without the ± if the standard deviation is NaN."""
    return number(mean) if np.isnan(std) else f"{number(mean)} ± {number(std)}"


def _published_return(value: Any) -> str:
    if value is None:
        return "–"
    return plus_minus(*value) if isinstance(value, list) else number(value)


def _per_task(values: dict[str, str]) -> str:
    """Return the common value if all tasks that have one agree, else all values in the order of the columns."""
    if len(set(values.values())) == 1:
        return next(iter(values.values()))
    return " / ".join(values.get(task, "–") for task in TASKS)


def _rows_over_tasks(rows: list[dict[str, Any]]) -> Iterator[tuple[tuple[str, str], list[dict[str, Any]]]]:
    """
    Yield the tasks of each row, which have the same algorithm, version, physics and length.

    Equal length means the same number of steps, or the same share of the steps in ``hyperparams/``, whichever makes
    fewer rows.

    :return: the algorithm and the version (with the physics), and the rows of these tasks
    """
    found: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        version = row["environment"].rpartition("-")[2]
        physics = f"{version}, MuJoCo {row['mujoco']}" if row["mujoco"] else version
        found.setdefault((row["algorithm"], physics), []).append(row)
    for what, some in found.items():
        by_length = [_split(some, key) for key in ("steps", "share")]
        yield from ((what, of_length) for of_length in min(by_length, key=len))


def _split(rows: list[dict[str, Any]], key: str) -> list[list[dict[str, Any]]]:
    found: dict[Any, list[dict[str, Any]]] = {}
    for row in rows:
        found.setdefault(row[key], []).append(row)
    return list(found.values())
