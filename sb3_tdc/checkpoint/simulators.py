"""One environment with all of its wrappers, captured whole in the middle of an episode; MuJoCo's data included."""

import hashlib
from typing import Any

import gymnasium as gym
from stable_baselines3.common.logger import TensorBoardOutputFormat
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from sb3_tdc.checkpoint import kinds  # noqa: F401  # these come before its own
from sb3_tdc.checkpoint.codec import (
    MISSING,
    Capture,
    Kind,
    NotCapturedError,
    NotRestoredError,
    Restore,
    add_kind,
    existing_as,
    plain,
)
from sb3_tdc.checkpoint.event_files import capture_event_files, restore_event_files


class Restorable(gym.Wrapper):
    """The way to an environment in a process of its own: ``SubprocVecEnv`` calls these methods there."""

    def capture_state(self) -> dict[str, Any]:
        """:return: of :func:`capture_env`"""
        return capture_env(self)

    def restore_state(self, state: dict[str, Any]) -> str | None:
        """:return: of :func:`restore_env`"""
        return restore_env(self, state)


def capture_env(env: gym.Env) -> dict[str, Any]:
    """
    :return: the environment, or if it cannot be captured its generator and its ``Monitor`` alone, and why. Of plain
        values and arrays
    """
    context = Capture()
    why, content = None, None
    try:
        content = context.capture(env, "env")
    except NotCapturedError as error:
        context, why = Capture(), str(error)
        monitors = [context.capture_attributes(_without_env(m), "Monitor", optional=True) for m in _monitors(env)]
        content = [context.capture(getattr(env.unwrapped, "_np_random", None), "np_random"), monitors]
    return {"why": why, "content": content, "arrays": context.arrays}


def restore_env(env: gym.Env, state: dict[str, Any]) -> str | None:
    """
    :return: None, or why the episode has to be started again
    """
    context = Restore(state["arrays"])
    if state["why"] is None:
        try:
            context.restore(state["content"], env, "env")
        except NotRestoredError as error:
            return str(error)
        return None
    generator, monitors = state["content"]
    restored = context.restore(generator, getattr(env.unwrapped, "_np_random", None), "np_random")
    for monitor, attributes in zip(_monitors(env), monitors, strict=False):
        context.restore_attributes(attributes, monitor, "Monitor")
    if restored is not None:
        env.unwrapped.np_random = restored
    return state["why"]


def _monitors(env: gym.Env) -> list[Monitor]:
    found = []
    while isinstance(env, gym.Wrapper):
        found += [env] if isinstance(env, Monitor) else []
        env = env.env
    return found


def _without_env(monitor: Monitor) -> dict[str, Any]:
    return {name: value for name, value in vars(monitor).items() if name != "env"}


# ---------------------------------------------------------------- MuJoCo


def _is_mujoco(name: str) -> Any:
    return lambda value: type(value).__name__ == name and type(value).__module__.startswith("mujoco")


def _model_bytes(model: Any) -> bytes:
    return model.__getstate__()


def _capture_mj_data(data: Any) -> dict[str, Any]:
    """MuJoCo's own bytes of the whole ``MjData``, without the model that it puts among them."""
    whole, model = data.__getstate__(), _model_bytes(data.model)
    before, found, after = whole.partition(model)
    if not found:
        raise NotCapturedError("MuJoCo's bytes of an MjData do not contain its model")
    return {"before": before, "after": after, "model": hashlib.sha256(model).hexdigest()}


def _restore_mj_data(existing: Any, state: dict[str, Any]) -> Any:
    import mujoco

    model = _model_bytes(existing_as(mujoco.MjData, existing, "MjData").model)
    if hashlib.sha256(model).hexdigest() != state["model"]:
        raise NotRestoredError("the environment has another MuJoCo model now, or has changed its model")
    source = mujoco.MjData.__new__(mujoco.MjData)
    source.__setstate__(state["before"] + model + state["after"])
    mujoco.mj_copyData(existing, existing.model, source)
    return existing


# ---------------------------------------------------------------- vectorised environments


def _capture_vec_env(context: Capture, env: Any, path: str) -> Any:
    if isinstance(env, DummyVecEnv):
        states = [capture_env(single) for single in env.envs]
    elif env.has_attr("capture_state"):
        states = env.env_method("capture_state")
    else:
        why = f"{path} is a SubprocVecEnv: wrap its environments in sb3_tdc.checkpoint.Restorable (wrapper_class)"
        states = [{"why": why, "content": None, "arrays": []} for _ in range(env.num_envs)]
    context.left_out += dict.fromkeys(state["why"] for state in states if state["why"] is not None)
    captured = []
    for state in states:
        numbers = [context.add_array(array) for array in state["arrays"]]
        captured.append({"why": state["why"], "content": state["content"], "arrays": numbers})
    return [captured, context.capture_attributes(_own_attributes(env), path)]


def _restore_vec_env(context: Restore, content: Any, existing: Any, path: str) -> Any:
    env = existing_as((DummyVecEnv, SubprocVecEnv), existing, path)
    captured, attributes = content
    if len(captured) != env.num_envs:
        raise NotRestoredError(f"{path} had {len(captured)} environments, and has {env.num_envs}")
    states = [{**state, "arrays": [context.arrays[number] for number in state["arrays"]]} for state in captured]
    if isinstance(env, DummyVecEnv):
        whys = [restore_env(single, state) for single, state in zip(env.envs, states, strict=True)]
    elif env.has_attr("restore_state"):
        whys = [env.env_method("restore_state", state, indices=i)[0] for i, state in enumerate(states)]
    else:
        whys = [state["why"] or "there is no sb3_tdc.checkpoint.Restorable around it" for state in states]
    context.restarted += [f"{path}, environment {i}: {why}" for i, why in enumerate(whys) if why is not None]
    context.restore_attributes(attributes, env, path)
    return existing


def _restore_event_files(context: Restore, content: Any, existing: Any, path: str) -> Any:
    output = existing_as(TensorBoardOutputFormat, existing, path)
    restore_event_files(output, context.restore(content, MISSING, path), context.step)
    return output


def _own_attributes(env: VecEnv) -> dict[str, Any]:
    """What else there is is overwritten by every step."""
    names = ("observation_space", "action_space", "_seeds", "_options")
    return {name: vars(env)[name] for name in names}


def _is_vec_env(value: Any) -> bool:
    return isinstance(value, (DummyVecEnv, SubprocVecEnv))


add_kind("MjData", plain(_is_mujoco("MjData"), _capture_mj_data, _restore_mj_data))
# Part of the MjData of every environment that has one; the two are compared there
add_kind(
    "MjModel",
    Kind(_is_mujoco("MjModel"), lambda context, value, path: None, lambda context, content, existing, path: existing),
)
add_kind("environments", Kind(_is_vec_env, _capture_vec_env, _restore_vec_env))
add_kind(
    "event files",
    Kind(
        lambda value: isinstance(value, TensorBoardOutputFormat),
        lambda context, value, path: context.capture(capture_event_files(value), path),
        _restore_event_files,
    ),
)
