"""The sections of the report: each states what it shows, draws its figures and fills its tables."""

import base64
import io
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_tdc.experiments import figures, provenance, statistics, tables
from sb3_tdc.experiments.claims import MIN_SEEDS_OF_SPREAD
from sb3_tdc.experiments.curves import bin_width, headline, make_curve, read_evaluations, read_td_errors
from sb3_tdc.experiments.final_episodes import EPISODES, read_test_returns
from sb3_tdc.experiments.published_curves import published_curves
from sb3_tdc.experiments.results import Group, Run, vary
from sb3_tdc.experiments.suites import ISAAC, MUJOCO, PYBULLET


@dataclass(frozen=True)
class Picture:
    """A figure as the page shows it: :param svg: base64"""

    name: str
    caption: str
    svg: str


@dataclass
class Section:
    """A part of the page. :param tables: pairs of caption and cells to read"""

    title: str
    text: str
    pictures: list[Picture] = field(default_factory=list)
    tables: list[tuple[str, pd.DataFrame]] = field(default_factory=list)


class Report:
    """
    The sections of a page, in order, and the files next to it.

    :param folder: where figures and tables are written
    """

    def __init__(self, groups: Sequence[Group], folder: Path):
        self.groups, self.folder = groups, folder
        self.returns = tables.make_returns_table(groups)
        others = [g.label for g in groups if g.label not in figures.COLORS]
        cycle = figures.OTHER_COLORS
        self.colors = figures.COLORS | {label: cycle[i % len(cycle)] for i, label in enumerate(dict.fromkeys(others))}

    def draw(self, name: str, caption: str, function: Callable[..., None], *args: Any, **kwargs: Any) -> Picture:
        """Draw one figure by a function of axes and arrays, and write it as SVG, PNG and PDF."""
        import matplotlib
        from matplotlib.figure import Figure

        with matplotlib.rc_context({"font.size": 9, "svg.hashsalt": name}):
            figure = Figure(figsize=(4.8, 3.4), layout="constrained")
            function(figure.subplots(), *args, **kwargs)
            path = self.folder / "figures" / re.sub(r"[^\w.-]+", "_", name)
            path.parent.mkdir(parents=True, exist_ok=True)
            for suffix in ("png", "pdf"):
                figure.savefig(f"{path}.{suffix}", dpi=200)
            svg = io.BytesIO()
            figure.savefig(svg, format="svg")
        Path(f"{path}.svg").write_bytes(svg.getvalue())
        return Picture(path.name, caption, base64.b64encode(svg.getvalue()).decode())

    def write_table(self, name: str, table: pd.DataFrame) -> None:
        """Write numbers as CSV."""
        path = self.folder / "tables" / f"{name}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        table.to_csv(path, index=False)

    def add_table(self, section: Section, name: str, table: pd.DataFrame, caption: str = "") -> None:
        """Write a table of cells to read, and show it; an empty one is left out."""
        if len(table):
            self.write_table(name, table)
            section.tables.append((caption, table))

    def by_env(self, groups: Iterable[Group]) -> dict[str, list[Group]]:
        """The paper's order of tasks, then the alphabet's."""
        found: dict[str, list[Group]] = {}
        for group in groups:
            found.setdefault(group.env_id, []).append(group)
        known = [*MUJOCO, *PYBULLET, *ISAAC]
        return dict(sorted(found.items(), key=lambda item: known.index(item[0]) if item[0] in known else len(known)))

    def draw_learning_curves(
        self, name: str, groups: Sequence[Group], labels: Sequence[str], colors: Sequence[Any]
    ) -> Picture:
        width = max(map(bin_width, groups))
        curves = [
            make_curve(group, label, color, width, read_evaluations)
            for group, label, color in zip(groups, labels, colors, strict=True)
        ]
        episodes = sorted({str(run.evaluations.returns.shape[1]) for g in groups for run in g.runs if run.evaluations})
        return self.draw(
            f"{name}-{groups[0].env_id}",
            f"{_steps(groups)}; bins of {width:,} steps. {_seeds(groups, labels)}",
            figures.draw_curves,
            curves,
            groups[0].env_id,
            f"return of {_and(episodes) or 'no'} mean-action episodes",
            published=[curve for curve in published_curves(groups[0].env_id) if curve.algorithm == "SAC"],
        )

    def learning_curves(self) -> Section:
        section = Section(
            "Learning curves (Fig. 1, Fig. 5)",
            "Evaluations of the mean action, in bins of the paper's 20,000 steps, scaled with the length of the runs "
            "but never below the distance of evaluations. Thick: mean over seeds; band: 95 % interval of that mean "
            "(Student's t over seeds); thin: single seeds. One seed has no band. Unfinished runs are dotted and not "
            "averaged. The band of two seeds is huge, and runs off the axis, which is made for the seeds. Dashed: SAC "
            "as the repository of SimbaV2 has published it, with the interval of its seeds.",
        )
        for groups in self.by_env(self.groups).values():
            shown = headline(groups)
            labels = [group.label for group in shown]
            section.pictures.append(
                self.draw_learning_curves("learning-curve", shown, labels, [self.colors[label] for label in labels])
            )
        return section

    def returns_section(self) -> Section:
        self.write_table("returns", self.returns)
        section = Section(
            "Returns",
            "Of finished runs. ± is the standard deviation across seeds (none for one seed). Final: mean of the last "
            "evaluation. IQM: interquartile mean of the final returns (of fewer than four seeds it is the mean) with a "
            "95 % bootstrap interval over seeds, which a handful of seeds makes too narrow. Best: the best evaluation "
            "of each run, a maximum that flatters. Mean of the curve: area under the learning curve, over its steps. "
            f"Test: {EPISODES} episodes of the last model (sb3-tdc evaluate), from the same initial "
            "states for all.",
        )
        if len(self.returns):
            section.tables.append(("", tables.show_returns(self.returns)))
        scores = self.scores()
        if scores:
            labels = list(scores)
            intervals = [
                (float(statistics.interquartile_mean(*tasks)), *statistics.iqm_interval(tasks))
                for tasks in scores.values()
            ]
            env_ids = self.common_envs(labels)
            envs = _and(env_ids)
            steps = _steps([g for g in self.groups if g.label in labels and g.env_id in env_ids])
            table = pd.DataFrame(intervals, columns=["iqm", "low", "high"]).assign(algorithm=labels, tasks=envs)
            self.write_table("aggregate", table)
            section.pictures.append(
                self.draw(
                    "aggregate",
                    f"Final returns over {envs}: interquartile mean of scores with 95 % stratified bootstrap interval. "
                    "0 and 1 are the lowest and highest single run on a task in this report.",
                    figures.draw_intervals,
                    [f"{label}\n{sum(map(len, scores[label]))} runs" for label in labels],
                    [self.colors[label] for label in labels],
                    intervals,
                    f"{envs}, {steps}",
                    "IQM of normalised final returns",
                )
            )
        return section

    def common_envs(self, labels: Sequence[str]) -> list[str]:
        """Environments on which all of these have at least two finished seeds."""
        several = {(g.env_id, g.label) for g in self.groups if len(g.finished) > 1}
        return [env for env in self.by_env(self.groups) if all((env, label) in several for label in labels)]

    def scores(self) -> dict[str, list[np.ndarray]]:
        """Return the scores by task of every algorithm that has two seeds on each of at least two tasks."""
        several = [g.label for g in self.groups if len(g.finished) > 1 and g.label == g.algo.upper()]
        labels = [label for label in dict.fromkeys(several) if several.count(label) == max(map(several.count, several))]
        envs = self.common_envs(labels)
        if len(envs) < 2 or len(labels) < 2:
            return {}
        scores: dict[str, list[np.ndarray]] = {label: [] for label in labels}
        for env in envs:
            final = {
                g.label: tables.final_returns(g.finished) for g in self.groups if g.env_id == env and g.label in labels
            }
            for label, values in statistics.normalise_scores(final).items():
                scores[label].append(values)
        return scores

    def lambda_sweep(self) -> Section:
        section = Section(
            "λ (Fig. 3)",
            "Groups that differ in λ alone. Left of each pair: learning curves; right: final return against λ, every "
            "seed a dot, mean and 95 % t interval where there are several; a λ that calibrates itself has no place on "
            "that axis. The paper's λ are 0, 0.25, 0.5, 0.75 and 1 on Humanoid and HalfCheetah.",
        )
        import matplotlib

        for number, groups in enumerate(self.ablations("lam")):
            values = [group.setting("lam") for group in groups]
            colors = list(matplotlib.colormaps["viridis"](np.linspace(0, 0.85, len(groups))))
            suffix = f"-{number + 1}"
            labels = [f"λ = {value}" if isinstance(value, str) else f"λ = {value:g}" for value in values]
            section.pictures.append(self.draw_learning_curves(f"lambda-curves{suffix}", groups, labels, colors))
            done = [
                (value, tables.final_returns(group.finished))
                for value, group in zip(values, groups, strict=True)
                if group.finished and not isinstance(value, str)
            ]
            if len(done) > 1:
                section.pictures.append(
                    self.draw(
                        f"lambda-sweep{suffix}-{groups[0].env_id}",
                        f"{_steps(groups)}. {_seeds(groups, labels)}",
                        figures.draw_sweep,
                        [value for value, _ in done],
                        [returns for _, returns in done],
                        f"{groups[0].env_id}, {_steps(groups)}",
                        "λ",
                        self.colors["TDC"],
                    )
                )
        self.add_table(
            section,
            "lambda",
            tables.make_lam_table(self.groups),
            "What λ does, in the last third of the runs: means over seeds ± standard deviation. With λ = 0 nothing "
            "is changed, by definition. Overestimation is what the critics predict minus the return that follows.",
        )
        self.add_table(
            section,
            "variants",
            tables.make_variants_table(self.groups),
            "Variants of TDC, each against the control that differs in one thing: mean ± standard deviation over "
            "seeds of the evaluations in the last third of a run; the difference with Welch's 95 % interval; its "
            "p-value, corrected for the number of variants on the task by Holm's method.",
        )
        return section

    def heads(self) -> Section:
        section = Section(
            "Deterministic and stochastic head (Fig. 2)",
            "Groups of TDC that differ in the head alone. Both are evaluated by the mean action.",
        )
        for number, groups in enumerate(self.ablations("stochastic_actor")):
            labels = ["stochastic" if group.setting("stochastic_actor") else "deterministic" for group in groups]
            colors = [self.colors["TDC"], figures.OTHER_COLORS[0]]
            section.pictures.append(self.draw_learning_curves(f"heads-{number + 1}", groups, labels, colors))
        return section

    def ablations(self, key: str) -> list[list[Group]]:
        """Groups of TDC that differ in one setting alone."""
        return vary([g for groups in self.by_env(self.groups).values() for g in groups if g.algo == "tdc"], key)

    def td_errors(self) -> Section:
        section = Section(
            "Variance of TD errors (Fig. S1)",
            "Variance over the minibatch of δ = mean target − mean of the critic's quantiles (train/td_error_var), on "
            "a logarithmic axis; means and 95 % t intervals are those of its logarithm. The paper compares λ = 0 and "
            "λ = 1 on Hopper. Returns that grow make TD errors grow too: a smaller variance is not by itself a "
            "better run.",
        )
        for env_id, groups in self.by_env(g for g in self.groups if g.algo == "tdc").items():
            width = max(map(bin_width, groups))
            curves = [
                make_curve(group, group.label, self.colors[group.label], width, read_td_errors) for group in groups
            ]
            if not any(np.isfinite(curve.values).any() for curve in curves):
                continue
            section.pictures.append(
                self.draw(
                    f"td-error-variance-{env_id}",
                    f"{_steps(groups)}; bins of {width:,} steps. {_seeds(groups, [g.label for g in groups])}",
                    figures.draw_curves,
                    curves,
                    env_id,
                    "variance of TD errors",
                    log=True,
                )
            )
        return section

    def test_returns(self) -> Section:
        section = Section(
            "Test returns (Fig. 4)",
            f"{EPISODES} mean-action episodes of every finished run, if not said otherwise. A box pools the episodes "
            "of all seeds, the dots are the means of the seeds: a tight box with dots far apart is a policy that "
            "repeats itself, and a training that does not.",
        )
        for env_id, groups in self.by_env(self.groups).items():
            tested = []
            for group in headline(groups):
                returns = [r for run in group.finished if (r := read_test_returns(run)) is not None]
                if returns:
                    fewest = min(map(len, returns))
                    tested.append((group, np.array([r[:fewest] for r in returns])))
            if tested:
                some = [group for group, _ in tested]
                labels = [group.label for group in some]
                section.pictures.append(
                    self.draw(
                        f"test-returns-{env_id}",
                        f"After {_steps(some)}. " + _seeds(some, labels, [len(r) for _, r in tested]),
                        figures.draw_box_plots,
                        labels,
                        [self.colors[label] for label in labels],
                        [returns for _, returns in tested],
                        f"{env_id}, {_steps(some)}",
                    )
                )
        return section

    def published(self) -> Section:
        section = Section(
            "Published returns",
            "What others state, as they state it: other versions of the environments (v2 to v5 differ in physics and "
            "in rewards), other numbers of steps, other ways of choosing a number (a best checkpoint is higher than a "
            "last one). They say whether ours are of the right size, and no more. Steps and seeds that differ by task "
            "are in the order of the columns. The TDC-λ paper itself prints no returns, only curves.",
        )
        self.add_table(section, "published", tables.make_published_table(self.returns))
        self.add_table(
            section,
            "published_curves",
            tables.make_published_curves_table(self.groups),
            "Published learning curves at the number of steps of ours, as mean [95 % interval of the mean over "
            "seeds]. Theirs are from the repository of SimbaV2, of evaluations with MuJoCo before 3.5.",
        )
        return section

    def claims(self) -> Section:
        section = Section(
            "The paper's claims",
            "What the paper says, against the runs that are here, on every task and number of steps. A verdict needs "
            "95 % intervals over seeds that do not overlap (Student's t for means, χ² for standard deviations); heads "
            "are interchangeable if their intervals lie within a tenth of each other. Everything else is undecided: "
            f"one seed decides nothing, and fewer than {MIN_SEEDS_OF_SPREAD} decide nothing about a spread.",
        )
        self.add_table(section, "claims", tables.make_claims_table(self.groups))
        return section

    def missing(self, runs: Sequence[Run], unreadable: Sequence[str]) -> Section:
        section = Section(
            "What is here, and what is missing",
            "Seeds with finished runs, for each of the paper's experiments; λ and the head decide to which a run "
            "belongs, whatever its steps. The paper does not say how many seeds it used.",
            tables=provenance.compare_with_paper(runs),
        )
        unfinished = provenance.list_unfinished(runs, unreadable)
        if len(unfinished):
            section.tables.insert(0, ("Runs that are not averaged", unfinished))
        return section


def _steps(groups: Sequence[Group]) -> str:
    return _and([f"{steps:,}" for steps in sorted({group.n_timesteps for group in groups})]) + " steps"


def _seeds(groups: Sequence[Group], labels: Sequence[str], numbers: Sequence[int] | None = None) -> str:
    """Seeds of each line of a figure: ``"Seeds: TDC 3 (1, 2, 3); SAC 1 (1)."``."""
    counted = [group.seeds for group in groups] if numbers is None else list(map(str, numbers))
    return "Seeds: " + "; ".join(f"{label}: {seeds}" for label, seeds in zip(labels, counted, strict=True)) + "."


def _and(words: Sequence[str]) -> str:
    return ", ".join(words[:-1]) + " and " + words[-1] if len(words) > 1 else "".join(words)
