"""Results of a search: a table, figures, and the hyperparameters of the best candidate."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from sb3_tdc.common import plain_yaml
from sb3_tdc.common.commands import command
from sb3_tdc.experiments.figures import COLORS, draw_sweep
from sb3_tdc.experiments.jobs import Job
from sb3_tdc.experiments.trials import read_shared_evaluations
from sb3_tdc.hyperparams import hyperparams_file, merge, read_entry


def rank(candidates: Sequence[Sequence[Job]], searched: Sequence[str]) -> pd.DataFrame:
    """
    Rank candidates, best first, by the mean over seeds of the mean of all evaluations.

    Only the evaluations that all seeds of a candidate have are counted. Unfinished candidates (stopped early, or
    failed) come after the finished ones, in the order of their steps.

    :param candidates: for each candidate, the jobs of its seeds
    :param searched: names of the searched hyperparameters, which are the first columns
    """
    rows = []
    for number, jobs in enumerate(candidates):
        timesteps, scores = read_shared_evaluations(jobs)
        steps = timesteps[-1] if len(timesteps) else 0
        per_seed = scores.mean(axis=1) if steps else np.full(len(jobs), np.nan)
        trained = np.inf if all(job.is_finished for job in jobs) else steps
        spread = per_seed.std(ddof=1) if len(jobs) > 1 else np.nan
        settings = {key: jobs[0].settings[key] for key in searched}
        measured = {"mean": per_seed.mean(), "std": spread, "seeds": len(jobs), "steps": steps}
        rows.append({**settings, **measured, "trained": trained, "number": number})
    table = pd.DataFrame(rows).sort_values(["trained", "mean"], ascending=False, kind="stable")
    return table.set_index("number").drop(columns="trained")


def draw(candidates: Sequence[Sequence[Job]], key: str, path: Path) -> None:
    """
    Draw the return against one hyperparameter, over the steps that all candidates have, as PNG and PDF.

    If other hyperparameters are searched too, each value is represented by its best candidate.

    :param candidates: candidates with evaluations, whose values of the hyperparameter are numbers
    :param path: path of the figures, without a suffix
    """
    from matplotlib.figure import Figure

    evaluations = [read_shared_evaluations(jobs) for jobs in candidates]
    last_step = min(timesteps[-1] for timesteps, _ in evaluations)
    best: dict[float, np.ndarray] = {}
    for jobs, (timesteps, returns) in zip(candidates, evaluations, strict=True):
        value, scores = jobs[0].settings[key], returns[:, timesteps <= last_step].mean(axis=1)
        if value not in best or scores.mean() > best[value].mean():
            best[value] = scores
    job = candidates[0][0]
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    name = "λ" if key == "lam" else key
    draw_sweep(
        axes, sorted(best), [best[value] for value in sorted(best)], job.env_id, name, COLORS.get(job.algo.upper())
    )
    axes.set_ylabel(f"mean return until step {last_step:,}")
    for suffix in (".png", ".pdf"):
        figure.savefig(f"{path}{suffix}")


def write_results(folder: Path, candidates: Sequence[Sequence[Job]], searched: Sequence[str]) -> None:
    """Print the ranking, and write it, the figures, and the hyperparameters of the best candidate."""
    table = rank(candidates, searched)
    table.to_csv(folder / "ranking.csv", index=False)
    print(table.to_string(index=False, float_format=lambda x: f"{x:g}", na_rep="–"))
    evaluated = [candidates[number] for number in sorted(table.index[table["steps"] > 0])]
    for key in searched:
        numbers = [jobs for jobs in evaluated if type(jobs[0].settings[key]) in (int, float)]
        if len({jobs[0].settings[key] for jobs in numbers}) > 1:
            draw(numbers, key, folder / key)
    best = candidates[int(table.index[0])][0]
    entry, _ = read_entry(hyperparams_file(best.algo), best.env_id)
    content = {best.env_id: merge(entry, best.settings)}  # with the number of steps of a whole training, not of a trial
    (folder / "best.yml").write_text(plain_yaml.dump(content, sort_keys=False))
    print(f"Ranking, figures and the best hyperparameters are in {folder}")
    packages = ["--gym-packages", *best.packages] if best.packages else []
    arguments = ["--algo", best.algo, "--env", best.env_id, "-conf", folder / "best.yml", *packages]
    print(f"  {command('train', *arguments)}")
