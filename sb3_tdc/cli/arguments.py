"""Argument parsing that the commands share."""

import argparse
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import Field, fields
from pathlib import Path
from typing import Any, NoReturn

from sb3_tdc.common import plain_yaml
from sb3_tdc.common.checks import suggest, unknown
from sb3_tdc.common.commands import command
from sb3_tdc.runs.settings import Group, RunSettings, default_of, flags_of

# Flags are added to a parser, or to an argument group of it
_Container = argparse._ActionsContainer


class _HelpFormatter(argparse.ArgumentDefaultsHelpFormatter):
    """A formatter that shows a default unless it is None, a bool or empty, or the help names it already."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        says_nothing = action.default is None or isinstance(action.default, bool) or action.default in ([], {}, "")
        is_named = "(default" in (action.help or "")
        return action.help if says_nothing or is_named else super()._get_help_string(action)


class Parser(argparse.ArgumentParser):
    """
    An argument parser that suggests the nearest flag for a misspelt one.

    :param name: name of the command, or "" for none
    :param zoo_flags: flags of RL Zoo that do not exist here, each with the alternative
    """

    def __init__(self, name: str, description: str = "", zoo_flags: Mapping[str, str] | None = None):
        self.zoo_flags = zoo_flags or {}
        prog = command(name) if name else None
        super().__init__(prog=prog, description=description, allow_abbrev=False, formatter_class=_HelpFormatter)

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
        """Return only the arguments that are on the command line, without defaults."""
        absent = object()
        names = {action.dest for action in self._actions}
        parsed = self.parse_args(args, argparse.Namespace(**dict.fromkeys(names, absent)))
        return {name: value for name, value in vars(parsed).items() if value is not absent}

    def error(self, message: str) -> NoReturn:
        """Print one sentence and exit with status 2, without the usage text, which would fill a screen."""
        self.exit(2, f"{self.prog}: error: {message}\n")

    def fail(self, error: Exception) -> NoReturn:
        """Exit with the message of an exception, as for a bad argument."""
        self.error(str(error))


class KeyValues(argparse.Action):
    """``key:value key:value`` → a dict. Values are read as YAML, never evaluated. A repeated flag adds to the first."""

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
    """``name name`` → a list. A repeated flag adds to the first."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, option: str | None = None
    ) -> None:
        setattr(namespace, self.dest, [*_given_before(namespace, self, list), *values])


def _given_before(namespace: argparse.Namespace, action: argparse.Action, kind: type) -> Any:
    value = getattr(namespace, action.dest, None)
    return value if isinstance(value, kind) and value is not action.default else kind()


def one_of(kind: str, known: Iterable[str]) -> Callable[[str], str]:
    """Return an argument type that accepts the known names, and suggests the nearest one for any other."""

    def check(name: str) -> str:
        if name not in known:
            raise argparse.ArgumentTypeError(unknown(kind, name, known))
        return name

    return check


def add_trust(parser: _Container) -> None:
    """Add ``--trust``, for commands that load saved models."""
    help = "let the files run code, as SB3 does: only if you know their origin"
    parser.add_argument("--trust", action="store_true", help=help)


def warn_about_trust(is_given: bool) -> None:
    """Print a warning about ``--trust``, if it is given."""
    if is_given:
        print("--trust: whatever code these files hold runs with your rights", file=sys.stderr)


def add_settings(parser: _Container, names: Iterable[str]) -> None:
    """
    Add the flags of some settings of :class:`~sb3_tdc.runs.settings.RunSettings`.

    :param names: names of the settings
    """
    names = set(names)
    for declared in fields(RunSettings):
        if declared.name in names:
            _add_setting(parser, declared)


def add_all_settings(parser: Parser) -> None:
    """Add the flags of all settings of :class:`~sb3_tdc.runs.settings.RunSettings`, in groups."""
    groups = {group: parser.add_argument_group(group.value) for group in Group}
    for declared in fields(RunSettings):
        _add_setting(groups[declared.metadata["group"]], declared)


def _add_setting(parser: _Container, declared: Field) -> None:
    flags, options = flags_of(declared), dict(declared.metadata["parsing"])
    kind, default = declared.type, default_of(declared)
    options |= {"dest": declared.name, "default": default, "help": declared.metadata["help"]}
    container: Any = parser
    if negation := options.pop("negation", None):
        container = parser.add_mutually_exclusive_group()
        container.add_argument(negation[0], dest=declared.name, action="store_false", default=default, help=negation[1])
    if known := options.pop("known", None):
        options["type"] = one_of(*known)
    elif kind in (bool, bool | None):
        options["action"] = "store_true"
    elif isinstance(default, (dict, list)):
        options |= {"nargs": "+", "action": KeyValues if isinstance(default, dict) else Names}
    else:
        options["type"] = next(each for each in (int, Path, str) if kind in (each, each | None))
    container.add_argument(*flags, **options)
