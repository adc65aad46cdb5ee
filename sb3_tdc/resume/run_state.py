"""The state of a run, on which the rest of it depends: captured between two rollouts, restored before the first one."""

import json
import platform
import random
import time
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import TD3
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.distributions import StateDependentNoiseDistribution
from stable_baselines3.common.logger import HumanOutputFormat
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_tdc.common.finite import find_non_finite_weights
from sb3_tdc.common.off_policy import CheckedOffPolicyAlgorithm
from sb3_tdc.common.versions import library_versions
from sb3_tdc.common.words import listed
from sb3_tdc.resume.compare import differences
from sb3_tdc.resume.kinds.table import KINDS
from sb3_tdc.resume.locations import UNMOVED, Locations
from sb3_tdc.resume.replay_file import other_attributes
from sb3_tdc.resume.walk import MISSING, Capture, Initial, NotRestoredError, Restore, name_of

# Attributes of the process or of the call of learn(), or captured separately
_NOT_THE_RUN = {"env", "policy", "replay_buffer", "tensorboard_log", "verbose", "start_time", "_total_timesteps"}


def capture_state(
    model: OffPolicyAlgorithm, callback: BaseCallback, initial: Initial | None = None
) -> tuple[dict[str, Any], Capture]:
    """
    Capture everything but the weights and the transitions.

    Values that cannot be captured or restored are left out and noted.

    :param callback: the root of all callbacks
    :param initial: the initial capture, of the objects as they were built; None if this is that capture
    :return: the state as JSON, and the :class:`Capture` with its arrays
    """
    context = Capture(KINDS, _known(model), initial)
    parts: dict[str, Any] = {
        "model": context.capture_attributes(_attributes(model), "model", optional=True),
        "replay_buffer": context.capture_attributes(other_attributes(_buffer(model)), "replay_buffer", optional=True),
        "env": _capture_optional(context, model.env, "env"),
        "names of callbacks": [name_of(type(each)) for each in callbacks_of(callback)],
        "callbacks": _capture_optional(context, callback, "callbacks"),
        "logger": context.capture_attributes(_logger_attributes(model), "logger", optional=True),
        "seconds": (time.time_ns() - model.start_time) / 1e9,
        "random": context.capture(_random_state(), "random"),
    }
    context.tell_shared_memory()
    return parts, context


def _capture_optional(context: Capture, value: Any, path: str) -> Any:
    node = context.capture_optional(value, path)
    return None if node is MISSING else node


def restore_state(
    model: OffPolicyAlgorithm,
    callback: BaseCallback,
    parts: dict[str, Any],
    context: Restore,
    changed: Sequence[str] = (),
) -> None:
    """
    Restore everything but the weights and the rings of the replay buffer, which have been restored before.

    :param context: holds the arrays, and notes the values that are not restored and why episodes must start again
    :param changed: hyperparameters that keep their present values, out of those of :func:`changeable`
    :raises NotRestoredError: if the callbacks are not those that were captured
    """
    names = [name_of(type(each)) for each in callbacks_of(callback)]
    if names != parts["names of callbacks"]:
        raise NotRestoredError(
            f"The callbacks were {', '.join(parts['names of callbacks'])}, and are {', '.join(names)}"
        )
    _restore_values(model, callback, parts, context, changed)
    assert model.env is not None
    if not context.has_restored(model.env.unwrapped):  # whether or not its wrappers are restored
        context.restarted.append("env is not in the state, or does not fit it")
    restarted = [why for why in context.restarted if why.startswith("env")]
    model.start_time = time.time_ns() - int(parts["seconds"] * 1e9)
    if restarted:
        _restart_episodes(model)
    if isinstance(model, CheckedOffPolicyAlgorithm):
        model.prepare_to_continue()
    _set_random_state(context.restore(parts["random"], MISSING, "random"))  # last: all of the above may draw numbers


def _restore_values(
    model: OffPolicyAlgorithm,
    callback: BaseCallback,
    parts: dict[str, Any],
    context: Restore,
    changed: Sequence[str] = (),
) -> None:
    kept = {attribute for name in changed for attribute in changeable(model)[name]}
    for owner, path in ((model, "model"), (_buffer(model), "replay_buffer")):
        nodes = {name: node for name, node in parts[path].items() if name not in kept}
        context.restore_attributes(nodes, owner, path, optional=True)
    normalization = model.get_vec_normalize_env()
    built_gamma = normalization.gamma if normalization is not None else model.gamma
    for node, value, path in ((parts["env"], model.env, "env"), (parts["callbacks"], callback, "callbacks")):
        if node is not None:
            with context.optional(path):
                context.restore(node, value, path)
    if normalization is not None and "gamma" in changed:
        normalization.gamma = built_gamma
    logger = SimpleNamespace(**_logger_attributes(model))
    with context.names():
        context.restore_attributes(parts["logger"], logger, "logger", optional=True)
    for name, value in vars(logger).items():
        if name != "output_formats":
            setattr(model._logger, name, value)


def restoring(
    model: OffPolicyAlgorithm, arrays: list[np.ndarray], step: int = 0, locations: Locations = UNMOVED
) -> Restore:
    """Return the context for :func:`restore_state`."""
    return Restore(KINDS, arrays, _known(model), step, locations=locations)


def verify(model: OffPolicyAlgorithm, callback: BaseCallback) -> tuple[list[str], Initial]:
    """
    Capture the state, restore it into the same objects, capture it again, and compare. Files are not changed.

    :return: a sentence for each value that a resumed run would not have, beginning with its path; and the initial
        capture that later captures are compared with
    """
    parts, before = capture_state(model, callback)
    context = Restore(KINDS, before.arrays, _known(model), with_files=False)
    _restore_values(model, callback, json.loads(json.dumps(parts)), context)
    after = capture_state(model, callback, before.as_initial())[1]
    _set_random_state(context.restore(parts["random"], MISSING, "random"))
    differing = [f"{path} does not come back as it was" for path in differences(before, after)]
    names = [*before.left_out, *context.not_restored, *context.restarted, *differing, *after.left_out]
    return list(dict.fromkeys(names)), before.as_initial()


def _known(model: OffPolicyAlgorithm) -> dict[str, Any]:
    """Return the objects that are captured separately, by name; any other object may refer to them."""
    known: dict[str, Any] = {"model": model, "replay_buffer": model.replay_buffer}
    known |= {f"policy.{name}": module for name, module in model.policy.named_modules()}
    known |= {f"policy.{name}": parameter for name, parameter in model.policy.named_parameters()}
    state_dicts, tensors = model._get_torch_save_params()
    return known | {name: recursive_getattr(model, name) for name in (*state_dicts, *tensors)}


def _attributes(model: OffPolicyAlgorithm) -> dict[str, Any]:
    state_dicts, tensors = model._get_torch_save_params()
    elsewhere = {name.partition(".")[0] for name in (*state_dicts, *tensors)} | _NOT_THE_RUN
    elsewhere |= set(model._excluded_save_params()) - set(getattr(model, "captured_attributes", ()))
    return {name: value for name, value in vars(model).items() if name not in elsewhere}


def _logger_attributes(model: OffPolicyAlgorithm) -> dict[str, Any]:
    logger = getattr(model, "_logger", None)
    if logger is None:  # before learn()
        return {}
    attributes = {name: value for name, value in vars(logger).items() if name not in ("dir", "level")}
    # Output on a screen cannot be taken back, and a resumed run may have another screen, or none
    files = [each for each in logger.output_formats if not (isinstance(each, HumanOutputFormat) and not each.own_file)]
    return {**attributes, "output_formats": files}


def _buffer(model: OffPolicyAlgorithm) -> Any:
    assert model.replay_buffer is not None
    return model.replay_buffer


# ---------------------------------------------------------------- hyperparameters that may change

# Of every off-policy algorithm; and of SB3's own algorithms, which do not declare theirs in ``changeable``
_CHANGEABLE = ("learning_rate", "gamma", "tau", "batch_size", "gradient_steps", "train_freq", "learning_starts")
_CHANGEABLE_OF_SB3 = {TD3: ("policy_delay", "target_policy_noise", "target_noise_clip")}


def changeable(model: OffPolicyAlgorithm) -> dict[str, tuple[str, ...]]:
    """Return the hyperparameters that may be changed when a run is resumed, with the attributes of each."""
    of_sb3 = [name for kind, names in _CHANGEABLE_OF_SB3.items() if isinstance(model, kind) for name in names]
    names = (*_CHANGEABLE, *of_sb3, *getattr(model, "changeable", ()))
    return {name: ("learning_rate", "lr_schedule") if name == "learning_rate" else (name,) for name in names}


# ---------------------------------------------------------------- weights


def capture_weights(model: OffPolicyAlgorithm) -> dict[str, Any]:
    """Return the state dicts and tensors that SB3 saves in its zips, by the same names, and the matrices of gSDE."""
    state_dicts, tensors = model._get_torch_save_params()
    return {
        "state_dicts": {name: recursive_getattr(model, name).state_dict() for name in state_dicts},
        "tensors": {name: recursive_getattr(model, name).detach() for name in tensors},
        "noise": [{k: v.detach() for k, v in vars(d).items() if k in _GSDE} for d in _gsde(model)],
    }


def restore_weights(model: OffPolicyAlgorithm, weights: dict[str, Any]) -> None:
    """
    Restore weights in place, so that optimizers and targets still refer to the same parameters.

    :raises NotRestoredError: if the model has other optimizers and tensors than the state
    """
    then = {*weights["state_dicts"], *weights["tensors"]}
    if isinstance(model, CheckedOffPolicyAlgorithm):
        model.prepare_to_restore(then)
    now = {name for names in model._get_torch_save_params() for name in names}
    if now != then:
        raise NotRestoredError(
            f"The state has the weights of {listed(sorted(then))}, and the model has those of {listed(sorted(now))}"
        )
    for name, state in weights["state_dicts"].items():
        recursive_getattr(model, name).load_state_dict(state)
    with th.no_grad():
        for name, tensor in weights["tensors"].items():
            recursive_getattr(model, name).copy_(tensor)
    for distribution, noise in zip(_gsde(model), weights["noise"], strict=True):
        vars(distribution).update(noise)


def find_non_finite(model: OffPolicyAlgorithm) -> list[str]:
    """Return the names of the weights, optimizer moments and running statistics that are NaN or infinite."""
    broken = find_non_finite_weights(model)
    state_dicts, _ = model._get_torch_save_params()
    numbers: dict[str, Any] = {}
    for name in state_dicts:
        optimizer = recursive_getattr(model, name)
        if isinstance(optimizer, th.optim.Optimizer):
            for i, moments in optimizer.state_dict()["state"].items():
                numbers |= {f"{name}[{i}].{moment}": value for moment, value in moments.items()}
    normalization = model.get_vec_normalize_env()
    if normalization is not None:
        of_observations = vars(normalization).get("obs_rms")  # there is none if only rewards are normalised
        statistics = {"ret_rms": normalization.ret_rms, "obs_rms": of_observations}
        if isinstance(of_observations, dict):
            statistics.update({f"obs_rms[{key!r}]": rms for key, rms in of_observations.items()})
        for name, rms in statistics.items():
            if isinstance(rms, RunningMeanStd):
                numbers |= {f"VecNormalize.{name}.{part}": th.as_tensor(vars(rms)[part]) for part in ("mean", "var")}
    return broken + [n for n, value in numbers.items() if isinstance(value, th.Tensor) and not value.isfinite().all()]


_GSDE = ("exploration_mat", "exploration_matrices")


def _gsde(model: OffPolicyAlgorithm) -> list[StateDependentNoiseDistribution]:
    distributions = [getattr(module, "action_dist", None) for module in model.policy.modules()]
    return [d for d in distributions if isinstance(d, StateDependentNoiseDistribution)]


# ---------------------------------------------------------------- random numbers


def _random_state() -> dict[str, Any]:
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(legacy=False),
        "torch": th.get_rng_state(),
        "cuda": th.cuda.get_rng_state_all() if th.cuda.is_initialized() else [],
    }


def _set_random_state(state: dict[str, Any]) -> None:
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])
    th.set_rng_state(state["torch"])
    if state["cuda"] and th.cuda.device_count() == len(state["cuda"]):
        th.cuda.set_rng_state_all(state["cuda"])


# ---------------------------------------------------------------- episodes that start again


def _restart_episodes(model: OffPolicyAlgorithm) -> None:
    """End the unfinished episodes in the replay buffer, as if a time limit had been reached, and begin new ones."""
    assert model.env is not None
    buffer = _buffer(model)
    if buffer.size() > 0:
        last = (buffer.pos - 1) % buffer.buffer_size
        if buffer.handle_timeout_termination:
            buffer.timeouts[last] = np.maximum(buffer.timeouts[last], 1 - buffer.dones[last])
        buffer.dones[last] = 1
        if isinstance(buffer, HerReplayBuffer):
            for i in range(buffer.n_envs):
                if buffer._current_ep_start[i] != buffer.pos:
                    buffer._compute_episode_length(i)
    if model.action_noise is not None:
        model.action_noise.reset()
    if isinstance(model, CheckedOffPolicyAlgorithm):
        model.forget_episodes()
    model._last_obs = model.env.reset()  # type: ignore[assignment]
    model._last_episode_starts = np.ones((model.env.num_envs,), dtype=bool)
    if model._vec_normalize_env is not None:
        model._last_original_obs = model._vec_normalize_env.get_original_obs()


# ---------------------------------------------------------------- descriptions of the run and its platform


def describe_run(model: OffPolicyAlgorithm) -> dict[str, Any]:
    """Return the properties that a state and the run that it is restored into must have in common."""
    assert model.env is not None
    spec = model.env.get_attr("spec")[0]
    return {
        "algorithm": f"{type(model).__module__}.{type(model).__qualname__}",
        "environment": spec.id if spec is not None else type(model.env.unwrapped).__name__,
        "number of environments": model.n_envs,
        "observation space": str(model.observation_space),
        "action space": str(model.action_space),
        "policy": f"{type(model.policy).__module__}.{type(model.policy).__qualname__}",
        "replay buffer": type(model.replay_buffer).__qualname__,
        "size of the replay buffer": _buffer(model).buffer_size,
        "network": [[name, list(tensor.shape)] for name, tensor in model.policy.state_dict().items()],
    }


def describe_platform(model: OffPolicyAlgorithm) -> dict[str, str]:
    """Return the properties of the platform on which the last bits of a result depend."""
    return {
        **library_versions(),
        "threads of torch": str(th.get_num_threads()),
        "device": str(model.device),
        "processor": f"{platform.machine()}, {th.backends.cpu.get_cpu_capability()}",
    }


def callbacks_of(callback: BaseCallback) -> list[BaseCallback]:
    """
    Find all callbacks.

    :param callback: the root of all callbacks
    :return: the root, and the callbacks that it holds, directly or in lists, at any depth
    """
    reached = [callback]
    for callback in reached:  # grows in the loop
        if getattr(callback, "is_captured", True):
            values = [item for v in vars(callback).values() for item in (v if isinstance(v, list) else [v])]
            reached += [v for v in values if isinstance(v, BaseCallback) and not any(v is r for r in reached)]
    return reached


def files_of_evaluations(callback: BaseCallback) -> list[Path]:
    """
    Find the files that evaluations rewrite.

    :param callback: the root of all callbacks
    :return: the best model and the log of every ``EvalCallback`` among the callbacks
    """
    found: list[Path] = []
    for evaluation in evaluations_of(callback):
        if evaluation.best_model_save_path is not None:
            found.append(Path(evaluation.best_model_save_path) / "best_model.zip")
        if evaluation.log_path is not None:
            found.append(Path(f"{evaluation.log_path}.npz"))
    return found


def evaluations_of(callback: BaseCallback) -> list[EvalCallback]:
    """
    Find the callbacks that evaluate.

    :param callback: the root of all callbacks
    :return: every ``EvalCallback`` among the callbacks
    """
    return [each for each in callbacks_of(callback) if isinstance(each, EvalCallback)]
