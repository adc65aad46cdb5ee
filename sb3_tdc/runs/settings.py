"""
What a run is told besides its hyperparameters, declared once.

The flags of ``sb3-tdc train``, the run's ``args.yml``, what may change when a run is resumed, and what the report
compares all come from :class:`RunSettings`.
"""

import math
from collections.abc import Collection
from dataclasses import MISSING, Field, asdict, dataclass, field, fields
from enum import Enum
from pathlib import Path
from typing import Any

from sb3_tdc.algorithms import ALGORITHMS
from sb3_tdc.common.checks import check_device
from sb3_tdc.resume import DEFAULT_FREQ

# NumPy takes no seed above 2**32, and environments are seeded with this one and a little more
MAX_SEED = 2**31 - 1


class Role(Enum):
    """What depends on a setting."""

    EXPERIMENT = "another value makes another experiment, which is not averaged with this one"
    RUN = "fixed when the run begins"
    LENGTH = "may be another when the run is resumed, and stays so"
    PROCESS = "may differ each time the run is resumed"
    RESUMING = "said only when a run is resumed"


def setting(  # type: ignore[no-untyped-def]
    *flags: str,
    default: Any,
    help: str,
    role: Role = Role.RUN,
    minimum: int | None = None,
    maximum: float = math.inf,
    minus_one: str | None = None,
    **parsing: Any,
):
    """
    Declare a setting.

    :param flags: on the command line; the name of the setting is the first by default
    :param minimum: the smallest number allowed
    :param maximum: the largest
    :param minus_one: what -1 means; None if it is not allowed
    :param parsing: further keyword arguments of ``add_argument``
    :return: a field of a dataclass
    """
    limits = {"minimum": minimum, "maximum": maximum, "minus_one": minus_one}
    help += f" (-1: {minus_one})" if minus_one else ""
    metadata = {"flags": flags, "help": help, "role": role, **limits, "parsing": parsing}
    if isinstance(default, (dict, list)):
        return field(default_factory=default.copy, metadata=metadata)
    return field(default=default, metadata=metadata)


@dataclass
class RunSettings:
    """Every setting with its flag, its default and what depends on it."""

    algo: str = setting(default="tdc", help="algorithm: " + ", ".join(ALGORITHMS), known=("algorithm", ALGORITHMS))
    env: str = setting(default="HalfCheetah-v4", help="environment id")
    n_timesteps: int = setting(
        *("-n", "--n-timesteps"),
        default=-1,
        minimum=1,
        minus_one="as in the hyperparameters",
        role=Role.LENGTH,
        help="environment steps of the whole run; with --resume, another number makes the run longer or shorter",
    )
    seed: int = setting(
        default=-1, minimum=0, maximum=MAX_SEED, minus_one="a random one", help="seed of all generators"
    )
    log_folder: str = setting("-f", "--log-folder", "--folder", default="logs", help="folder of all runs")
    gym_packages: list[str] = setting(default=[], help="packages to import, which register environments")
    env_kwargs: dict[str, Any] = setting(default={}, role=Role.EXPERIMENT, help="key:value of the environment")
    eval_env_kwargs: dict[str, Any] = setting(
        default={}, role=Role.EXPERIMENT, help="key:value of the evaluation environment"
    )
    vec_env: str = setting(
        default="dummy",
        choices=["dummy", "subproc", "gymnasium"],
        help="environments in this process, in their own, or of gymnasium.make_vec",
    )
    hyperparams: dict[str, Any] = setting(
        "-params", "--hyperparams", default={}, role=Role.RESUMING, help="key:value over the hyperparameters"
    )
    conf_file: Path | None = setting(
        "-conf", "--conf-file", default=None, help="YAML file of hyperparameters (default: hyperparams/<algo>.yml)"
    )
    preset: str | None = setting(
        default=None, help="entry of that file instead of the environment's (parallel: for thousands of environments)"
    )
    trained_agent: Path | None = setting(
        "-i",
        "--trained-agent",
        default=None,
        role=Role.EXPERIMENT,
        help="zip of a model to train further in a new run",
    )
    trust: bool = setting(default=False, help="let the files of -i run code, as SB3 does")
    eval_freq: int = setting(
        default=20_000,
        minimum=0,
        minus_one="none, as 0",
        role=Role.EXPERIMENT,
        help="environment steps between evaluations",
    )
    eval_episodes: int = setting(default=5, minimum=1, role=Role.EXPERIMENT, help="episodes per evaluation")
    n_eval_envs: int = setting(default=1, minimum=1, help="environments for evaluation")
    save_freq: int = setting(
        default=-1, minimum=0, minus_one="only at the end, as 0", help="environment steps between saved models"
    )
    save_replay_buffer: bool = setting(default=False, help="save the replay buffer with the model")
    resume_freq: int | None = setting(
        default=None,
        minimum=1,
        minus_one="none",
        help=f"environment steps between resume states, by default {DEFAULT_FREQ:,} or, if more, 100 an environment",
    )
    resume: Path | None = setting(
        default=None,
        role=Role.RESUMING,
        metavar="RUN_FOLDER",
        help="continue a stopped run; its folder holds the other arguments",
    )
    from_step: int | None = setting(
        "--from",
        default=None,
        minimum=0,
        role=Role.RESUMING,
        metavar="STEP",
        help="with --resume: continue from the state of a step",
    )
    start_over: bool = setting(
        default=False, role=Role.RESUMING, help="with --resume: begin at step 0 again, and overwrite the results"
    )
    tensorboard_log: str | None = setting(
        "-tb", "--tensorboard-log", default=None, help='TensorBoard folder (none given: the run\'s own; "": off)'
    )
    log_interval: int = setting(
        default=-1,
        minimum=0,
        minus_one="4, or the number of environments if that is larger",
        help="episodes between log entries, 0 for no log",
    )
    uuid: bool = setting("-uuid", "--uuid", default=False, help="a unique name for the run folder")
    num_threads: int = setting(
        default=-1, minimum=1, minus_one="at most two", role=Role.PROCESS, help="threads for PyTorch"
    )
    device: str = setting(default="auto", role=Role.PROCESS, help="PyTorch device (cpu, cuda, ...)")
    progress: bool | None = setting(
        *("-P", "--progress"),
        default=None,
        role=Role.PROCESS,
        help="a progress bar (on a terminal: default)",
        negation=("--no-progress", "plain lines, also on a terminal"),
    )
    verbose: int = setting(
        default=1, minimum=0, role=Role.PROCESS, help="0: silent, 1: progress, 2: also SB3's tables and messages"
    )

    @property
    def writes_states(self) -> bool:
        """Whether the run can be resumed."""
        return self.resume_freq is None or self.resume_freq > 0

    def as_plain(self) -> dict[str, Any]:
        """Return the settings as they are written to ``args.yml``."""
        return plain_arguments(asdict(self))


def flags_of(declared: Field) -> tuple[str, ...]:
    """Return the flags of a setting."""
    return declared.metadata["flags"] or (f"--{declared.name.replace('_', '-')}",)


def default_of(declared: Field) -> Any:
    """Return the value of a setting that is not given."""
    return declared.default if declared.default_factory is MISSING else declared.default_factory()


def defaults(*roles: Role) -> dict[str, Any]:
    """Return the default of every setting with one of these roles."""
    return {each.name: default_of(each) for each in fields(RunSettings) if each.metadata["role"] in roles}


def check_settings(settings: RunSettings, stored_in: str = "", given: Collection[str] = ()) -> None:
    """
    Check the numbers, the names and the device among the settings.

    :param stored_in: the file that settings were read from, for the error
    :param given: names of those that were not, but are on the command line
    :raises ValueError: naming the first setting that is not allowed, what it was and what is allowed
    """
    for each in fields(settings):
        shown_as = flags_of(each)[0] if not stored_in or each.name in given else f"{stored_in}: {each.name}"
        value = getattr(settings, each.name)
        parsing = each.metadata["parsing"]
        _, known = parsing.get("known", ("", parsing.get("choices", [value])))
        if value not in known:
            raise ValueError(f"{shown_as} must be one of {', '.join(known)}, got {value!r}")
        _check_number(each, value, shown_as)
        if each.name == "device":
            check_device(shown_as, value, "; --device takes another" if stored_in and each.name not in given else "")


def _check_number(declared: Field, value: Any, shown_as: str) -> None:
    minimum, maximum, minus_one = (declared.metadata[name] for name in ("minimum", "maximum", "minus_one"))
    if minimum is None or value is None or minimum <= value <= maximum or (minus_one and value == -1):
        return
    allowed = f"at least {minimum}" if maximum == math.inf else f"{minimum} to {maximum}"
    otherwise = f" (or -1: {minus_one})" if minus_one else ""
    raise ValueError(f"{shown_as} must be {allowed}{otherwise}, got {value}")


def plain_arguments(arguments: dict[str, Any]) -> dict[str, Any]:
    """Return arguments by name, with paths as texts."""
    return {name: str(value) if isinstance(value, Path) else value for name, value in arguments.items()}
