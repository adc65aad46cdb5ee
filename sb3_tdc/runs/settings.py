"""
The settings of a run other than its hyperparameters, each declared once.

:class:`RunSettings` defines the flags of ``sb3-tdc train``, the content of the run's ``args.yml``, the settings that
may change when a run is resumed, and those that the report compares.
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
from sb3_tdc.runs.algorithms import KNOWN_ALGORITHMS

# NumPy accepts only seeds below 2**32, and environments are seeded with this seed plus a number of a few thousand
MAX_SEED = 2**32 - 2**16
MAX_RANDOM_SEED = 2**31 - 1  # some simulators take no larger one


class Role(Enum):
    """The role of a setting: whether it may change when a run is resumed, and whether it defines the experiment."""

    EXPERIMENT = "another value makes another experiment, which is not averaged with this one"
    RUN = "fixed when the run begins"
    LENGTH = "may be another when the run is resumed, and stays so"
    PROCESS = "may differ each time the run is resumed"
    RESUMING = "said only when a run is resumed"


class Group(Enum):
    """The group of the help in which a setting's flag is shown."""

    RUN = "run"
    HYPERPARAMETERS = "hyperparameters"
    EVALUATION = "evaluation"
    SAVING = "saving and resuming"
    PROCESS = "process and log"


def setting(  # type: ignore[no-untyped-def]
    *flags: str,
    default: Any,
    help: str,
    group: Group,
    role: Role = Role.RUN,
    minimum: int | None = None,
    maximum: float = math.inf,
    minus_one: str | None = None,
    **parsing: Any,
):
    """
    Declare a setting.

    :param flags: names on the command line; by default ``--`` and the setting's name
    :param group: the group of flags in the help
    :param minimum: the smallest number allowed
    :param maximum: the largest number allowed
    :param minus_one: the meaning of -1; None if -1 is not allowed
    :param parsing: further keyword arguments of ``add_argument``
    :return: a field of a dataclass
    """
    limits = {"minimum": minimum, "maximum": maximum, "minus_one": minus_one}
    help += f" ({'default ' if default == -1 else ''}-1: {minus_one})" if minus_one else ""
    metadata = {"flags": flags, "help": help, "group": group, "role": role, **limits, "parsing": parsing}
    if isinstance(default, (dict, list)):
        return field(default_factory=default.copy, metadata=metadata)
    return field(default=default, metadata=metadata)


@dataclass
class RunSettings:
    """All settings of a run, each with its flag, its default and its role."""

    algo: str = setting(
        default="tdc",
        help="algorithm: " + ", ".join(ALGORITHMS),
        group=Group.RUN,
        known=("algorithm", KNOWN_ALGORITHMS),
    )
    env: str = setting(default="HalfCheetah-v4", group=Group.RUN, help="environment id")
    n_timesteps: int = setting(
        *("-n", "--n-timesteps"),
        default=-1,
        minimum=1,
        minus_one="as in the hyperparameters",
        role=Role.LENGTH,
        group=Group.RUN,
        metavar="STEPS",
        help="environment steps of the whole run; with --resume, a new total",
    )
    seed: int = setting(
        default=-1,
        minimum=0,
        maximum=MAX_SEED,
        minus_one="a random one",
        group=Group.RUN,
        help="seed of all random generators",
    )
    log_folder: str = setting(
        "-f", "--log-folder", "--folder", default="logs", group=Group.RUN, metavar="FOLDER", help="folder of all runs"
    )
    gym_packages: list[str] = setting(
        default=[],
        group=Group.RUN,
        metavar="PACKAGE",
        help="packages that register environments, imported first",
    )
    env_kwargs: dict[str, Any] = setting(
        default={},
        role=Role.EXPERIMENT,
        group=Group.RUN,
        metavar="KEY:VALUE",
        help="keyword arguments of the environment, e.g. max_episode_steps:500",
    )
    eval_env_kwargs: dict[str, Any] = setting(
        default={},
        role=Role.EXPERIMENT,
        group=Group.EVALUATION,
        metavar="KEY:VALUE",
        help="keyword arguments of the evaluation environment, if they differ from --env-kwargs",
    )
    vec_env: str = setting(
        default="dummy",
        group=Group.RUN,
        choices=["dummy", "subproc", "gymnasium"],
        help="dummy: in this process; subproc: one process each; gymnasium: gymnasium.make_vec",
    )
    hyperparams: dict[str, Any] = setting(
        *("-params", "--hyperparams"),
        default={},
        role=Role.RESUMING,
        group=Group.HYPERPARAMETERS,
        metavar="KEY:VALUE",
        help="override hyperparameters, e.g. lam:0.5 learning_rate:3.0e-4",
    )
    conf_file: Path | None = setting(
        *("-conf", "--conf-file"),
        default=None,
        group=Group.HYPERPARAMETERS,
        metavar="FILE.yml",
        help="file of hyperparameters (default: hyperparams/<algo>.yml)",
    )
    preset: str | None = setting(
        default=None,
        group=Group.HYPERPARAMETERS,
        metavar="NAME",
        help="entry of that file to take instead of the environment's (parallel: for thousands of environments)",
    )
    trained_agent: Path | None = setting(
        *("-i", "--trained-agent"),
        default=None,
        role=Role.EXPERIMENT,
        group=Group.SAVING,
        metavar="MODEL.zip",
        help="train a saved model further, in a new run",
    )
    trust: bool = setting(
        default=False,
        group=Group.SAVING,
        help="let the files of -i run code, as SB3 does: only if you know their origin",
    )
    eval_freq: int = setting(
        default=20_000,
        minimum=0,
        minus_one="none, as 0",
        role=Role.EXPERIMENT,
        group=Group.EVALUATION,
        metavar="STEPS",
        help="environment steps between evaluations",
    )
    eval_episodes: int = setting(
        default=5, minimum=1, role=Role.EXPERIMENT, group=Group.EVALUATION, metavar="N", help="episodes per evaluation"
    )
    n_eval_envs: int = setting(
        default=1, minimum=1, group=Group.EVALUATION, metavar="N", help="environments that an evaluation plays at once"
    )
    save_freq: int = setting(
        default=-1,
        minimum=0,
        minus_one="only at the end, as 0",
        group=Group.SAVING,
        metavar="STEPS",
        help="environment steps between saved models",
    )
    save_replay_buffer: bool = setting(
        default=False, group=Group.SAVING, help="save the replay buffer with every saved model"
    )
    resume_freq: int | None = setting(
        default=None,
        minimum=1,
        minus_one="none",
        group=Group.SAVING,
        metavar="STEPS",
        help=f"environment steps between resume states (default: {DEFAULT_FREQ:,}, or 100 for each environment "
        "if that is more)",
    )
    resume: Path | None = setting(
        default=None,
        role=Role.RESUMING,
        group=Group.SAVING,
        metavar="RUN_FOLDER",
        help="continue an interrupted run; its folder holds the other arguments",
    )
    from_step: int | None = setting(
        "--from",
        default=None,
        minimum=0,
        role=Role.RESUMING,
        group=Group.SAVING,
        metavar="STEP",
        help="with --resume: continue from the resume state of this step",
    )
    start_over: bool = setting(
        default=False,
        role=Role.RESUMING,
        group=Group.SAVING,
        help="with --resume: start again at step 0, and remove the results",
    )
    tensorboard_log: str | None = setting(
        *("-tb", "--tensorboard-log"),
        default=None,
        group=Group.PROCESS,
        metavar="FOLDER",
        help='folder of TensorBoard files (default: the run\'s folder; "": none)',
    )
    log_interval: int = setting(
        default=-1,
        minimum=0,
        minus_one="4, or the number of environments if that is larger",
        group=Group.PROCESS,
        metavar="EPISODES",
        help="episodes between log entries, 0 for no log",
    )
    uuid: bool = setting("-uuid", "--uuid", default=False, group=Group.RUN, help="add a UUID to the run folder's name")
    num_threads: int = setting(
        default=-1,
        minimum=1,
        minus_one="at most two",
        role=Role.PROCESS,
        group=Group.PROCESS,
        metavar="N",
        help="threads of PyTorch",
    )
    device: str = setting(
        default="auto", role=Role.PROCESS, group=Group.PROCESS, help="PyTorch device: auto, cpu, cuda, cuda:1, ..."
    )
    progress: bool | None = setting(
        *("-P", "--progress"),
        default=None,
        role=Role.PROCESS,
        group=Group.PROCESS,
        help="show a progress bar (default on a terminal)",
        negation=("--no-progress", "print plain lines, also on a terminal"),
    )
    verbose: int = setting(
        default=1,
        minimum=0,
        role=Role.PROCESS,
        group=Group.PROCESS,
        metavar="LEVEL",
        help="0: silent, 1: progress, 2: also SB3's tables and messages",
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
    """Return the default value of a setting."""
    return declared.default if declared.default_factory is MISSING else declared.default_factory()


def defaults(*roles: Role) -> dict[str, Any]:
    """Return the default of every setting with one of these roles."""
    return {each.name: default_of(each) for each in fields(RunSettings) if each.metadata["role"] in roles}


def check_settings(settings: RunSettings, stored_in: str = "", given: Collection[str] = ()) -> None:
    """
    Check the numbers, the names and the device among the settings.

    :param stored_in: the file that the settings were read from, for the error
    :param given: names of the settings that come from the command line instead
    :raises ValueError: naming the first setting that is not allowed, its value and the allowed values
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
    """Return arguments by name, with paths converted to strings."""
    return {name: str(value) if isinstance(value, Path) else value for name, value in arguments.items()}
