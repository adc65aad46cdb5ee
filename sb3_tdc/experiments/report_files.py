"""The files next to the page of a report: figures and tables, with a list of them."""

import base64
import io
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

# What a report has written next to its page, one path a line: the next report removes these
_LIST = "report_files.txt"


@dataclass(frozen=True)
class Picture:
    """
    A figure as the page shows it.

    :param svg: base64
    """

    name: str
    caption: str
    svg: str


class ReportFiles:
    """
    Write the figures and tables of a report.

    :param folder: made with the first of them
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self.names: list[str] = []

    def new_file(self, name: str) -> Path:
        """Return where a file of the report is written, and add it to the list."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        self.names.append(name)
        with (self.folder / _LIST).open("a", encoding="utf-8") as files:  # known even if the report stops half-way
            files.write(f"{name}\n")
        return path

    def draw(self, name: str, caption: str, function: Callable[..., None], *args: Any, **kwargs: Any) -> Picture:
        """Draw one figure by a function of axes and arrays, and write it as SVG, PNG and PDF."""
        import matplotlib
        from matplotlib.figure import Figure

        with matplotlib.rc_context({"font.size": 9, "svg.hashsalt": name}):
            figure = Figure(figsize=(4.8, 3.4), layout="constrained")
            function(figure.subplots(), *args, **kwargs)
            file = re.sub(r"[^\w.-]+", "_", name)
            for suffix in ("png", "pdf"):
                figure.savefig(self.new_file(f"figures/{file}.{suffix}"), dpi=200)
            svg = io.BytesIO()
            figure.savefig(svg, format="svg")
        self.new_file(f"figures/{file}.svg").write_bytes(svg.getvalue())
        return Picture(file, caption, base64.b64encode(svg.getvalue()).decode())

    def write_table(self, name: str, table: pd.DataFrame) -> None:
        """Write numbers as CSV."""
        table.to_csv(self.new_file(f"tables/{name}.csv"), index=False)

    def remove_old(self) -> None:
        """Remove figures and tables of an earlier report, and nothing else: some may be of runs that are gone."""
        for name in {*(self.folder / _LIST).read_text(encoding="utf-8").splitlines()} - {*self.names}:
            if re.fullmatch(r"(figures|tables)/[^/]+", name) and (self.folder / name).is_file():
                (self.folder / name).unlink()
        (self.folder / _LIST).write_text("".join(f"{name}\n" for name in self.names), encoding="utf-8")
