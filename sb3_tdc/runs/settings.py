"""
What a run is told besides its hyperparameters, declared once.

The flags of ``sb3-tdc train``, the run's ``args.yml``, what may change when a run is resumed, and what the report
compares all come from :class:`RunSettings`.
"""

from dataclasses import MISSING, Field, asdict, dataclass, field, fields
from enum import Enum
from pathlib import Path
from typing import Any

from sb3_tdc.algorithms import ALGORITHMS
from sb3_tdc.resume import DEFAULT_FREQ

# NumPy takes no seed above 2**32, and environments are seeded with this one and a little more
MAX_SEED = 2**31 - 1


class Role(Enum):
    """What depends on a setting."""

    EXPERIMENT = "another value makes another experiment, which is not averaged with this one"
    RUN = "fixed when the run begins"
    PROCESS = "may differ each time the run is resumed"
    RESUMING = "said only when a run is resumed"


def setting(*flags: str, default: Any, help: str, role: Role = Role.RUN, minimum: int | None = None, **parsing: Any):  # type: ignore[no-untyped-def]
    """
    Declare a setting.

    :param flags: on the command line; the name of the setting is the first by default
    :param minimum: the smallest number allowed; -1, where it is the default, is allowed too
    :param parsing: further keyword arguments of ``add_argument``
    :return: a field of a dataclass
    """
    metadata = {"flags": flags, "help": help, "role": role, "minimum": minimum, "parsing": parsing}
    if isinstance(default, (dict, list)):
        return field(default_factory=default.copy, metadata=metadata)
    return field(default=default, metadata=metadata)


@dataclass
class RunSettings:
    """Every setting with its flag, its default and what depends on it."""

    algo: str = setting(default="tdc", help="algorithm", known=("algorithm", ALGORITHMS))
    env: str = setting(default="HalfCheetah-v4", help="environment id")
    n_timesteps: int = setting(
        "-n", "--n-timesteps", default=-1, minimum=1, help="environment steps (-1: as in the hyperparameters)"
    )
    seed: int = setting(default=-1, help="seed of all generators (-1: a random one)")
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
        "-i", "--trained-agent", default=None, role=Role.EXPERIMENT, help="zip of a model to continue from"
    )
    trust: bool = setting(default=False, help="let the files of -i run code, as SB3 does")
    eval_freq: int = setting(
        default=20_000, role=Role.EXPERIMENT, help="environment steps between evaluations (-1: none)"
    )
    eval_episodes: int = setting(default=5, minimum=1, role=Role.EXPERIMENT, help="episodes per evaluation")
    n_eval_envs: int = setting(default=1, minimum=1, help="environments for evaluation")
    save_freq: int = setting(default=-1, help="environment steps between saved models (-1: only at the end)")
    save_replay_buffer: bool = setting(default=False, help="save the replay buffer with the model")
    resume_freq: int | None = setting(
        default=None,
        help=f"environment steps between resume states (-1: none; default: {DEFAULT_FREQ:,}, or 100 an environment)",
    )
    resume: Path | None = setting(
        default=None,
        role=Role.RESUMING,
        metavar="RUN_FOLDER",
        help="continue a stopped run; it has all other arguments",
    )
    from_step: int | None = setting(
        "--from",
        default=None,
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
    log_interval: int = setting(default=-1, help="episodes between log entries (-1: 4, 0: no log)")
    uuid: bool = setting("-uuid", "--uuid", default=False, help="a unique name for the run folder")
    num_threads: int = setting(default=-1, role=Role.PROCESS, help="threads for PyTorch (-1: at most two)")
    device: str = setting(default="auto", role=Role.PROCESS, help="PyTorch device (cpu, cuda, ...)")
    progress: bool | None = setting(
        *("-P", "--progress"),
        default=None,
        role=Role.PROCESS,
        help="a progress bar (on a terminal: default)",
        negation=("--no-progress", "plain lines, also on a terminal"),
    )
    verbose: int = setting(
        default=1, role=Role.PROCESS, help="0: silent, 1: progress, 2: also SB3's tables and messages"
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


def check_settings(settings: RunSettings) -> None:
    """
    Check the numbers and the model among the settings.

    :raises ValueError: naming the first flag with a number that is not allowed
    """
    for each in fields(settings):
        minimum, value = each.metadata["minimum"], getattr(settings, each.name)
        if minimum is not None and value < minimum and value != default_of(each):
            meaning = each.metadata["help"].rpartition(" (")[2].rstrip(")")
            otherwise = f" (or {meaning})" if meaning.startswith("-1:") else ""
            raise ValueError(f"{flags_of(each)[0]} must be at least {minimum}{otherwise}, got {value}")
    if not -1 <= settings.seed <= MAX_SEED:
        raise ValueError(f"--seed must be 0 to {MAX_SEED} (or -1: a random one), got {settings.seed}")
    if settings.trained_agent is not None:
        path = Path(settings.trained_agent)
        if not (path.suffix == ".zip" and path.is_file()):
            raise ValueError(f"-i must be the zip of a model, got {path}")


def plain_arguments(arguments: dict[str, Any]) -> dict[str, Any]:
    """Return arguments by name, with paths as texts."""
    return {name: str(value) if isinstance(value, Path) else value for name, value in arguments.items()}
