"""One run: environments, model, callbacks, run folder. Called by the command line, by searches and by tests."""

import difflib
import shutil
import sys
import traceback
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import (
    CSVOutputFormat,
    HParam,
    HumanOutputFormat,
    KVWriter,
    Logger,
    TensorBoardOutputFormat,
)
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecEnv,
    VecFrameStack,
    VecNormalize,
)

from sb3_tdc.advb import AdvBSAC, AdvBTD3, AdvBTDC, BoardCallback
from sb3_tdc.advb.algorithms import Advised
from sb3_tdc.busy_machine import BusyMachine
from sb3_tdc.checked_envs import CheckedEnv, CheckedSubprocVecEnv, EnvironmentFaultError, describe_exception
from sb3_tdc.checkpoint import DEFAULT_FREQ, Checkpoints, LockedError, NotRestoredError, Restorable, stored_steps
from sb3_tdc.critic_evaluation import CriticEvaluation
from sb3_tdc.finite_guard import FiniteGuard, check_weights, divergence_named
from sb3_tdc.hyperparams import Hyperparams
from sb3_tdc.interruption import StopOnSignal, ended_processes, ignore_signals
from sb3_tdc.meow import MEOW
from sb3_tdc.mujoco_messages import say_warnings_once
from sb3_tdc.progress import ProgressCallback
from sb3_tdc.run_folder import RunFolder, make_numbered, save
from sb3_tdc.safe_load import load_normalization, load_replay_buffer, load_safely, read_data
from sb3_tdc.tdc import TDC, NonFiniteError
from sb3_tdc.tdc.off_policy import CheckedOffPolicyAlgorithm

ALGORITHMS: dict[str, type[OffPolicyAlgorithm]] = {
    "tdc": TDC,
    "meow": MEOW,
    "td3": TD3,
    "sac": SAC,
    "ddpg": DDPG,
    "advb_td3": AdvBTD3,
    "advb_sac": AdvBSAC,
    "advb_tdc": AdvBTDC,
}


@dataclass
class Experiment:
    """
    What one run is made of, besides its hyperparameters.

    :param algo: a key of ``ALGORITHMS``
    :param env_id: a registered environment
    :param eval_freq: environment steps between evaluations; 0 or less: none
    :param eval_episodes: episodes per evaluation, with the mean action
    :param save_freq: environment steps between saved models; 0 or less: none
    :param checkpoint_freq: environment steps between checkpoints to resume from; 0 or less: none
    :param resume: go on from the newest checkpoint in the folder
    :param from_step: go on from the checkpoint of this step instead
    :param start_over: remove these checkpoints first
    :param changed: hyperparameters that are others from there on
    :param tensorboard_log: "" for none; None for the run's own folder
    :param trained_model: a zip to start from; its replay buffer and normalisation are loaded if they lie next to it
    :param trust: whether ``trained_model`` and what lies beside it may run code, as SB3's ``load`` lets them
    :param log_interval: episodes between log entries; None for none
    """

    algo: str
    env_id: str
    hyperparams: Hyperparams
    folder: RunFolder
    seed: int
    eval_freq: int = 20_000
    eval_episodes: int = 5
    n_eval_envs: int = 1
    save_freq: int = -1
    save_replay_buffer: bool = False
    checkpoint_freq: int = DEFAULT_FREQ
    resume: bool = False
    from_step: int | None = None
    start_over: bool = False
    changed: tuple[str, ...] = ()
    vec_env: str = "dummy"
    device: str = "auto"
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    eval_env_kwargs: dict[str, Any] = field(default_factory=dict)
    tensorboard_log: str | None = None
    trained_model: Path | None = None
    trust: bool = False
    log_interval: int | None = 4
    progress_bar: bool = False
    verbose: int = 1


class NotSavedError(Exception):
    """A trained model that cannot be written, with the reason in one sentence."""


class TrainingError(Exception):
    """Training that an environment, a wrapper or a callback ended: the step and the reason in one sentence."""


class SetupError(ValueError):
    """A run that could not begin, with the reason in one sentence."""


# What constructors of environments, wrappers, algorithms and callbacks raise for what they do not allow
SETUP_ERRORS = (ValueError, AssertionError, TypeError, RuntimeError, ImportError, OSError, EOFError, gym.error.Error)


@dataclass(frozen=True)
class Outcome:
    """
    How a run ended.

    :param interrupted: whether the user stopped it before its last step
    :param checkpoint: the timestep from which it can be resumed, if it can
    """

    model: OffPolicyAlgorithm
    interrupted: bool
    checkpoint: int | None


def check_env_id(env_id: str) -> None:
    """:raises ValueError: naming the nearest environment, if it is not registered"""
    if env_id in gym.registry:
        return
    close = difflib.get_close_matches(env_id, gym.registry, n=3)
    nearest = f"; did you mean {' or '.join(close)}?" if close else "."
    raise ValueError(
        f"There is no environment {env_id!r}{nearest} "
        "An environment of another package is registered by --gym-packages PACKAGE."
    )


def make_envs(
    env_id: str,
    hyperparams: Hyperparams,
    seed: int,
    n_envs: int,
    env_kwargs: dict[str, Any] | None = None,
    vec_env: str = "dummy",
    monitor_folder: Path | None = None,
    normalization: Path | None = None,
    training: bool = True,
    trust: bool = False,
) -> VecEnv:
    """
    The environments of a run, wrapped as its hyperparameters say.

    :param env_kwargs: of the environment's constructor, over those of the hyperparameters
    :param vec_env: "dummy" (one process) or "subproc"
    :param monitor_folder: for ``*.monitor.csv``
    :param normalization: saved statistics for ``VecNormalize``
    :param training: False: statistics stay as they are and rewards are not normalised
    :param trust: whether the saved statistics may run code, as in ``VecNormalize.load``
    """
    spec = gym.spec(env_id)

    def make_env(**kwargs: Any) -> gym.Env:  # Monitor comes around it: it must see the ends of the wrapped episodes
        if vec_env == "subproc":
            ignore_signals()
        say_warnings_once()
        try:
            env = spec.make(**kwargs)
            for wrapper in hyperparams.env_wrapper:
                env = wrapper(env)
            return CheckedEnv(env)
        except Exception as error:
            reason = describe_exception(error)
            raise EnvironmentFaultError(f"{env_id} cannot be made: {reason}", traceback.format_exc()) from error

    env = make_vec_env(
        make_env,
        n_envs=n_envs,
        seed=seed,
        monitor_dir=str(monitor_folder) if monitor_folder else None,
        monitor_kwargs=hyperparams.monitor_kwargs,
        env_kwargs={**hyperparams.env_kwargs, **(env_kwargs or {})},
        vec_env_cls=CheckedSubprocVecEnv if vec_env == "subproc" else DummyVecEnv,
        wrapper_class=Restorable if vec_env == "subproc" else None,
    )
    for wrapper in hyperparams.vec_env_wrapper:
        env = wrapper(env)
    if hyperparams.frame_stack is not None:  # before normalising: replay stores what VecNormalize was given
        env = VecFrameStack(env, hyperparams.frame_stack)
    if hyperparams.normalize is not None:
        if normalization is not None:
            env = VecNormalize.load(str(normalization), env) if trust else load_normalization(normalization, env)
        else:
            env = VecNormalize(env, **hyperparams.normalize)
        if not training:
            env.training, env.norm_reward = False, False
    return env


def _has_state(experiment: Experiment) -> bool:
    """Return whether there is a state to resume from: it has more than lies next to a trained model."""
    return experiment.resume and bool(stored_steps(experiment.folder.checkpoint_folder))


def train(experiment: Experiment) -> Outcome:
    """
    Train from the first step to the last, or to Ctrl-C; either way the model is saved (after a second one, it is not).

    :raises SetupError: if the run cannot begin; its folder is removed, if it was made for it
    :raises NonFiniteError: if training diverged; saved models stay as they are
    :raises TrainingError: if an environment or a callback raised; the folder has the traceback
    :raises NotSavedError: if the trained model cannot be written
    :raises LockedError: if another process has begun to write to the folder
    """
    with ended_processes(), ExitStack() as stack:
        try:
            if experiment.trained_model is not None:
                check_saved_by(experiment.trained_model, experiment.algo)
            checkpoints = _open_checkpoints(experiment)
            if checkpoints is not None:
                stack.callback(checkpoints.store.close)
            env = stack.enter_context(_closing(_make_training_envs(experiment)))
            model = _make_model(experiment, env)
            model.set_logger(_make_logger(experiment))
            stack.callback(model.logger.close)
            eval_env = None
            if experiment.eval_freq > 0:
                eval_env = stack.enter_context(_closing(_make_eval_envs(experiment)))
                eval_env = model._wrap_env(eval_env, verbose=0, monitor_wrapper=False)
            board = []
            if isinstance(model, Advised):
                test_env = stack.enter_context(_closing(_make_test_env(experiment)))
                board = [BoardCallback(model._wrap_env(test_env, verbose=0, monitor_wrapper=False))]
            stop = StopOnSignal(checkpoints)
            progress = ProgressCallback(experiment.progress_bar, experiment.verbose)
            callbacks = [*board, *_make_callbacks(experiment, eval_env, progress, stop), progress, stop]
            if checkpoints is not None:
                callbacks.insert(0, checkpoints)
                _choose_checkpoint(experiment, checkpoints, model)
            if not isinstance(model, CheckedOffPolicyAlgorithm):
                callbacks.insert(0, FiniteGuard())
            callbacks.insert(0, BusyMachine(progress.say, _remedy(experiment)))
        except BaseException as error:
            stack.close()
            if not experiment.resume:
                shutil.rmtree(experiment.folder.path)
            if not isinstance(error, (*SETUP_ERRORS, KeyboardInterrupt)):
                raise
            raise SetupError(" ".join(str(error).split()) or "Interrupted before training began") from error
        stack.callback(progress.close)
        with stop, divergence_named(model):
            _learn(experiment, model, callbacks)
            _save(experiment, model)
        if not stop.requested:
            experiment.folder.mark_finished(model.num_timesteps)
            if checkpoints is not None:
                checkpoints.store.remove_all()
        return Outcome(model, stop.requested, checkpoints.last_step if checkpoints is not None else None)


def _learn(experiment: Experiment, model: OffPolicyAlgorithm, callbacks: list[BaseCallback]) -> None:
    try:
        model.learn(
            experiment.hyperparams.n_timesteps,
            callback=callbacks,
            log_interval=experiment.log_interval,  # type: ignore[arg-type]  # None is none
        )
    except (NonFiniteError, NotRestoredError, LockedError):
        raise
    except Exception as error:
        if isinstance(error, EnvironmentFaultError):
            reason, details = str(error), error.details
        else:
            reason, details = describe_exception(error), ""
        if model.num_timesteps == 0 and not experiment.resume:
            shutil.rmtree(experiment.folder.path)
            raise SetupError(f"{experiment.env_id} failed before the first step: {reason}") from error
        experiment.folder.write_error(details or traceback.format_exc())
        raise TrainingError(f"Training failed at step {model.num_timesteps:,}: {reason}") from error


def _remedy(experiment: Experiment) -> str:
    """What a run does that is to continue on one thread."""
    if experiment.checkpoint_freq > 0:
        return f"press Ctrl-C, then\n  {experiment.folder.command_to_resume} --num-threads 1"
    return "press Ctrl-C, and add --num-threads 1 to the command that is printed then."


def _open_checkpoints(experiment: Experiment) -> Checkpoints | None:
    folder = experiment.folder
    if experiment.checkpoint_freq <= 0:
        return None
    of_evaluations = [folder.best_model, folder.normalization(folder.best_model)]
    checkpoints = Checkpoints(
        folder.checkpoint_folder,
        experiment.checkpoint_freq,
        files=of_evaluations if experiment.eval_freq > 0 else [],
        hyperparams=experiment.hyperparams.raw,
        verbose=experiment.verbose,
    )
    if experiment.start_over:
        checkpoints.store.clear()
    if experiment.resume and not checkpoints.store.steps():  # stopped before its first step
        for events in folder.path.glob("events.out.tfevents.*"):
            events.unlink()
    return checkpoints


def _choose_checkpoint(experiment: Experiment, checkpoints: Checkpoints, model: OffPolicyAlgorithm) -> None:
    """Choose the checkpoint to go on from, and record hyperparameters that are changed from there on."""
    folder = experiment.folder
    # Whatever has ever been changed is as in config.yml: the checkpoint may be older than the change
    earlier = [name for change in folder.changes for name in change["hyperparams"]]
    step = checkpoints.restore(model, experiment.from_step, [*earlier, *experiment.changed])
    if experiment.changed:
        folder.record_change(step or 0, experiment.hyperparams.raw, experiment.changed)


def _make_training_envs(experiment: Experiment) -> VecEnv:
    normalization = None
    if experiment.trained_model is not None and not _has_state(experiment):
        run = RunFolder(experiment.trained_model.parent, experiment.folder.env_name)
        normalization = run.normalization(experiment.trained_model)
        if not normalization.exists():
            normalization = None
        elif experiment.hyperparams.normalize is None:
            raise ValueError(
                f"{experiment.trained_model} was trained on normalised observations: add -params normalize:true"
            )
    return make_envs(
        experiment.env_id,
        experiment.hyperparams,
        experiment.seed,
        experiment.hyperparams.n_envs,
        experiment.env_kwargs,
        experiment.vec_env,
        monitor_folder=experiment.folder.path,
        normalization=normalization,
        trust=experiment.trust,
    )


def _make_eval_envs(experiment: Experiment) -> VecEnv:
    return make_envs(
        experiment.env_id,
        experiment.hyperparams,
        experiment.seed + 1_000,  # other initial states than in training
        experiment.n_eval_envs,
        experiment.eval_env_kwargs or experiment.env_kwargs,
        experiment.vec_env,
        training=False,
    )


def _make_test_env(experiment: Experiment) -> VecEnv:
    """The environment of the test episodes of a board."""
    return make_envs(
        experiment.env_id,
        experiment.hyperparams,
        experiment.seed + 2_000,  # other initial states than in training and in evaluations
        1,
        experiment.env_kwargs,
        training=False,
    )


def _make_model(experiment: Experiment, env: VecEnv) -> OffPolicyAlgorithm:
    algorithm = ALGORITHMS[experiment.algo]
    kwargs = dict(experiment.hyperparams.model)
    noise = _make_action_noise(experiment.hyperparams, env)
    if noise is not None:
        kwargs["action_noise"] = noise
    kwargs.update(seed=experiment.seed, device=experiment.device, verbose=int(experiment.verbose > 1))
    if experiment.trained_model is None:
        return algorithm(env=env, **kwargs)

    for of_the_saved_model in ("policy", "policy_kwargs"):
        kwargs.pop(of_the_saved_model, None)
    model = load_model(experiment.trained_model, experiment.algo, env, experiment.trust, **kwargs)
    if _has_state(experiment):
        return model
    run = RunFolder(experiment.trained_model.parent, experiment.folder.env_name)
    replay_buffer = run.replay_buffer(experiment.trained_model)
    if replay_buffer.exists():
        if experiment.trust:
            model.load_replay_buffer(replay_buffer)
        else:
            load_replay_buffer(replay_buffer, model)
        assert model.replay_buffer is not None
        if model.replay_buffer.n_envs != env.num_envs:
            raise ValueError(
                f"{replay_buffer} is of {model.replay_buffer.n_envs} environments, this run has {env.num_envs}"
            )
        model.learning_starts = 0  # no random steps on top of the experience that is there
    return model


def load_model(path: Path, algo: str, env: VecEnv, trust: bool, **kwargs: Any) -> OffPolicyAlgorithm:
    """
    :param algo: a key of ``ALGORITHMS``
    :param trust: whether the file may run code, as SB3's ``load`` lets it
    :param kwargs: those of the algorithm's ``load``
    :raises ValueError: if a file is not a saved model, is one of another algorithm, or is refused
    """
    check_saved_by(path, algo)
    if trust:
        return ALGORITHMS[algo].load(path, env=env, **kwargs)
    return load_safely(path, env, algorithm=ALGORITHMS[algo], **kwargs)


def check_saved_by(path: Path, algo: str) -> None:
    """:raises ValueError: if a file is not a saved model, or is one of another algorithm"""
    policy_class = read_data(path).get("policy_class")
    module = policy_class.get("__module__") if isinstance(policy_class, dict) else None
    modules = {a: {p.__module__ for p in ALGORITHMS[a].policy_aliases.values()} for a in ALGORITHMS}
    others = [a for a in ALGORITHMS if module in modules[a]]
    if others and algo not in others:
        raise ValueError(f"{path} was saved by {' or '.join(others)}, not by {algo}: --algo {others[0]}")


def _make_action_noise(hyperparams: Hyperparams, env: VecEnv) -> ActionNoise | None:
    if hyperparams.noise_type is None:
        return None
    noise = {"normal": NormalActionNoise, "ornstein-uhlenbeck": OrnsteinUhlenbeckActionNoise}[hyperparams.noise_type]
    shape = env.action_space.shape
    assert shape is not None
    return noise(np.zeros(shape), np.full(shape, hyperparams.noise_std))


def _make_logger(experiment: Experiment) -> Logger:
    folder = experiment.folder.path
    writers: list[KVWriter] = [CSVOutputFormat(str(folder / "progress.csv"))]
    if experiment.tensorboard_log is None:
        writers.append(TensorBoardOutputFormat(str(folder)))
    elif experiment.tensorboard_log:
        parent = Path(experiment.tensorboard_log) / experiment.folder.env_name
        writers.append(TensorBoardOutputFormat(str(make_numbered(parent, experiment.algo.upper()))))
    if experiment.verbose > 1:
        writers.append(HumanOutputFormat(sys.stdout))
    return Logger(str(folder), writers)


def _make_callbacks(
    experiment: Experiment, eval_env: VecEnv | None, progress: ProgressCallback, stop: StopOnSignal
) -> list[BaseCallback]:
    hyperparams, folder = experiment.hyperparams, experiment.folder
    callbacks = [*(make() for make in hyperparams.callbacks), _HParamsCallback(experiment)]

    def calls(freq: int) -> int:  # callbacks count calls, one for a step of all environments
        return max(freq // hyperparams.n_envs, 1)

    if experiment.save_freq > 0:
        callbacks.append(
            _SavePeriodically(
                calls(experiment.save_freq),
                str(folder.path),
                save_replay_buffer=experiment.save_replay_buffer,
                save_vecnormalize=True,
            )
        )
    if eval_env is not None:
        callbacks.append(
            CriticEvaluation(
                eval_env,
                stop,
                callback_on_new_best=_SaveBest(folder),
                callback_after_eval=progress.evaluation,
                n_eval_episodes=experiment.eval_episodes,
                eval_freq=calls(experiment.eval_freq),
                log_path=str(folder.path),
                deterministic=True,
                verbose=0,
            )
        )
    return callbacks


def _save(experiment: Experiment, model: OffPolicyAlgorithm) -> None:
    folder = experiment.folder
    try:
        _save_model(model, folder, folder.model)
        if experiment.save_replay_buffer:
            save(model.save_replay_buffer, folder.replay_buffer(folder.model))
    except _DISK_ERRORS as error:
        reason = " ".join(str(error).split())
        raise NotSavedError(f"The model of step {model.num_timesteps:,} could not be saved: {reason}") from error


def _save_model(model: BaseAlgorithm, folder: RunFolder, path: Path) -> None:
    check_weights(model, path)
    save(model.save, path)
    normalization = model.get_vec_normalize_env()
    if normalization is not None:
        save(lambda beside: normalization.save(str(beside)), folder.normalization(path))


@contextmanager
def _closing(env: VecEnv) -> Iterator[VecEnv]:
    try:
        yield env
    except KeyboardInterrupt:  # perhaps in the middle of a step: a process could be waited for in vain
        for process in getattr(env.unwrapped, "processes", []):
            process.kill()
        raise
    finally:
        env.close()


class _SaveBest(BaseCallback):
    """Save a new best model, and the statistics of ``VecNormalize``. A full disk does not end training."""

    def __init__(self, folder: RunFolder):
        super().__init__()
        self.folder = folder

    def _on_step(self) -> bool:
        try:
            _save_model(self.model, self.folder, self.folder.best_model)
        except _DISK_ERRORS as error:
            warnings.warn(f"The best model of step {self.num_timesteps:,} was not saved: {error}", stacklevel=2)
        return True


class _SavePeriodically(CheckpointCallback):
    """The same for the models of ``--save-freq``."""

    def _on_step(self) -> bool:
        if self.n_calls % self.save_freq == 0:
            check_weights(self.model, Path(self._checkpoint_path(extension="zip")))
        try:
            return super()._on_step()
        except _DISK_ERRORS as error:
            warnings.warn(f"The model of step {self.num_timesteps:,} was not saved: {error}", stacklevel=2)
        return True


# A full disk; PyTorch reports it in its own way
_DISK_ERRORS = (OSError, RuntimeError)


class _HParamsCallback(BaseCallback):
    """Write the hyperparameters to TensorBoard's HParams tab."""

    def __init__(self, experiment: Experiment):
        super().__init__()
        flat: dict[str, bool | str | float | None] = {
            "algo": experiment.algo,
            "env": experiment.env_id,
            "seed": experiment.seed,
        }
        for key, value in experiment.hyperparams.raw.items():
            flat[key] = value if isinstance(value, (bool, int, float, str)) else str(value)
        self.hparams = flat

    def _on_training_start(self) -> None:
        metrics: dict[str, float] = {"eval/mean_reward": 0.0, "rollout/ep_rew_mean": 0.0}
        self.logger.record("hparams", HParam(self.hparams, metrics), exclude=("stdout", "log", "json", "csv"))
        self.logger.dump(self.num_timesteps)

    def _on_step(self) -> bool:
        return True
