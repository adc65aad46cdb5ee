"""What the command lines of ``train.py`` and ``enjoy.py`` have in common."""

import argparse
import importlib
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import torch as th

from sb3_tdc import plain_yaml
from sb3_tdc.hyperparams import suggest

# NumPy takes no seed above 2**32, and environments are seeded with this one and a little more
MAX_SEED = 2**31 - 1


class _HelpFormatter(argparse.ArgumentDefaultsHelpFormatter):
    """Show defaults, where they are values: of a flag that is not given there is none to show."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        says_nothing = action.default is None or isinstance(action.default, bool) or action.default in ([], {}, "")
        return action.help if says_nothing else super()._get_help_string(action)


class Parser(argparse.ArgumentParser):
    """
    An argument parser that names the nearest flag for a misspelt one.

    :param zoo_flags: flags of RL Zoo that have another form here, and which
    """

    def __init__(self, description: str, zoo_flags: Mapping[str, str] | None = None):
        self.zoo_flags = zoo_flags or {}
        super().__init__(description=description, allow_abbrev=False, formatter_class=_HelpFormatter)

    def parse_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> argparse.Namespace:
        parsed, unknown = self.parse_known_args(args, namespace)
        if unknown:
            if unknown[0] in self.zoo_flags:
                self.error(f"{unknown[0]} is RL Zoo's: {self.zoo_flags[unknown[0]]}")
            flags = [flag for action in self._actions for flag in action.option_strings]
            self.error(f"unknown argument {unknown[0]!r}{suggest(unknown[0], flags)}")
        return parsed

    def parse_given(self, args: Sequence[str] | None = None) -> dict[str, Any]:
        """:return: the arguments that are on the command line, without the defaults of the others"""
        absent = object()
        names = {action.dest for action in self._actions}
        parsed = self.parse_args(args, argparse.Namespace(**dict.fromkeys(names, absent)))
        return {name: value for name, value in vars(parsed).items() if value is not absent}

    def fail(self, error: Exception) -> NoReturn:
        """Print one sentence and leave with status 2, as for a bad argument."""
        self.exit(2, f"{self.prog}: error: {error}\n")


class KeyValues(argparse.Action):
    """``key:value key:value`` → a dict; the values are YAML, never evaluated. A second flag adds to the first."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, option: str | None = None
    ) -> None:
        pairs = {}
        for text in values:
            key, colon, value = text.partition(":")
            if not colon or not key:
                raise argparse.ArgumentError(self, f"must be key:value, got {text!r}")
            try:
                pairs[key] = plain_yaml.load(value, key)
            except ValueError:
                raise argparse.ArgumentError(self, f"the value of {key} is not valid YAML: {value!r}") from None
        setattr(namespace, self.dest, {**_given_before(namespace, self, dict), **pairs})


class Names(argparse.Action):
    """``name name`` → a list. A second flag adds to the first."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, option: str | None = None
    ) -> None:
        setattr(namespace, self.dest, [*_given_before(namespace, self, list), *values])


def _given_before(namespace: argparse.Namespace, action: argparse.Action, kind: type) -> Any:
    value = getattr(namespace, action.dest, None)
    return value if isinstance(value, kind) and value is not action.default else kind()


def check_writable(flag: str, path: Path) -> None:
    """
    Make the folder of a file that will be written.

    :raises ValueError: if it cannot be written
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        existed = path.exists()
        with path.open("ab"):
            pass
        if not existed:
            path.unlink()
    except OSError as error:
        raise ValueError(f"{flag} {path} cannot be written: {error.strerror}") from error


def one_of(kind: str, known: Iterable[str]) -> Callable[[str], str]:
    """:return: an argument type that takes one of the known names, and else names the nearest"""

    def check(name: str) -> str:
        if name not in known:
            raise argparse.ArgumentTypeError(
                f"unknown {kind} {name!r}{suggest(name, known)}; known: {', '.join(known)}"
            )
        return name

    return check


def add_package_argument(parser: Parser) -> None:
    """For :func:`import_packages`."""
    parser.add_argument(
        "--gym-packages", nargs="+", action=Names, default=[], help="packages to import, that register environments"
    )


def add_common_arguments(parser: Parser, algorithms: Iterable[str]) -> None:
    """The flags that training and enjoying share, as in RL Zoo."""
    parser.add_argument("--algo", type=one_of("algorithm", algorithms), default="tdc", help="algorithm")
    parser.add_argument("-f", "--log-folder", "--folder", default="logs", help="folder of all runs")
    parser.add_argument("--num-threads", type=int, default=-1, help="threads for PyTorch (-1: two, if there are)")
    parser.add_argument("--device", default="auto", help="PyTorch device (cpu, cuda, ...)")
    add_package_argument(parser)
    parser.add_argument("--env-kwargs", nargs="+", action=KeyValues, default={}, help="key:value of the environment")


def plain_arguments(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """:return: arguments by name, as they are written to a folder"""
    return {name: str(value) if isinstance(value, Path) else value for name, value in arguments.items()}


def import_packages(args: argparse.Namespace, env_id: str) -> str:
    """
    Import the packages of ``--gym-packages``, which register environments.

    :param env_id: perhaps with its package, as in "package:Env-v0", which is then one of the packages
    :return: the environment's id alone
    :raises ValueError: for a package that is not installed, with the command that installs it
    """
    package, _, env_id = env_id.rpartition(":")
    if package:
        args.gym_packages = [*args.gym_packages, package]
    for package in args.gym_packages:
        try:
            importlib.import_module(package)
        except ModuleNotFoundError as error:
            raise ValueError(
                f"--gym-packages {package}: there is no module {error.name!r}: pip install {error.name}"
            ) from error
    return env_id


def apply_common_arguments(args: argparse.Namespace, env_id: str) -> str:
    """
    :func:`import_packages`, and set the number of threads.

    :param env_id: perhaps with its package
    :return: the environment's id alone
    :raises ValueError: for a package that is not installed
    """
    env_id = import_packages(args, env_id)
    if args.num_threads > 0:
        th.set_num_threads(args.num_threads)
    elif "OMP_NUM_THREADS" not in os.environ:  # networks of this size gain nothing from more
        th.set_num_threads(min(2, th.get_num_threads()))
    return env_id
