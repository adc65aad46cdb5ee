"""
SB3's and sb3-contrib's own tests, with TDC in the place of TD3, SAC and TQC.

    pip download --no-deps --no-binary :all: stable_baselines3 sb3_contrib
    tar xzf stable_baselines3-*.tar.gz && tar xzf sb3_contrib-*.tar.gz
    python -m tests.tools.peer_suites stable_baselines3-*/
    python -m tests.tools.peer_suites sb3_contrib-*/
"""

import argparse
import os
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest
import sb3_contrib
import stable_baselines3
import torch as th

from sb3_tdc import TDC

# Tests rely on the defaults of the algorithm whose place TDC takes
_DEFAULTS = {"learning_starts": 100, "action_noise": None}
_PEERS: dict[str, dict[str, Any]] = {
    "TD3": _DEFAULTS,
    "SAC": {**_DEFAULTS, "stochastic_actor": True, "policy_delay": 1},
    "TQC": {**_DEFAULTS, "stochastic_actor": True, "policy_delay": 1},
}

# Tests that are unfair to TDC: the reason, and a regular expression of file::test
_UNFAIR = {
    "requires gSDE (use_sde), which TDC does not have": (
        r"test_sde\.py::.*|test_run\.py::test_sde\[.*|test_spaces\.py::test_sde_multi_dim"
        r"|test_her\.py::test_save_load\[True-SAC\]|test_run\.py::test_offpolicy_multi_env\[SAC\]"
        r"|test_save_load\.py::test_save_load_policy\[True-.*-SAC\]"
    ),
    "reads one value per critic, where TDC's critics give quantiles": r"test_gae\.py::test_infinite_horizon\[.*",
    "expects an AssertionError for discrete actions, where TDC raises a ValueError": (
        r"test_spaces\.py::test_action_spaces\[CartPole-v1-.*"
    ),
}
_OPTIONS = ["-p", "no:cacheprovider", "-ra", "-q", "-m", "not expensive"]


def make_stand_in(name: str) -> type[TDC]:
    """Return TDC with a peer's defaults and under its name, which is in the ids of tests and the names of logs."""

    def construct(self: TDC, *args: Any, **kwargs: Any) -> None:
        TDC.__init__(self, *args, **{**_PEERS[name], **kwargs})

    def learn(self: TDC, *args: Any, **kwargs: Any) -> TDC:
        return TDC.learn(self, *args, **{"tb_log_name": name, **kwargs})

    return type(name, (TDC,), {"__module__": __name__, "__init__": construct, "learn": learn})


STAND_INS = {name: make_stand_in(name) for name in _PEERS}
TD3, SAC, TQC = STAND_INS.values()  # where a pickle looks for them


class Plugin:
    """A pytest plugin that runs only the tests with a stand-in; the unfair ones among them must fail."""

    def pytest_collection_modifyitems(self, config: pytest.Config, items: list[pytest.Item]) -> None:
        chosen = [item for item in items if takes_part(item)]
        config.hook.pytest_deselected(items=[item for item in items if item not in chosen])
        items[:] = chosen
        for item in items:
            for reason, pattern in _UNFAIR.items():
                if re.fullmatch(pattern, f"{item.path.name}::{item.name}"):
                    item.add_marker(pytest.mark.xfail(reason=reason, strict=True))


def takes_part(item: pytest.Item) -> bool:
    """Return whether a test is given a stand-in, or is given no algorithm and names one."""
    assert isinstance(item, pytest.Function)
    callspec = getattr(item, "callspec", None)
    for name, value in (callspec.params if callspec is not None else {}).items():
        if name in ("model_class", "algo", "model_name"):
            return value in STAND_INS.values() or str(value).upper() in STAND_INS
    return not STAND_INS.keys().isdisjoint(item.function.__code__.co_names)


def run_suite(source: Path, options: list[str]) -> int:
    """Run the tests of an unpacked source distribution, and return 0 if every fair one passes."""
    files = [str(file) for file in sorted(source.glob("tests/test_*.py")) if names_a_peer(file.read_text())]
    where = ["-c", str(source / "pyproject.toml"), "--rootdir", str(source)]
    return pytest.main([*_OPTIONS, *where, *files, *options], plugins=[Plugin()])


def names_a_peer(text: str) -> bool:
    """Return whether a file of tests names an algorithm that has a stand-in."""
    return re.search(rf"\b({'|'.join(_PEERS)})\b", text) is not None


def main(argv: list[str] | None = None) -> int:
    """Return 0 if every fair test passes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path, help="an unpacked source distribution; then options of pytest")
    arguments, options = parser.parse_known_args(argv)
    source = arguments.source.resolve()
    if not (source / "tests").is_dir():
        parser.error(f"{source} is not an unpacked source distribution: it has no folder tests")
    stable_baselines3.TD3, stable_baselines3.SAC, sb3_contrib.TQC = TD3, SAC, TQC  # type: ignore[misc,assignment]
    th.set_num_threads(1)
    with tempfile.TemporaryDirectory() as scratch:  # some tests write into the working directory
        os.chdir(scratch)
        outcome = run_suite(source, options)
        os.chdir(source)
    return outcome


if __name__ == "__main__":
    sys.exit(main())
