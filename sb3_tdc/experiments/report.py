"""The report on a folder of runs: figures and tables, next to the paper's and other published results.

One HTML file that needs no other, and the same figures (SVG, PNG, PDF) and tables (CSV) next to it. Reads only what
runs have left; trains and plays nothing.
"""

from collections.abc import Sequence
from pathlib import Path

from sb3_tdc.algorithms import ALGORITHMS
from sb3_tdc.experiments import figures, provenance
from sb3_tdc.experiments.curves import published_steps
from sb3_tdc.experiments.results import Group, Run, group_runs
from sb3_tdc.experiments.sections import Report


def warnings(groups: Sequence[Group]) -> list[str]:
    """What a reader must know before looking at a figure."""
    shares = sorted(
        {g.n_timesteps / published_steps(g.algo, g.env_id) for g in groups if g.finished and g.algo in ALGORITHMS}
    )
    fewest = min((len(g.finished) for g in groups if g.finished), default=0)
    said = []
    if not shares:
        said.append("No run is finished: there is nothing to average yet.")
    elif shares[0] < 1:
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
            f"As few as {figures.count_seeds(fewest)} a group: differences between algorithms smaller than the spread "
            "across seeds mean nothing."
        )
    return said


def write_report(runs: Sequence[Run], unreadable: Sequence[str], folder: Path) -> Path:
    """
    Write the page, its figures and its tables.

    :param folder: made if it does not exist
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
        warnings=warnings(groups),
        counts={
            "finished runs": sum(run.is_finished for run in runs),
            "unfinished": sum(not run.is_finished for run in runs),
            "environments": len({run.env_id for run in runs}),
            "sets of seeds": len(groups),
        },
        groups=provenance.describe_groups(groups),
        runs=provenance.describe_runs(runs),
        machine=provenance.describe_machine(),
    )
    path = folder / "report.html"
    folder.mkdir(parents=True, exist_ok=True)
    path.write_text(page, encoding="utf-8")
    return path
