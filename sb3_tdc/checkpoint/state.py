"""Everything that the rest of a run depends on: captured between two rollouts, restored before the first."""

import platform
import random
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.distributions import StateDependentNoiseDistribution
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_tdc.checkpoint.codec import Capture, Restore
from sb3_tdc.checkpoint.replay import other_attributes
from sb3_tdc.tdc.checks import find_non_finite as find_non_finite_weights
from sb3_tdc.versions import library_versions

# Of the process, of the call of learn(), or captured on their own
_NOT_THE_RUN = {"env", "policy", "replay_buffer", "tensorboard_log", "verbose", "start_time", "_total_timesteps"}
# TDC does not put these into its zips, but the log depends on them
_OF_THE_RUN = {"_diagnostics"}


def capture_state(model: OffPolicyAlgorithm, callback: BaseCallback) -> tuple[dict[str, Any], Capture]:
    """
    :param callback: the root of all callbacks
    :return: JSON, and the :class:`Capture` with its arrays
    :raises NotCapturedError: if the algorithm has an attribute that cannot be captured
    """
    context = Capture({"model": model})
    parts: dict[str, Any] = {
        "model": context.capture_attributes(_attributes(model), "model"),
        "replay_buffer": context.capture_attributes(other_attributes(_buffer(model)), "replay_buffer"),
        "env": context.capture(model.env, "env"),
        "callbacks": context.capture(callback, "callbacks"),
        "logger": context.capture_attributes(_logger_attributes(model), "logger", optional=True),
        "seconds": (time.time_ns() - model.start_time) / 1e9,
        "random": context.capture(_random_state(), "random"),
    }
    return parts, context


def restore_state(
    model: OffPolicyAlgorithm,
    callback: BaseCallback,
    parts: dict[str, Any],
    arrays: list[np.ndarray],
    step: int,
    changed: Sequence[str] = (),
) -> list[str]:
    """
    Everything but the weights and the rings of the replay buffer, which are there already.

    :param changed: hyperparameters that stay as they are, out of ``CHANGEABLE``
    :return: why episodes have to be started again, if they do
    :raises NotRestoredError: if the model, its environments or its callbacks are others than those captured
    """
    context = Restore(arrays, {"model": model}, step)
    kept = {attribute for name in changed for attribute in CHANGEABLE[name]}
    for owner, path in ((model, "model"), (_buffer(model), "replay_buffer")):
        nodes = {name: node for name, node in parts[path].items() if name not in kept}
        context.restore_attributes(nodes, owner, path)
    context.restore(parts["env"], model.env, "env")
    restarted = list(context.restarted)
    context.restore(parts["callbacks"], callback, "callbacks")
    context.restore_attributes(parts["logger"], model.logger, "logger")
    model.start_time = time.time_ns() - int(parts["seconds"] * 1e9)
    if restarted:
        _restart_episodes(model)
    bind_fused_update = getattr(model, "_bind_fused_update", None)
    if bind_fused_update is not None and model._n_updates > 0:
        bind_fused_update(model.batch_size)  # it also chooses the actions
    _set_random_state(context.restore(parts["random"], None, "random"))  # last: all of the above may draw
    return restarted


def _attributes(model: OffPolicyAlgorithm) -> dict[str, Any]:
    state_dicts, tensors = model._get_torch_save_params()
    elsewhere = {name.partition(".")[0] for name in (*state_dicts, *tensors)} | _NOT_THE_RUN
    elsewhere |= set(model._excluded_save_params()) - _OF_THE_RUN
    return {name: value for name, value in vars(model).items() if name not in elsewhere}


def _logger_attributes(model: OffPolicyAlgorithm) -> dict[str, Any]:
    return {name: value for name, value in vars(model.logger).items() if name not in ("dir", "level")}


def _buffer(model: OffPolicyAlgorithm) -> Any:
    assert model.replay_buffer is not None
    return model.replay_buffer


# ---------------------------------------------------------------- hyperparameters that may change

# The attributes that a hyperparameter is kept in; ``gamma`` also in replay buffers for n steps
CHANGEABLE: dict[str, tuple[str, ...]] = {
    "learning_rate": ("learning_rate", "lr_schedule"),
    **{
        name: (name,)
        for name in (
            *("qf_learning_rate", "gamma", "tau", "lam", "kappa", "batch_size", "gradient_steps", "train_freq"),
            *("policy_delay", "target_policy_noise", "target_noise_clip", "learning_starts"),
        )
    },
}


# ---------------------------------------------------------------- weights


def capture_weights(model: OffPolicyAlgorithm) -> dict[str, Any]:
    """:return: state dicts and tensors, as SB3 names them for its zips, and the matrices of gSDE"""
    state_dicts, tensors = model._get_torch_save_params()
    return {
        "state_dicts": {name: recursive_getattr(model, name).state_dict() for name in state_dicts},
        "tensors": {name: recursive_getattr(model, name).detach() for name in tensors},
        "noise": [{k: v.detach() for k, v in vars(d).items() if k in _GSDE} for d in _gsde(model)],
    }


def restore_weights(model: OffPolicyAlgorithm, weights: dict[str, Any]) -> None:
    """In place, so that optimizers and targets stay those of the parameters."""
    for name, state in weights["state_dicts"].items():
        recursive_getattr(model, name).load_state_dict(state)
    with th.no_grad():
        for name, tensor in weights["tensors"].items():
            recursive_getattr(model, name).copy_(tensor)
    for distribution, noise in zip(_gsde(model), weights["noise"], strict=True):
        vars(distribution).update(noise)


def find_non_finite(model: OffPolicyAlgorithm) -> list[str]:
    """:return: the names of weights, moments of optimizers and running statistics that are NaN or infinite"""
    broken = find_non_finite_weights(model.policy, model.policy.state_dict())
    state_dicts, tensors = model._get_torch_save_params()
    numbers: dict[str, Any] = {name: recursive_getattr(model, name).detach() for name in tensors}
    for name in state_dicts:
        optimizer = recursive_getattr(model, name)
        if isinstance(optimizer, th.optim.Optimizer):
            for i, moments in optimizer.state_dict()["state"].items():
                numbers |= {f"{name}[{i}].{moment}": value for moment, value in moments.items()}
    normalization = model.get_vec_normalize_env()
    if normalization is not None:
        statistics = {"ret_rms": normalization.ret_rms, "obs_rms": normalization.obs_rms}
        if isinstance(normalization.obs_rms, dict):
            statistics.update({f"obs_rms[{key!r}]": rms for key, rms in normalization.obs_rms.items()})
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
    """What the replay buffer holds of the episodes under way ends there, as if a time limit had been reached."""
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
    model._last_obs = model.env.reset()  # type: ignore[assignment]
    model._last_episode_starts = np.ones((model.env.num_envs,), dtype=bool)
    if model._vec_normalize_env is not None:
        model._last_original_obs = model._vec_normalize_env.get_original_obs()


# ---------------------------------------------------------------- where it ran, and what it is


def describe_run(model: OffPolicyAlgorithm) -> dict[str, Any]:
    """:return: what a run cannot go on without"""
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
    """:return: what the last bits of a result depend on"""
    return {
        **library_versions(),
        "threads of torch": str(th.get_num_threads()),
        "device": str(model.device),
        "processor": f"{platform.machine()}, {th.backends.cpu.get_cpu_capability()}",
    }


def files_of_evaluations(callback: BaseCallback) -> list[Path]:
    """
    :param callback: the root of all callbacks
    :return: what every ``EvalCallback`` among them rewrites
    """
    found: list[Path] = []
    reached = [callback]
    for callback in reached:  # grows
        if isinstance(callback, EvalCallback):
            if callback.best_model_save_path is not None:
                found.append(Path(callback.best_model_save_path) / "best_model.zip")
            if callback.log_path is not None:
                found.append(Path(f"{callback.log_path}.npz"))
        if getattr(callback, "is_checkpointed", True):
            values = [item for v in vars(callback).values() for item in (v if isinstance(v, list) else [v])]
            reached += [v for v in values if isinstance(v, BaseCallback) and not any(v is r for r in reached)]
    return found
