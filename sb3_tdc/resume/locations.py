"""Where the files of a run were when its state was captured, and where they are now."""

import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Locations:
    """
    Find the present location for every text and path in a captured state.

    A location that never changed since the run was built stays as it is built now; one in the run's folder moves with
    the folder; any other is what it was. It is plain data, so that it reaches environments in other processes.

    :param directory: the working directory of the process that captured the state
    :param folders: how the run's folder was reached from there: its absolute path, with and without symbolic links
    :param folder: the run's folder now
    :param built: the texts that objects were built with, by path
    """

    directory: str = ""
    folders: tuple[str, ...] = ()
    folder: str = ""
    built: dict[str, str] = field(default_factory=dict)

    @classmethod
    def capture(cls, folder: Path, built: dict[str, str]) -> dict[str, Any]:
        """Return as JSON what :meth:`restore` takes."""
        return {
            "directory": os.getcwd(),
            "folders": list(dict.fromkeys([os.path.abspath(folder), os.path.realpath(folder)])),
            "built": built,
        }

    @classmethod
    def restore(cls, captured: dict[str, Any], folder: Path) -> "Locations":
        """
        Read the locations of a state.

        :param folder: the run's folder now
        """
        return cls(captured["directory"], tuple(captured["folders"]), str(folder), captured["built"])

    def below(self, path: str) -> "Locations":
        """Return the same for a nested capture, whose paths begin after ``path``."""
        texts = {name.removeprefix(path): text for name, text in self.built.items() if name.startswith(path)}
        return replace(self, built=texts)

    @property
    def is_copy(self) -> bool:
        """Return whether the folder that the state was captured in still exists elsewhere."""
        return any(os.path.isdir(then) and not os.path.samefile(then, self.folder) for then in self.folders)

    def contains(self, path: Path) -> bool:
        """Return whether a present path lies in the run's folder."""
        return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(self.folder))

    def find(self, text: str, existing: Any, path: str, is_path: bool = False) -> str:
        """
        Find a captured text again, as it is in this run.

        :param text: perhaps a location
        :param existing: the text that was built in its place now, if any
        :param path: how the text is reached in the state
        :param is_path: whether it certainly is a location; else it is one if it, or what is there now, has a slash
        :return: the text in its place from now on
        """
        then_or_now = f"{text}{existing}" if type(existing) is str else text
        if not self.folders or not (is_path or os.sep in then_or_now or self._then(text) in self.folders):
            return text
        if type(existing) is str and self.built.get(path) == text:
            return existing
        inside = self.inside(text, is_path)
        return text if inside is None else os.path.normpath(os.path.join(self.folder, inside))

    def inside(self, text: str, is_path: bool = True) -> str | None:
        """Return a location relative to the run's folder; None if it lies elsewhere."""
        then = self._then(text)
        for folder in self.folders:
            # In a run folder that is the working directory, any text with a slash would be a file of it
            if not (is_path or os.path.isabs(text)) and folder == self.directory:
                continue
            if then == folder or then.startswith(folder.rstrip(os.sep) + os.sep):
                return os.path.relpath(then, folder)
        return None

    def _then(self, text: str) -> str:
        return os.path.normpath(os.path.join(self.directory, text))


UNMOVED = Locations()
