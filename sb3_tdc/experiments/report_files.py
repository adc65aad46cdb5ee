"""The files next to the page of a report: figures and tables, with a list of them."""

import base64
import io
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

# The files that a report has written next to its page, one path per line: the next report removes old ones
_LIST = "report_files.txt"


@dataclass(frozen=True)
class Picture:
    """
    A figure as the page shows it.

    :param svg: the figure as SVG, base64-encoded
    """

    name: str
    caption: str
    svg: str


class ReportFiles:
    """
    The figures and tables that a report writes.

    :param folder: created with the first file
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self.names: list[str] = []

    def new_file(self, name: str) -> Path:
        """Return the path for a new file of the report, and add it to the list."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        self.names.append(name)
        with (self.folder / _LIST).open("a", encoding="utf-8") as files:  # now: the report may stop half-way
            files.write(f"{name}\n")
        return path

    def draw(self, name: str, caption: str, function: Callable[..., None], *args: Any, **kwargs: Any) -> Picture:
        """Draw one figure with a function of axes and arrays, and write it as SVG, PNG and PDF."""
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
        """Write a table as CSV."""
        table.to_csv(self.new_file(f"tables/{name}.csv"), index=False)

    def remove_old(self) -> None:
        """Remove figures and tables that only an earlier report wrote (their runs may be gone), and nothing else."""
        for name in {*(self.folder / _LIST).read_text(encoding="utf-8").splitlines()} - {*self.names}:
            if re.fullmatch(r"(figures|tables)/[^/]+", name) and (self.folder / name).is_file():
                (self.folder / name).unlink()
        (self.folder / _LIST).write_text("".join(f"{name}\n" for name in self.names), encoding="utf-8")
