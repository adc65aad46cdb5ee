"""The sections of the report: each states what it shows, draws its figures and fills its tables."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_tdc.ablations import ABLATIONS
from sb3_tdc.common.words import count, counted, listed
from sb3_tdc.experiments import figures, provenance, tables
from sb3_tdc.experiments.aggregate import Aggregate, aggregate
from sb3_tdc.experiments.claims import MIN_SEEDS_OF_SPREAD
from sb3_tdc.experiments.curves import bin_width, headline, make_curve, read_evaluations, read_td_errors
from sb3_tdc.experiments.final_episodes import EPISODES, read_test_returns
from sb3_tdc.experiments.groups import Conditions, Group, by_conditions, shared_differences, vary
from sb3_tdc.experiments.published_curves import published_curves
from sb3_tdc.experiments.report_files import Picture, ReportFiles
from sb3_tdc.experiments.results import Run
from sb3_tdc.experiments.suites import ISAAC, MUJOCO, PYBULLET
from sb3_tdc.experiments.variants import Comparison, compare_settings, compare_variants

# The end of two captions: how the columns of returns, difference and p-value are computed
_COMPARED = (
    "mean ± standard deviation over seeds of the evaluations in the last third of a run; the difference with Welch's "
    "95 % interval; its p-value, corrected by Holm's method for the number of comparisons with several seeds on the "
    "same task, of as many steps."
)


@dataclass
class Section:
    """
    A part of the page.

    :param tables: pairs of caption and formatted cells
    """

    title: str
    text: str
    pictures: list[Picture] = field(default_factory=list)
    tables: list[tuple[str, pd.DataFrame]] = field(default_factory=list)


class Report:
    """
    The sections of a page.

    :param folder: the folder that figures and tables are written to
    """

    def __init__(self, groups: Sequence[Group], folder: Path):
        self.groups, self.files = groups, ReportFiles(folder)
        self.returns = tables.make_returns_table(groups)
        self.conditions = by_conditions(groups, (*MUJOCO, *PYBULLET, *ISAAC))

    def add_table(self, section: Section, name: str, table: pd.DataFrame, caption: str = "") -> None:
        """Write a table of formatted cells and add it to a section, unless it is empty."""
        if len(table):
            self.files.write_table(name, table)
            section.tables.append((caption, table))

    def draw_learning_curves(
        self, name: str, groups: Sequence[Group], labels: Sequence[str], colors: Sequence[Any]
    ) -> Picture:
        """Draw the learning curves of groups under the same conditions."""
        conditions = groups[0].conditions
        width = max(map(bin_width, groups))
        curves = [
            make_curve(group, label, color, width, read_evaluations)
            for group, label, color in zip(groups, labels, colors, strict=True)
        ]
        episodes = sorted({run.evaluations.returns.shape[1] for g in groups for run in g.runs if run.evaluations})
        return self.files.draw(
            f"{name}-{conditions.file_name}",
            f"{_about(conditions)}; bins of {width:,} steps. {_seeds(labels, [g.seeds for g in groups])} "
            f"{shared_differences(groups)}",
            figures.draw_curves,
            curves,
            conditions.task,
            f"return of {counted(episodes, 'mean-action episode')}",
            published=[curve for curve in published_curves(conditions.env_id) if curve.algorithm == "SAC"],
        )

    def learning_curves(self) -> Section:
        section = Section(
            "Learning curves (Fig. 1, Fig. 5)",
            "Evaluations of the mean action, in bins of the paper's 20,000 steps, scaled with the length of the runs "
            "but never below the distance of evaluations. Thick: mean over seeds; band: 95 % interval of that mean "
            "(Student's t over seeds); thin: single seeds. One seed has no band. Unfinished runs are dotted and not "
            "averaged. The band of a few seeds can run off the axis, which is made for the seeds. Dashed: SAC "
            "as the repository of SimbaV2 has published it, with the interval of its seeds (MuJoCo before 3.5). "
            "Algorithms are shown as hyperparams/ has them, where they have been run so; other settings have figures "
            "below. One figure for each task, number of steps and MuJoCo (before or since 3.5). A bin is drawn at its "
            "last step. Where some were evaluated more often than others, it averages more of their evaluations.",
        )
        for groups in self.conditions.values():
            if shown := headline(groups):
                labels = [group.label for group in shown]
                section.pictures.append(
                    self.draw_learning_curves("learning-curve", shown, labels, figures.colors_of(labels))
                )
        return section

    def returns_section(self) -> Section:
        self.files.write_table("returns", self.returns)
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
        for number, one in enumerate(aggregate(self.groups), 1):
            self.add_aggregate(section, f"aggregate-{number}", one)
        return section

    def add_aggregate(self, section: Section, name: str, found: Aggregate) -> None:
        """Draw the scores over tasks, and write them as CSV."""
        labels, intervals, tasks = list(found.scores), found.intervals(), listed(found.env_ids)
        table = pd.DataFrame(intervals, columns=["iqm", "low", "high"])
        table = table.assign(algorithm=labels, tasks=tasks, length=found.length, mujoco=found.physics)
        self.files.write_table(name, table)
        physics = f", MuJoCo {found.physics}" if found.physics else ""
        left_out = f" Left out, for want of two seeds: {listed(found.left_out)}." if found.left_out else ""
        section.pictures.append(
            self.files.draw(
                name,
                f"Final returns over {tasks}, {found.length}{physics}: interquartile mean of scores with its 95 % "
                "stratified bootstrap interval. 0 and 1 are the lowest and highest single run on a task, of those that "
                f"are compared here.{left_out}",
                figures.draw_intervals,
                [f"{label}\n{count(sum(map(len, found.scores[label])), 'run')}" for label in labels],
                figures.colors_of(labels),
                intervals,
                f"{count(len(found.env_ids), 'task')}, {found.length}",
                "IQM of normalised final returns",
            )
        )

    def lambda_sweep(self) -> Section:
        section = Section(
            "λ (Fig. 3)",
            "Groups that differ in λ alone: learning curves, and, of at least two fixed λ, the final return against λ, "
            "every seed a dot, the mean a diamond with its 95 % t interval where there are several (that of a few "
            "seeds can run off the axis). A schedule has no place on that axis. The paper's λ are 0, 0.25, 0.5, 0.75 "
            "and 1 on Humanoid and HalfCheetah. "
            "Then variants of TDC next to the runs that they are compared with.",
        )
        import matplotlib

        for number, groups in enumerate(self.ablations("lam"), 1):
            values = [group.setting("lam") for group in groups]
            colors = list(matplotlib.colormaps["viridis"](np.linspace(0, 0.85, len(groups))))
            labels = [f"λ = {value}" if isinstance(value, str) else f"λ = {value:g}" for value in values]
            section.pictures.append(self.draw_learning_curves(f"lambda-curves-{number}", groups, labels, colors))
            numbers = [group for group in groups if group.finished and not isinstance(group.setting("lam"), str)]
            if len(numbers) > 1:
                section.pictures.append(self.draw_sweep(f"lambda-sweep-{number}", numbers))
        compared = compare_variants(self.groups)
        section.pictures += self.draw_comparisons("variant", [one for one in compared if one.variant.algo in ABLATIONS])
        self.add_table(
            section,
            "lambda",
            tables.make_lam_table(self.groups),
            "What λ does, in the last third of the runs: means over seeds ± standard deviation. With λ = 0 nothing "
            "is changed, by definition. λ* is the least λ that would change a choice, where there is one. "
            "Overestimation is what the critics predict minus the return that follows; scatter is that of returns "
            "about their best line in the prediction.",
        )
        self.add_table(
            section,
            "variants",
            tables.make_comparisons_table(compared),
            f"Variants of TDC, each against the control that differs in one thing: {_COMPARED}",
        )
        return section

    def other_settings(self) -> Section:
        section = Section(
            "Other settings",
            "Groups with other settings than those of hyperparams/, each next to the same algorithm as hyperparams/ "
            "has it, if that was run with the same other settings. λ and the head alone have sections of their own.",
        )
        compared = compare_settings(self.groups)
        section.pictures += self.draw_comparisons("setting", compared)
        caption = f"Each against the same algorithm as hyperparams/ has it: {_COMPARED}"
        self.add_table(section, "settings", tables.make_comparisons_table(compared), caption)
        return section

    def draw_comparisons(self, name: str, compared: Sequence[Comparison]) -> list[Picture]:
        """Draw the learning curves of each variant next to its control, numbered under the same conditions."""
        pictures = []
        for conditions in self.conditions:
            alike = [one for one in compared if one.variant.conditions == conditions]
            for number, one in enumerate(alike, 1):
                shown = [one.control, one.variant]
                labels = [group.label for group in shown]
                pictures.append(self.draw_learning_curves(f"{name}-{number}", shown, labels, figures.colors_of(labels)))
        return pictures

    def draw_sweep(self, name: str, groups: Sequence[Group]) -> Picture:
        """Draw final returns against λ, for groups that differ only in a fixed λ."""
        conditions, values = groups[0].conditions, [group.setting("lam") for group in groups]
        return self.files.draw(
            f"{name}-{conditions.file_name}",
            f"{_about(conditions)}. {_seeds([f'λ = {value:g}' for value in values], [g.seeds for g in groups])} "
            f"{shared_differences(groups)}",
            figures.draw_sweep,
            values,
            [group.final_returns for group in groups],
            str(conditions),
            "λ",
            figures.COLORS["TDC"],
        )

    def heads(self) -> Section:
        section = Section(
            "Deterministic and stochastic head (Fig. 2)",
            "Groups of TDC that differ in the head alone. Both are evaluated by the mean action.",
        )
        for number, groups in enumerate(self.ablations("stochastic_actor"), 1):
            labels = ["stochastic" if group.setting("stochastic_actor") else "deterministic" for group in groups]
            colors = [figures.COLORS["TDC"], figures.OTHER_COLORS[0]]
            section.pictures.append(self.draw_learning_curves(f"heads-{number}", groups, labels, colors))
        return section

    def ablations(self, key: str) -> list[list[Group]]:
        """Return lists of TDC groups with evaluations that differ only in one setting."""
        groups = (group for alike in self.conditions.values() for group in alike if group.algo == "tdc")
        return vary([group for group in groups if any(run.evaluations for run in group.runs)], key)

    def td_errors(self) -> Section:
        section = Section(
            "Variance of TD errors (Fig. S1)",
            "Variance over the minibatch of δ = mean target − mean of the critic's quantiles (train/td_error_var), on "
            "a logarithmic axis; means and 95 % t intervals are those of its logarithm. The paper compares λ = 0 and "
            "λ = 1 on Hopper. Returns that grow make TD errors grow too: a smaller variance is not by itself a "
            "better run.",
        )
        for conditions, groups in self.conditions.items():
            shown = [group for group in groups if group.algo == "tdc"]
            labels = [group.label for group in shown]
            width = max(map(bin_width, shown), default=1)
            curves = [
                make_curve(group, label, color, width, read_td_errors)
                for group, label, color in zip(shown, labels, figures.colors_of(labels), strict=True)
            ]
            if not any(np.isfinite(curve.values).any() for curve in curves):
                continue
            section.pictures.append(
                self.files.draw(
                    f"td-error-variance-{conditions.file_name}",
                    f"{_about(conditions)}; bins of {width:,} steps. {_seeds(labels, [g.seeds for g in shown])} "
                    f"{shared_differences(shown)}",
                    figures.draw_curves,
                    curves,
                    conditions.task,
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
        for conditions, groups in self.conditions.items():
            shown = [(g, read_all_test_returns(g)) for g in headline(groups) if g.finished]
            played = [(group, returns) for group, returns in shown if len(returns)]
            if not played:
                continue
            labels = [group.label for group, _ in played]
            missing = [
                f"{group.label} ({len(group.finished) - len(returns)} of {count(len(group.finished), 'seed')})"
                for group, returns in shown
                if len(returns) < len(group.finished)
            ]
            section.pictures.append(
                self.files.draw(
                    f"test-returns-{conditions.file_name}",
                    f"After {_about(conditions)}. {_seeds(labels, [len(returns) for _, returns in played])} "
                    + (f"Without test episodes: {listed(missing)}. " if missing else "")
                    + shared_differences([group for group, _ in played]),
                    figures.draw_box_plots,
                    labels,
                    figures.colors_of(labels),
                    [returns for _, returns in played],
                    str(conditions),
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
            "What the paper says, against the runs that are here, on the tasks that it says it of, for each number "
            "of steps and MuJoCo. What it says of the spread of test episodes (Fig. 4) is drawn above and not "
            "judged. A verdict needs 95 % intervals over seeds that do not overlap (Student's t for "
            "means, χ² for standard deviations over seeds). Returns are comparable, and heads interchangeable, if the "
            "intervals lie within a tenth of each other. Everything else is undecided: one seed decides nothing, and "
            f"fewer than {MIN_SEEDS_OF_SPREAD} decide nothing about a standard deviation over seeds.",
        )
        self.add_table(section, "claims", tables.make_claims_table(self.groups))
        return section

    def missing(self, runs: Sequence[Run], unreadable: Sequence[str]) -> Section:
        section = Section(
            "What is here, and what is missing",
            "Seeds with finished runs, and after how many steps, for each of the paper's experiments. A run belongs "
            "to one if its hyperparameters are those of hyperparams/, but for what the experiment varies. The paper "
            "does not say how many seeds it used.",
            tables=provenance.compare_with_paper(runs),
        )
        unfinished = provenance.list_unfinished(runs, unreadable)
        if len(unfinished):
            section.tables.insert(0, ("Runs that are not averaged", unfinished))
        return section


def read_all_test_returns(group: Group) -> np.ndarray:
    """
    Read the test returns of a group.

    :return: (finished runs with test returns, episodes that all of these have played)
    """
    played = [returns for run in group.finished if (returns := read_test_returns(run)) is not None]
    fewest = min(map(len, played), default=0)
    return np.array([returns[:fewest] for returns in played]).reshape(len(played), fewest)


def _about(conditions: Conditions) -> str:
    """Return the number of steps, and MuJoCo's version where it matters."""
    physics = f" with MuJoCo {conditions.mujoco}" if conditions.mujoco else ""
    return f"{conditions.n_timesteps:,} steps{physics}"


def _seeds(labels: Sequence[str], seeds: Iterable[object]) -> str:
    """List the seeds of each line of a figure: ``"Seeds: TDC: 3 (1, 2, 3); SAC: 1 (1)."``."""
    return "Seeds: " + "; ".join(f"{label}: {which}" for label, which in zip(labels, seeds, strict=True)) + "."
