"""The setup of a run from its settings: everything is checked before any file is written."""

import json
import shlex
import textwrap
from dataclasses import fields
from os.path import abspath
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.utils import set_random_seed

from sb3_tdc.common import plain_yaml
from sb3_tdc.common.threads import set_threads
from sb3_tdc.envs.registry import require_env, split_env_id
from sb3_tdc.hyperparams import OF_THE_NETWORK, Hyperparams, convert_mapping, hyperparams_file, parse, read_entry
from sb3_tdc.resume import stored_steps
from sb3_tdc.runs.algorithms import KNOWN_ALGORITHMS
from sb3_tdc.runs.folder import RunFolder
from sb3_tdc.runs.models import check_saved_by
from sb3_tdc.runs.settings import (
    MAX_RANDOM_SEED,
    Role,
    RunSettings,
    check_settings,
    default_of,
    flags_of,
    plain_arguments,
)
from sb3_tdc.runs.training import TrainingRun
from sb3_tdc.safe_load.run_files import check_arguments

_COMMAND_LINE = "command line (-params)"


def make_run(settings: RunSettings) -> TrainingRun:
    """
    Check the settings and hyperparameters, then make the run folder.

    :raises ValueError: if a setting or hyperparameter is not allowed
    """
    if settings.from_step is not None or settings.start_over:
        raise ValueError(f"{'--start-over' if settings.start_over else '--from'} goes with --resume RUN_FOLDER")
    check_settings(settings)
    if settings.trained_agent is not None:
        path = Path(settings.trained_agent)
        if not (path.suffix == ".zip" and path.is_file()):
            raise ValueError(f"-i must be the zip of a model, got {path}")
    settings.env, settings.gym_packages = split_env_id(settings.env, settings.gym_packages)
    _prepare(settings)
    if settings.seed < 0:
        settings.seed = int(np.random.randint(MAX_RANDOM_SEED))
    hyperparams = read_hyperparams(settings)
    vars(settings).update(_absolute(vars(settings)))
    set_random_seed(settings.seed)
    return TrainingRun(settings, hyperparams, _make_folder(settings, hyperparams))


def read_hyperparams(settings: RunSettings) -> Hyperparams:
    """
    Read, validate and print the hyperparameters of the environment, with the overrides of ``-params`` and ``-n``.

    :raises ValueError: if a hyperparameter is not allowed, naming the file or flag that it comes from
    """
    path = settings.conf_file or hyperparams_file(settings.algo)
    entry, name = read_entry(path, settings.env, settings.preset)
    if settings.trained_agent is not None:
        entry = {key: value for key, value in entry.items() if key not in OF_THE_NETWORK}
    n_timesteps = {"n_timesteps": settings.n_timesteps} if settings.n_timesteps > 0 else {}
    overrides = {**settings.hyperparams, **n_timesteps}
    where = f"{path}, {name}"
    hyperparams = parse(entry, KNOWN_ALGORITHMS[settings.algo], where, overrides, _COMMAND_LINE)
    if settings.verbose > 0:
        nearest = "" if name == "default" else "; this is the nearest version"
        other = "" if name in (settings.preset, settings.env) else f" (it has no entry for {settings.env}{nearest})"
        print(f"Hyperparameters: {where}{other}")
        print(textwrap.indent(plain_yaml.dump(hyperparams.raw, sort_keys=False), "  "), end="")
    return hyperparams


def _prepare(settings: RunSettings) -> None:
    """Set up this process: import the packages that register environments, and set the number of threads."""
    require_env(settings.env, settings.gym_packages)
    set_threads(settings.num_threads)


def _make_folder(settings: RunSettings, hyperparams: Hyperparams) -> RunFolder:
    """
    Make the run folder, with the settings, the hyperparameters and the model that the run starts from.

    :raises ValueError: if a file of the model is missing, or the folder cannot be written; it is then removed
    """
    folder, origin = None, _find_origin(settings, hyperparams)
    try:
        folder = RunFolder.create(settings.log_folder, settings.algo, settings.env, settings.uuid)
        folder.write_config(hyperparams.raw, settings.as_plain())
        if origin is not None:
            folder.copy_trained_agent(*origin)
    except OSError as error:
        if folder is not None:
            folder.remove()
        raise ValueError(f"No run folder can be made in {settings.log_folder}: {error}") from error
    return folder


def _find_origin(settings: RunSettings, hyperparams: Hyperparams) -> tuple[Path, Path | None, Path] | None:
    """
    Return the model of ``-i``, its normalisation statistics, and the path of its replay buffer, which may not exist.

    :raises ValueError: if another algorithm saved the model, if its statistics are missing, or if only the model or
        only the run has normalisation
    """
    if settings.trained_agent is None:
        return None
    model = Path(settings.trained_agent)
    check_saved_by(model, settings.algo)
    source = RunFolder.around(model, settings.env)
    statistics, wanted = source.find_normalization(model), hyperparams.normalize
    if statistics is not None and wanted is None:
        flag = shlex.quote(f"normalize:{json.dumps(source.normalize or True)}")
        raise ValueError(f"{model} was trained with normalize: add -params {flag}")
    if statistics is None and source.normalize is not None and wanted is not None and wanted.get("norm_obs", True):
        raise ValueError(f"{model} was trained without normalize: add -params normalize:false")
    return model, statistics, source.replay_buffer(model)


def _absolute(arguments: dict[str, Any]) -> dict[str, Any]:
    """Return the paths among the arguments, made absolute: a run may be resumed from another working directory."""
    locations = {name: arguments[name] for name in ("trained_agent", "tensorboard_log") if arguments.get(name)}
    return {name: type(location)(abspath(location)) for name, location in locations.items()}


def _as_stored(given: dict[str, Any]) -> dict[str, Any]:
    """Return the settings on a command line as the run that it began has stored them."""
    stored = {**given, **_absolute(given)}
    if ":" in stored.get("env", ""):
        stored["env"], stored["gym_packages"] = split_env_id(stored["env"], stored.get("gym_packages", []))
    if stored.get("seed") == -1:  # any seed
        del stored["seed"]
    return stored


def resume_run(given: dict[str, Any]) -> TrainingRun | None:
    """
    Open a run to resume it.

    :param given: the settings on the command line
    :return: the run; None if it is finished and ``--start-over`` is not given
    :raises ValueError: if there is nothing to resume, or a setting contradicts the run's
    """
    folder = RunFolder.open(given["resume"])
    if not (folder.path / folder.env_name / "args.yml").is_file():
        raise ValueError(f"{folder.path} was stopped before its run began: start a new one")
    settings = _resumed_settings(folder, _as_stored(given))
    where, config = str(folder.path / folder.env_name / "config.yml"), folder.config
    before = _stored_length(folder, where)
    length = before if (new := _new_length(given)) is None else new
    if folder.is_finished and not settings.start_over:
        if length != before:
            _refuse_to_prolong(folder, length)
        return None
    wanted = {**given.get("hyperparams", {}), "n_timesteps": length}
    differing = {name: value for name, value in wanted.items() if name not in config or config[name] != value}
    if settings.trained_agent is not None and "normalize" in differing:
        raise ValueError(f"normalize cannot be changed: {folder.path} started from a model that it was chosen for (-i)")
    if not settings.writes_states:
        raise ValueError(f"{folder.path} has no resume states: it was trained with --resume-freq -1")
    if settings.start_over and settings.from_step is not None:
        raise ValueError(f"--start-over begins at step 0, not at the state of --from {settings.from_step}: use one")
    has_state = bool(stored_steps(folder.resume_folder)) and not settings.start_over
    if folder.has_results and not has_state and not settings.start_over:
        raise ValueError(
            f"{folder.path} has results, but {folder.resume_folder} has no resume states: "
            "--start-over begins at step 0 again, and removes the results"
        )
    if settings.from_step is not None and not has_state:
        raise ValueError(f"{folder.resume_folder} has no state of step {settings.from_step:,}: leave out --from")
    _prepare(settings)
    hyperparams = parse(config, KNOWN_ALGORITHMS[settings.algo], where, differing, _COMMAND_LINE)
    set_random_seed(settings.seed)
    others = tuple(name for name in differing if name != "n_timesteps")
    return TrainingRun(settings, hyperparams, folder, others, former_length=before if length != before else None)


def _stored_length(folder: RunFolder, where: str) -> int:
    """
    Return the planned number of timesteps of an existing run.

    :raises ValueError: if ``config.yml``, which may have been edited, has no such number
    """
    convert_mapping({"n_timesteps": folder.config.get("n_timesteps")}, {"n_timesteps": int}, where)
    return folder.n_timesteps


def _new_length(given: dict[str, Any]) -> int | None:
    """
    Return the new total number of timesteps given by ``-n`` or in ``-params``; None if neither is given.

    :raises ValueError: if it is not an integer
    """
    if given.get("n_timesteps", -1) != -1:
        return given["n_timesteps"]
    named = {name: value for name, value in given.get("hyperparams", {}).items() if name == "n_timesteps"}
    return convert_mapping(named, {"n_timesteps": int}, _COMMAND_LINE).get("n_timesteps")


def _refuse_to_prolong(folder: RunFolder, length: int) -> None:
    """
    Refuse a new length for a finished run, which has no resume states.

    :raises ValueError: always; if the new length is longer, with the flags that train the model further in a new run
    """
    steps = folder.steps_at_end if folder.steps_at_end is not None else folder.steps_of_model()
    if length <= steps:
        raise ValueError(f"{folder.path} is finished, at step {steps:,}: n_timesteps {length} adds none")
    further = shlex.join(["-i", str(folder.model), "-n", str(length - steps)])
    raise ValueError(
        f"{folder.path} is finished, at step {steps:,}, and a finished run has no resume states: train its model "
        f"further in a new run, by its command ({folder.path / folder.env_name / 'command.txt'}) with {further}"
    )


def _resumed_settings(folder: RunFolder, given: dict[str, Any]) -> RunSettings:
    """
    Return the stored settings of a run, updated with those on the command line that may change.

    :raises ValueError: if the command line contradicts them, or if they have been edited and are not allowed
    """
    where = str(folder.path / folder.env_name / "args.yml")
    stored, now = _stored_settings(folder, where), {}
    for declared in fields(RunSettings):
        name, flag = declared.name, flags_of(declared)[-1]
        if name in given and declared.metadata["role"] in (Role.LENGTH, Role.PROCESS, Role.RESUMING):
            now[name] = given[name]
        elif name in given and given[name] != (before := stored.get(name, default_of(declared))):
            said = plain_arguments({"given": given[name], "before": before})
            raise ValueError(f"{flag} {said['given']} contradicts the run in {folder.path}: {flag} {said['before']}")
    fresh = {"resume": None, "from_step": None, "start_over": False}
    settings = RunSettings(**{**stored, **fresh, **now})
    check_settings(settings, where, now)
    if settings.seed < 0:
        raise ValueError(f"{where}: seed must be that of the run, got {settings.seed}")
    return settings


def _stored_settings(folder: RunFolder, where: str) -> dict[str, Any]:
    """
    Return the settings in a run's ``args.yml``, which may have been edited.

    :raises ValueError: if a setting has the wrong type
    """
    stored = folder.args
    check_arguments(stored, KNOWN_ALGORITHMS, where)
    types = {declared.name: declared.type for declared in fields(RunSettings)}
    # RL Zoo's file has further arguments, and null or an empty path for those that were not given
    known = {
        name: value
        for name, value in stored.items()
        if name in types and value is not None and (value, types[name]) != ("", Path | None)
    }
    return convert_mapping(known, types, where)
