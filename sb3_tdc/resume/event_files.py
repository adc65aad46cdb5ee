"""TensorBoard's event files: cut to their captured sizes, then continued in a new file without a gap or a duplicate."""

import os
import re
import shutil
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

from stable_baselines3.common.logger import TensorBoardOutputFormat

from sb3_tdc.common.files import make_numbered, sync
from sb3_tdc.resume.locations import Locations


def capture_event_files(output: TensorBoardOutputFormat) -> dict[str, Any]:
    """Return the folder of the event files, and the size of each file in it in bytes."""
    output.writer.flush()
    folder = Path(output.writer.log_dir)
    sizes = {}
    for path in _event_files(folder):
        sync(path)
        sizes[path.name] = path.stat().st_size
    return {"folder": os.path.abspath(folder), "sizes": sizes}


def restore_event_files(
    output: TensorBoardOutputFormat, state: dict[str, Any], step: int, locations: Locations
) -> None:
    """
    Remove the events that this process has written so far, and those written after the state was captured.

    The files stay in their folder. If this folder is outside the run's folder and the run is a copy, the folder belongs
    to the original run. The copy then continues with copies of the files, in a folder of its own.

    :param step: the timestep of the state; a TensorBoard that is watching discards the events that it has seen after it
    """
    from torch.utils.tensorboard.writer import SummaryWriter

    opened = Path(output.writer.log_dir)
    # Not every file in the folder: SB3 opens the latest one, of any run, if ``reset_num_timesteps`` is False
    written = Path(output.writer.file_writer.event_writer._file_name)  # type: ignore[attr-defined]  # untyped
    output.writer.close()
    written.unlink(missing_ok=True)
    folder = _find_folder(opened, state, locations)
    for path in _event_files(folder):
        if path.name not in state["sizes"]:
            path.unlink()
        elif path.stat().st_size > state["sizes"][path.name]:
            os.truncate(path, state["sizes"][path.name])
    if folder != opened:
        with suppress(OSError):  # not empty: it was not made for this process
            opened.rmdir()
    with _named_after(state["sizes"]):
        output.writer = SummaryWriter(str(folder), purge_step=step + 1)


def _find_folder(opened: Path, state: dict[str, Any], locations: Locations) -> Path:
    """
    Return the folder in which the run's events continue: that of the captured files, or one without other files.

    :param opened: the folder that this process has opened, which may be of another run
    """
    captured = Path(state["folder"])
    is_of_original = locations.is_copy and not locations.contains(captured)
    if _holds_any(captured, state["sizes"]) and not is_of_original:
        return captured
    is_captured = os.path.realpath(opened) == os.path.realpath(captured)
    if _event_files(opened) and (is_captured or not _holds_any(opened, state["sizes"])):
        opened = make_numbered(opened.parent, re.sub(r"_\d+$", "", opened.name))
    for path in _event_files(captured):
        if path.name in state["sizes"]:
            shutil.copy2(path, opened)
    return opened


def _holds_any(folder: Path, names: Iterable[str]) -> bool:
    return any((folder / name).is_file() for name in names)


@contextmanager
def _named_after(names: Iterable[str]) -> Iterator[None]:
    """
    Give an event file that is opened in this block a name that sorts after the given ones.

    TensorBoard reads event files in the order of their names, which begin with the second in which they were opened.
    Since then, the clock may have been set back, or the second may not have passed.
    """
    from tensorboard.summary.writer import event_file_writer

    found = [re.match(r"events\.out\.tfevents\.(\d+)", name) for name in names]
    second = max([time.time(), *(int(match[1]) + 1 for match in found if match)])
    with mock.patch.object(event_file_writer, "time", SimpleNamespace(time=lambda: second)):
        yield


def _event_files(folder: Path) -> list[Path]:
    return sorted(folder.glob("events.out.tfevents.*"))
