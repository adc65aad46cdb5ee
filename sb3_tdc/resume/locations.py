"""Locations of a run's files: where they were when the state was captured, and where they are now."""

import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Locations:
    """
    Mapping from the texts and paths in a captured state to their present locations.

    A location that the run has not changed since it was built takes the value that it is built with now. A changed
    location in the run's folder moves with the folder. Any other location keeps its captured value. All fields are
    plain data, so that they can be sent to environments in other processes.

    :param directory: the working directory of the process that captured the state
    :param folders: the run's folder at that time: its absolute path, before and after symbolic links are resolved
    :param folder: the run's folder now
    :param built: the texts that objects were built with, by path in the state
    :param given: the relative path with which relative locations in the run's folder begin; empty if they cannot be
        recognised
    """

    directory: str = ""
    folders: tuple[str, ...] = ()
    folder: str = ""
    built: dict[str, str] = field(default_factory=dict)
    given: str = ""

    @classmethod
    def capture(cls, folder: Path, built: dict[str, str]) -> dict[str, Any]:
        """Return the locations of a run as JSON, for :meth:`restore`."""
        directory, resolved = os.getcwd(), os.path.realpath(folder)
        # If the working directory is in the run's folder, the relative path is "." or "..": any text with a slash
        # could then be a file of the run
        is_telling = not folder.is_absolute() and not Path(directory).is_relative_to(resolved)
        return {
            "directory": directory,
            "folders": list(dict.fromkeys([os.path.abspath(folder), resolved])),
            "given": os.path.normpath(folder) if is_telling else "",
            "built": built,
        }

    @classmethod
    def restore(cls, captured: dict[str, Any], folder: Path) -> "Locations":
        """
        Read the locations from a state.

        :param folder: the run's folder now
        """
        directory, folders = captured["directory"], tuple(captured["folders"])
        return cls(directory, folders, str(folder), captured["built"], captured.get("given", ""))

    def below(self, path: str) -> "Locations":
        """Return the locations for a nested capture, whose paths lack the prefix ``path``."""
        texts = {name.removeprefix(path): text for name, text in self.built.items() if name.startswith(path)}
        return replace(self, built=texts)

    def of_names(self) -> "Locations":
        """Return the locations for texts that are names: only an absolute path is taken for a location."""
        return replace(self, given="")

    @property
    def is_copy(self) -> bool:
        """Return whether this run is a copy: the folder that the state was captured in still exists elsewhere."""
        return any(os.path.isdir(then) and not os.path.samefile(then, self.folder) for then in self.folders)

    def contains(self, path: Path) -> bool:
        """Return whether a present path lies in the run's folder."""
        return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(self.folder))

    def find(self, text: str, existing: Any, path: str, is_path: bool = False) -> str:
        """
        Return the value that a captured text takes in this run.

        :param text: the captured text, which may be a location
        :param existing: the text that was built in its place now, if any
        :param path: the path of the text in the state
        :param is_path: whether the text certainly is a location; otherwise it is one if it or ``existing`` has a slash
        :return: the text to put in its place
        """
        if not self.folders:
            return text
        then_or_now = f"{text}{existing}" if type(existing) is str else text
        inside = self._inside(text, is_path)
        if inside is None and not is_path and os.sep not in then_or_now:
            return text
        if type(existing) is str and self.built.get(path) == text:
            return existing
        return text if inside is None else os.path.normpath(os.path.join(self.folder, inside))

    def _inside(self, text: str, is_path: bool) -> str | None:
        """Return a location relative to the run's folder; None if it lies elsewhere or is not a location."""
        if not (is_path or os.path.isabs(text) or (self.given and _is_in(os.path.normpath(text), self.given))):
            return None
        then = os.path.normpath(os.path.join(self.directory, text))
        return next((os.path.relpath(then, folder) for folder in self.folders if _is_in(then, folder)), None)


def _is_in(path: str, folder: str) -> bool:
    return Path(path).is_relative_to(folder)


UNMOVED = Locations()
