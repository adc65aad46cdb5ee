"""The report on a folder of runs: figures and tables, next to the paper's and other published results.

It is one self-contained HTML file, with the same figures (SVG, PNG, PDF) and tables (CSV) next to it, and a list of
them. It is made from the files of runs alone, without training or playing anything.
"""

from collections.abc import Sequence
from pathlib import Path

from sb3_tdc.advb.algorithms import Advised
from sb3_tdc.common.words import count, listed
from sb3_tdc.experiments import provenance
from sb3_tdc.experiments.groups import Group, group_runs
from sb3_tdc.experiments.results import Run
from sb3_tdc.experiments.sections import Report
from sb3_tdc.runs.algorithms import KNOWN_ALGORITHMS


def make_warnings(groups: Sequence[Group]) -> list[str]:
    """Return the warnings that a reader must know before looking at a figure."""
    shares = sorted({g.share for g in groups if g.finished and g.shipped_steps})
    fewest = min((len(g.finished) for g in groups if g.finished), default=0)
    said = []
    if not fewest:
        said.append("No run is finished and evaluated: there is nothing to average yet.")
    if shares and shares[0] < 1:
        share = (
            f"{100 * shares[0]:.3g} %"
            if shares[0] == shares[-1]
            else f"{100 * shares[0]:.3g} to {100 * shares[-1]:.3g} %"
        )
        said.append(
            f"These runs take {share} of the steps in hyperparams/ (the paper's, for its tasks). They do not say "
            "how algorithms compare at full length."
        )
    if 0 < fewest < 5:
        said.append(
            f"As few as {count(fewest, 'seed')} a group: differences between algorithms smaller than the spread "
            "across seeds mean nothing."
        )
    if mixed := [f"{g.label} on {g.conditions}" for g in groups if len(g.commits) > 1]:
        said.append(
            f"Seeds of {count(len(mixed), 'group')} were trained by several commits of sb3_tdc ({listed(mixed)}): "
            "see the commits below."
        )
    advised = [g for g in groups if g.finished and issubclass(KNOWN_ALGORITHMS.get(g.algo, object), Advised)]
    said += [f"{g.label} on {g.conditions}: {_describe_board(g)}" for g in advised]
    return said


def _describe_board(group: Group) -> str:
    steps = [int(logged[-1]) for run in group.finished if len(logged := run.progress("board/test_steps"))]
    further = f"up to {max(steps):,}" if steps else "an unknown number of"
    return (
        f"the board acts in evaluations. Its test episodes took {further} further environment steps a run, not counted."
    )


def write_report(runs: Sequence[Run], unreadable: Sequence[str], folder: Path) -> Path:
    """
    Write the page, its figures and its tables.

    :param unreadable: one sentence for each run that cannot be read
    :param folder: created if it does not exist; figures and tables of an earlier report in it are removed
    :return: the page
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    groups = group_runs(runs)
    report = Report(groups, folder)
    sections = [
        report.learning_curves(),
        report.returns_section(),
        report.test_returns(),
        report.lambda_sweep(),
        report.heads(),
        report.other_settings(),
        report.td_errors(),
        report.claims(),
        report.published(),
        report.missing(runs, unreadable),
    ]
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    page = environment.get_template("report.html").render(
        sections=sections,
        warnings=make_warnings(groups),
        counts=[
            count(n, noun).split(" ", 1)
            for n, noun in (
                (sum(run.is_finished for run in runs), "finished run"),
                (sum(not run.is_finished for run in runs), "unfinished run"),
                (len({run.env_id for run in runs}), "environment"),
                (len(groups), "group"),
            )
        ],
        groups=provenance.describe_groups(groups),
        runs=provenance.describe_runs(runs),
        machine=provenance.describe_machine(),
    )
    path = folder / "report.html"
    folder.mkdir(parents=True, exist_ok=True)
    path.write_text(page, encoding="utf-8")
    report.files.remove_old()
    return path
