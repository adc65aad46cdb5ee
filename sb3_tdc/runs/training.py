"""
The training of one run, from its settings to its saved model.

``sb3-tdc train`` calls :func:`train`. ``sb3-tdc matrix`` starts one such process for each run; only its ``--dry-run``
calls :func:`train` in its own process, to measure the training speed.
"""

import sys
import traceback
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import (
    CSVOutputFormat,
    HumanOutputFormat,
    KVWriter,
    Logger,
    TensorBoardOutputFormat,
)
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.vec_env import VecEnv

from sb3_tdc.advb import BoardCallback
from sb3_tdc.advb.algorithms import Advised
from sb3_tdc.common.exceptions import describe_exception
from sb3_tdc.common.files import make_numbered, write_atomically
from sb3_tdc.common.finite import NonFiniteError
from sb3_tdc.common.off_policy import CheckedOffPolicyAlgorithm
from sb3_tdc.common.words import listed
from sb3_tdc.envs.checked import EnvironmentFaultError
from sb3_tdc.envs.make import SETUP_ERRORS, make_envs
from sb3_tdc.envs.processes import closing_envs, ended_processes
from sb3_tdc.envs.registry import simulator_of
from sb3_tdc.hyperparams import Hyperparams
from sb3_tdc.resume import DEFAULT_FREQ, LockedError, NotRestoredError, ResumeCallback, stored_steps
from sb3_tdc.runs.callbacks.busy_machine import BusyMachineCallback
from sb3_tdc.runs.callbacks.critic_evaluation import CriticEvaluationCallback
from sb3_tdc.runs.callbacks.finite_guard import FiniteGuardCallback, divergence_named
from sb3_tdc.runs.callbacks.hparams import RecordHyperparamsCallback
from sb3_tdc.runs.callbacks.progress import ProgressCallback
from sb3_tdc.runs.callbacks.saving import SaveBestCallback, SavePeriodicallyCallback
from sb3_tdc.runs.callbacks.stopping import StopOnSignalCallback
from sb3_tdc.runs.folder import RunFolder
from sb3_tdc.runs.models import DISK_ERRORS, continue_model, load_experience, make_model, save_model
from sb3_tdc.runs.settings import RunSettings

# Added to the run's seed for evaluations and for the board's test episodes: other initial states than in training
_EVALUATION_SEED, _BOARD_SEED = 1_000, 2_000


@dataclass
class TrainingRun:
    """
    The settings, the hyperparameters and the folder of one run.

    :param folder: the run folder, in which the settings and hyperparameters are already stored
    :param changed: names of the hyperparameters that have a new value when the run is resumed
    :param former_length: the planned number of steps before ``n_timesteps`` was changed; None if it was not
    """

    settings: RunSettings
    hyperparams: Hyperparams
    folder: RunFolder
    changed: tuple[str, ...] = ()
    former_length: int | None = None

    @property
    def is_resumed(self) -> bool:
        return self.settings.resume is not None

    @cached_property
    def has_state(self) -> bool:
        """Return whether the run continues from a resume state, which holds more than a saved model does."""
        return self.is_resumed and not self.settings.start_over and bool(stored_steps(self.folder.resume_folder))

    @property
    def origin(self) -> Path | None:
        """The zip whose model is trained further; that of a resumed run is a copy, since the original may be gone."""
        given = self.settings.trained_agent
        return None if given is None else self.folder.trained_agent if self.is_resumed else Path(given)

    @property
    def log_interval(self) -> int | None:
        """Episodes between log entries; None: no log. The default: at most one entry per step of all environments."""
        given = self.settings.log_interval
        return max(4, self.hyperparams.n_envs) if given == -1 else max(given, 0) or None

    @property
    def resume_freq(self) -> int:
        """Environment steps between resume states. The default: at most one state per 100 steps of all environments."""
        return self.settings.resume_freq or max(DEFAULT_FREQ, 100 * self.hyperparams.n_envs)


class NotSavedError(Exception):
    """The trained model could not be written; the message gives the reason in one sentence."""


class TrainingError(Exception):
    """An environment, a wrapper or a callback ended training; the message gives the step and the reason."""


class SetupError(ValueError):
    """A run could not begin; the message gives the reason in one sentence."""


@dataclass(frozen=True)
class TrainingOutcome:
    """
    How a run ended.

    :param interrupted: whether the user stopped the run before its last step
    :param resume_step: the timestep from which the run can be resumed; None if it cannot
    """

    model: OffPolicyAlgorithm
    interrupted: bool
    resume_step: int | None


def train(run: TrainingRun) -> TrainingOutcome:
    """
    Train until the last step or until Ctrl-C, then save the model. A second Ctrl-C stops without saving.

    :raises SetupError: if the run cannot begin; the folder of a new run is removed
    :raises NonFiniteError: if training diverged; models saved before stay as they are
    :raises TrainingError: if an environment or a callback raised an exception; the traceback is in the run folder
    :raises NotSavedError: if the trained model cannot be written
    :raises LockedError: if another process has begun to write to the run folder
    """
    with _removed_if_refused(run), ended_processes(), ExitStack() as stack:
        with _setting_up(run.settings.verbose):
            states = _open_states(run)
            if states is not None:
                stack.callback(states.store.close)
            stack.enter_context(_logs_put_back_if_refused(run.folder))  # now that no other process writes to them
            model = _make_model(run, stack.enter_context(closing_envs(_make_training_envs(run))))
            stop = StopOnSignalCallback(states)
            callbacks = _make_callbacks(run, model, stop, states, stack)
            step = _select_state(run, states, model)
            former = _former_results(run, step)
            model.set_logger(_make_logger(run))
            stack.callback(model.logger.close)
            if run.is_resumed:  # last, since a refusal changes nothing
                if states is not None and step is None:
                    states.store.clear()
                for path in former:
                    path.unlink(missing_ok=True)
                _record_changes(run, step)
        if run.settings.verbose > 0:
            _announce(run)
        if not run.has_state:
            _warn_of_no_update(model, run.hyperparams.n_timesteps)
        with stop, divergence_named(model):
            _learn(run, model, callbacks)
            _save(run, model)
        if not stop.requested:
            run.folder.mark_finished(model.num_timesteps)
            if states is not None:
                states.store.remove_all()
        return TrainingOutcome(model, stop.requested, states.last_step if states is not None else None)


@contextmanager
def _removed_if_refused(run: TrainingRun) -> Iterator[None]:
    """Remove the folder of a new run that could not begin."""
    try:
        yield
    except SetupError:
        if not run.is_resumed:
            run.folder.remove()
        raise


@contextmanager
def _logs_put_back_if_refused(folder: RunFolder) -> Iterator[None]:
    """Remove the logs, which environments and the logger open anew, and put them back if the run is not resumed."""
    logs = folder.take_logs()
    try:
        yield
    except (SetupError, NotRestoredError):
        folder.put_back(logs)
        raise


@contextmanager
def _setting_up(verbose: int) -> Iterator[None]:
    """Raise ``SetupError`` if this block fails."""
    try:
        yield
    except BaseException as error:
        if verbose > 1:
            traceback.print_exc()
        # Other errors come from the user's own wrappers, policies and callbacks: say where in the code
        is_a_sentence = isinstance(error, (*SETUP_ERRORS, KeyboardInterrupt))
        reason = " ".join(str(error).split()) if is_a_sentence else describe_exception(error)
        raise SetupError(reason or "Interrupted before training began") from error


def _announce(run: TrainingRun) -> None:
    verb, settings = "Resuming" if run.is_resumed else "Training", run.settings
    print(f"{verb} {settings.algo} on {settings.env}, seed {settings.seed}, in {run.folder.path}", flush=True)
    if run.former_length is not None:
        schedules = run.hyperparams.schedules
        follow = f"; schedules ({listed(schedules)}) follow the new total" if schedules else ""
        print(
            f"The run ends at step {run.hyperparams.n_timesteps:,} now, not {run.former_length:,}{follow}", flush=True
        )


def _warn_of_no_update(model: OffPolicyAlgorithm, n_timesteps: int) -> None:
    """Warn if a run ends before its first update; with a ``train_freq`` in episodes, that is not known beforehand."""
    assert isinstance(model.train_freq, TrainFreq)
    if model.train_freq.unit is TrainFrequencyUnit.EPISODE:
        return
    of_rollout = model.train_freq.frequency * model.n_envs
    last_step = -(-n_timesteps // of_rollout) * of_rollout
    if last_step <= model.learning_starts:
        print(
            f"Warning: nothing will be learned: learning_starts ({model.learning_starts:,}) is not below the run's "
            f"{last_step:,} steps. Lower it by -params learning_starts:…, or take more steps by -n",
            file=sys.stderr,
        )


def _learn(run: TrainingRun, model: OffPolicyAlgorithm, callbacks: list[BaseCallback]) -> None:
    try:
        model.learn(
            run.hyperparams.n_timesteps,
            callback=callbacks,
            log_interval=run.log_interval,  # type: ignore[arg-type]  # None: no log
        )
    except (NonFiniteError, NotRestoredError, LockedError):
        raise
    except Exception as error:
        if isinstance(error, EnvironmentFaultError):
            reason, details = str(error), error.details
        else:
            reason, details = describe_exception(error), ""
        if model.num_timesteps == 0 and not run.is_resumed:
            raise SetupError(f"{run.settings.env} failed before the first step: {reason}") from error
        run.folder.write_error(details or traceback.format_exc())
        raise TrainingError(f"Training failed at step {model.num_timesteps:,}: {reason}") from error


def _save(run: TrainingRun, model: OffPolicyAlgorithm) -> None:
    folder = run.folder
    try:
        save_model(model, folder, folder.model)
        if run.settings.save_replay_buffer:
            write_atomically(model.save_replay_buffer, folder.replay_buffer(folder.model))
    except DISK_ERRORS as error:
        reason = " ".join(str(error).split())
        raise NotSavedError(f"The model of step {model.num_timesteps:,} could not be saved: {reason}") from error


# ---------------------------------------------------------------- resume states


def _open_states(run: TrainingRun) -> ResumeCallback | None:
    folder, settings = run.folder, run.settings
    if not settings.writes_states:
        return None
    of_evaluations = [folder.best_model, folder.normalization(folder.best_model)]
    return ResumeCallback(
        folder.resume_folder,
        run.resume_freq,
        files=of_evaluations if settings.eval_freq > 0 else [],
        hyperparams=run.hyperparams.raw,
        verbose=settings.verbose,
    )


def _select_state(run: TrainingRun, states: ResumeCallback | None, model: OffPolicyAlgorithm) -> int | None:
    """
    Select the state to resume from.

    :return: its step; None if training begins at step 0
    :raises ValueError: if there is no such state, or the new number of timesteps is not above its step
    """
    if states is None or not run.has_state:
        return None
    # A hyperparameter that was ever changed takes its value from config.yml: the state may be older than the change
    earlier = [name for change in run.folder.changes for name in change["hyperparams"] if name != "n_timesteps"]
    step = states.select(model, run.settings.from_step, [*earlier, *run.changed])
    assert step is not None
    length = run.hyperparams.n_timesteps
    if run.former_length is not None and length <= step:
        raise ValueError(f"n_timesteps must be above {step:,}, the step of the resume state, got {length}")
    return step


def _former_results(run: TrainingRun, step: int | None) -> list[Path]:
    """
    Return the paths of the results that training is about to repeat.

    :param step: that of the resume state, which holds the evaluations and the best model; None if training begins at
        step 0
    """
    folder = run.folder
    if step is None:
        return folder.results()
    later = [model for steps, model in folder.checkpoints().items() if steps > step]
    final = [folder.model] if run.settings.from_step is not None else []
    return [path for model in (*later, *final) for path in folder.files_of(model)]


def _record_changes(run: TrainingRun, step: int | None) -> None:
    """
    Record the hyperparameters that change when a run is resumed.

    :param step: that of the resume state; None if training begins at step 0, and the new values hold for the whole run
    """
    names = run.changed
    if run.former_length is not None:
        # With a schedule, the steps so far differ from those of a run that had the new length from the start
        names += ("n_timesteps",) if run.hyperparams.schedules else ()
        run.folder.record_length(run.hyperparams.n_timesteps)
    if run.changed or run.former_length is not None:
        run.folder.record_change(step or 0, run.hyperparams.raw, names if step else ())


# ---------------------------------------------------------------- environments


def _make_training_envs(run: TrainingRun) -> VecEnv:
    normalization = None
    if run.origin is not None and not run.has_state:
        normalization = RunFolder.around(run.origin, run.settings.env).find_normalization(run.origin)
    settings = run.settings
    return make_envs(
        settings.env,
        run.hyperparams,
        settings.seed,
        run.hyperparams.n_envs,
        settings.env_kwargs,
        settings.vec_env,
        monitor_folder=run.folder.path,
        normalization=normalization,
        trust=settings.trust,
    )


def _make_other_envs(
    run: TrainingRun, model: OffPolicyAlgorithm, stack: ExitStack, seed: int, n_envs: int, env_kwargs: dict[str, Any]
) -> VecEnv:
    """Make environments for evaluation or test episodes, wrapped like the model's; ``seed`` is added to the run's."""
    settings = run.settings
    envs = make_envs(
        settings.env, run.hyperparams, settings.seed + seed, n_envs, env_kwargs, settings.vec_env, training=False
    )
    return model._wrap_env(stack.enter_context(closing_envs(envs)), verbose=0, monitor_wrapper=False)


# ---------------------------------------------------------------- model, logger, callbacks


def _make_model(run: TrainingRun, env: VecEnv) -> OffPolicyAlgorithm:
    settings = run.settings
    arguments = {"seed": settings.seed, "device": settings.device, "verbose": int(settings.verbose > 1)}
    if run.origin is None:
        return make_model(settings.algo, run.hyperparams, env, **arguments)
    model = continue_model(run.origin, settings.algo, run.hyperparams, env, settings.trust, **arguments)
    if not run.has_state and (experience := run.folder.experience) is not None:
        load_experience(model, experience, settings.trust)
    return model


def _make_logger(run: TrainingRun) -> Logger:
    folder, settings = run.folder.path, run.settings
    writers: list[KVWriter] = [CSVOutputFormat(str(folder / "progress.csv"))]
    if settings.tensorboard_log is None:
        writers.append(TensorBoardOutputFormat(str(folder)))
    elif settings.tensorboard_log:
        parent = Path(settings.tensorboard_log) / run.folder.env_name
        writers.append(TensorBoardOutputFormat(str(make_numbered(parent, settings.algo.upper()))))
    if settings.verbose > 1:
        writers.append(HumanOutputFormat(sys.stdout))
    return Logger(str(folder), writers)


def _make_callbacks(
    run: TrainingRun,
    model: OffPolicyAlgorithm,
    stop: StopOnSignalCallback,
    states: ResumeCallback | None,
    stack: ExitStack,
) -> list[BaseCallback]:
    """Make all callbacks, in the order of their calls: resume states are written before later callbacks do anything."""
    settings, hyperparams = run.settings, run.hyperparams
    progress = ProgressCallback(bool(settings.progress), settings.verbose)
    stack.callback(progress.close)
    callbacks: list[BaseCallback] = [BusyMachineCallback(progress.say, _remedy(run))]
    if not isinstance(model, CheckedOffPolicyAlgorithm):
        callbacks.append(FiniteGuardCallback())
    if states is not None:
        callbacks.append(states)
    can_evaluate = simulator_of(settings.env).make_vec is None
    if isinstance(model, Advised):
        if not can_evaluate:
            raise ValueError(f"{settings.env} allows one simulation a process: none for the board's test episodes")
        callbacks.append(BoardCallback(_make_other_envs(run, model, stack, _BOARD_SEED, 1, settings.env_kwargs)))
    callbacks += [make() for make in hyperparams.callbacks]
    identity = {"algo": settings.algo, "env": settings.env, "seed": settings.seed}
    callbacks.append(RecordHyperparamsCallback(identity | hyperparams.raw))
    callbacks += _make_saving(run)
    if can_evaluate:
        callbacks += _make_evaluation(run, model, progress, stop, stack)
    elif settings.eval_freq > 0:
        progress.say(
            f"{settings.env} allows one simulation a process: no evaluations, rollout/ep_rew_mean is the return"
        )
    return [*callbacks, progress, stop]


def _make_saving(run: TrainingRun) -> list[BaseCallback]:
    settings, folder = run.settings, run.folder.path
    if settings.save_freq <= 0:
        return []
    with_buffer = settings.save_replay_buffer
    freq = _calls(run, settings.save_freq)
    return [SavePeriodicallyCallback(freq, str(folder), save_replay_buffer=with_buffer, save_vecnormalize=True)]


def _make_evaluation(
    run: TrainingRun,
    model: OffPolicyAlgorithm,
    progress: ProgressCallback,
    stop: StopOnSignalCallback,
    stack: ExitStack,
) -> list[BaseCallback]:
    settings = run.settings
    if settings.eval_freq <= 0:
        return []
    env_kwargs = settings.eval_env_kwargs or settings.env_kwargs
    return [
        CriticEvaluationCallback(
            _make_other_envs(run, model, stack, _EVALUATION_SEED, settings.n_eval_envs, env_kwargs),
            stop,
            callback_on_new_best=SaveBestCallback(run.folder),
            callback_after_eval=progress.evaluation,
            n_eval_episodes=settings.eval_episodes,
            eval_freq=_calls(run, settings.eval_freq),
            log_path=str(run.folder.path),
            deterministic=True,
            verbose=0,
        )
    ]


def _calls(run: TrainingRun, freq: int) -> int:
    """Convert environment steps to calls of a callback, which is called once per step of all environments."""
    return max(freq // run.hyperparams.n_envs, 1)


def _remedy(run: TrainingRun) -> str:
    """Return the instructions for continuing the run on one thread."""
    if run.settings.writes_states:
        return f"press Ctrl-C, then\n  {run.folder.command_to_resume} --num-threads 1"
    return "press Ctrl-C, and add --num-threads 1 to the command that is printed then."
