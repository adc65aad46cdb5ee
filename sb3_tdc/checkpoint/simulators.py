"""One environment with all of its wrappers, captured whole in the middle of an episode; MuJoCo's data included."""

import hashlib
from typing import Any

import gymnasium as gym
from stable_baselines3.common.logger import TensorBoardOutputFormat
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from sb3_tdc.checkpoint.codec import (
    MISSING,
    Capture,
    NotCapturedError,
    NotRestoredError,
    Restore,
    attributes_of,
    existing_as,
    uncovered,
)
from sb3_tdc.checkpoint.event_files import capture_event_files, restore_event_files
from sb3_tdc.checkpoint.generators import GENERATORS
from sb3_tdc.checkpoint.locations import Locations


class Restorable(gym.Wrapper):
    """The way to an environment in a process of its own: ``SubprocVecEnv`` calls these methods there."""

    def capture_state(self) -> dict[str, Any]:
        """:return: of :func:`capture_env`"""
        return capture_env(self)

    def restore_state(self, state: dict[str, Any], with_files: bool, locations: Locations) -> str | None:
        """:return: of :func:`restore_env`"""
        return restore_env(self, state, with_files, locations)


def capture_env(env: gym.Env) -> dict[str, Any]:
    """
    :return: generators and the ``Monitor``, so that these go on whatever else does not; then the environment, or why it
        cannot be captured. Of plain values and arrays
    """
    monitors = _monitors(env)
    context = Capture(_known(monitors))
    generators = {
        name: {a: value for a, value in attributes_of(owner).items() if isinstance(value, GENERATORS)}
        for name, owner in _owners(env).items()
    }
    content: dict[str, Any] = {
        "generators": {n: context.capture_attributes(g, n, optional=True) for n, g in generators.items()},
        "monitors": [context.capture_attributes(_without_env(m), "Monitor", optional=True) for m in monitors],
    }
    whole = context.capture_optional([env, *(monitor.env for monitor in monitors)], "env")
    why = context.left_out[-1] if whole is MISSING else None
    content["whole"] = whole if why is None else None
    shared = context.shared_memory()
    return {
        "why": why,
        "content": content,
        "arrays": context.arrays,
        "left_out": context.left_out,
        "shared": shared,
        "texts": context.texts,
    }


def restore_env(env: gym.Env, state: dict[str, Any], with_files: bool, locations: Locations) -> str | None:
    """
    :param with_files: restore files too
    :param locations: with the texts that this environment was built with
    :return: None, or why the episode has to be started again
    """
    if state["content"] is None:
        return state["why"]
    monitors = _monitors(env)
    context = Restore(state["arrays"], _known(monitors), with_files=with_files, locations=locations)
    for name, owner in _owners(env).items():
        nodes = state["content"]["generators"].get(name, {})
        context.restore_attributes(nodes, owner, name, optional=True)
    for monitor, attributes in zip(monitors, state["content"]["monitors"], strict=False):
        context.restore_attributes(attributes, monitor, "Monitor", optional=True)
    if state["why"] is not None:
        return state["why"]
    try:
        context.restore(state["content"]["whole"], [env, *(monitor.env for monitor in monitors)], "env")
    except Exception as error:
        return str(error) if isinstance(error, NotRestoredError) else f"{type(error).__name__}: {error}"
    return next(iter(context.not_restored), None)


def _monitors(env: gym.Env) -> list[Monitor]:
    return [layer for layer in _layers(env) if isinstance(layer, Monitor)]


def _layers(env: gym.Env) -> list[gym.Env]:
    layers = [env]
    while isinstance(layers[-1], gym.Wrapper):
        layers.append(layers[-1].env)
    return layers


def _known(monitors: list[Monitor]) -> dict[str, Any]:
    return {f"monitor {i}": monitor for i, monitor in enumerate(monitors)}


def _without_env(monitor: Monitor) -> dict[str, Any]:
    return {name: value for name, value in attributes_of(monitor).items() if name != "env"}


def _owners(env: gym.Env) -> dict[str, Any]:
    """:return: what has generators: an environment, its wrappers, and their spaces"""
    layers = {f"env{'.env' * i}": layer for i, layer in enumerate(_layers(env))}
    spaces = ("action_space", "observation_space")
    parts = {f"{name}.{space}": vars(layer).get(space) for name, layer in layers.items() for space in spaces}
    return {name: owner for name, owner in (layers | parts).items() if owner is not None}


# ---------------------------------------------------------------- MuJoCo


def is_mujoco(name: str) -> Any:
    """:return: whether a value is one of MuJoCo's of this name"""
    return lambda value: type(value).__name__ == name and type(value).__module__.startswith("mujoco")


def _model_bytes(model: Any) -> bytes:
    return model.__getstate__()


def capture_mj_data(data: Any) -> dict[str, Any]:
    """MuJoCo's own bytes of the whole ``MjData``, without the model that it puts among them."""
    whole, model = data.__getstate__(), _model_bytes(data.model)
    before, found, after = whole.partition(model)
    if not found:
        raise NotCapturedError("MuJoCo's bytes of an MjData do not contain its model")
    return {"before": before, "after": after, "model": hashlib.sha256(model).hexdigest()}


def restore_mj_data(existing: Any, state: dict[str, Any]) -> Any:
    """Give an ``MjData`` that is there its state, if it is of the same model; return it, or another with this state."""
    import mujoco

    model = _model_bytes(existing_as(mujoco.MjData, existing, "MjData").model)
    if hashlib.sha256(model).hexdigest() != state["model"]:
        raise NotRestoredError("the environment has another MuJoCo model now, or has changed its model")
    source = mujoco.MjData.__new__(mujoco.MjData)
    source.__setstate__(state["before"] + model + state["after"])
    if not hasattr(mujoco, "mj_copyData"):  # MuJoCo's older bindings cannot write into the one that is there
        return source
    mujoco.mj_copyData(existing, existing.model, source)
    return existing


def restore_mj_model(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """:return: what is there"""
    import mujoco

    return existing_as(mujoco.MjModel, existing, path)


# ---------------------------------------------------------------- vectorised environments


def is_vec_env(value: Any) -> bool:
    """Whether it has the environments."""
    return isinstance(value, (DummyVecEnv, SubprocVecEnv))


def capture_vec_env(context: Capture, env: Any, path: str) -> Any:
    """:return: every environment, in this process or its own"""
    if isinstance(env, DummyVecEnv):
        states = [capture_env(single) for single in env.envs]
    elif env.has_attr("capture_state"):
        states = env.env_method("capture_state")
    else:
        why = f"{path} is a SubprocVecEnv: wrap its environments in sb3_tdc.checkpoint.Restorable (wrapper_class)"
        nothing: dict[str, Any] = {
            "why": why,
            "content": None,
            "arrays": [],
            "left_out": [why],
            "shared": {},
            "texts": {},
        }
        states = [nothing] * env.num_envs
    captured = []
    for i, state in enumerate(states):
        context.first_arrays[f"{path}, environment {i}"] = len(context.arrays)
        _tell_what_is_not_covered(context, state, f"{path}, environment {i}")
        numbers = [context.add_array(array) for array in state["arrays"]]
        captured.append({"why": state["why"], "content": state["content"], "arrays": numbers})
    return [captured, context.capture_attributes(_own_attributes(env), path)]


def _tell_what_is_not_covered(context: Capture, state: dict[str, Any], path: str) -> None:
    context.left_out += state["left_out"]
    context.texts |= {f"{path}: {name}": text for name, text in state["texts"].items()}
    context.shared_elsewhere |= {f"{path}: {group}": f"{path}: {paths}" for group, paths in state["shared"].items()}
    if state["why"] is not None:
        return
    whole = context.attributes[path] = state["content"]["whole"]
    if context.initial is not None:
        missing = uncovered(whole, context.initial.attributes.get(path), path)
        context.left_out += [f"{why}: its episode will begin again" for why in missing]


def restore_vec_env(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Give every environment its state, and note those whose episode has to start again."""
    env = existing_as((DummyVecEnv, SubprocVecEnv), existing, path)
    captured, attributes = content
    if len(captured) != env.num_envs:
        raise NotRestoredError(f"{path} had {len(captured)} environments, and has {env.num_envs}")
    states = [{**state, "arrays": [context.array(number) for number in state["arrays"]]} for state in captured]
    built = [context.locations.below(f"{path}, environment {i}: ") for i in range(len(states))]
    arguments = [(state, context.with_files, locations) for state, locations in zip(states, built, strict=True)]
    if isinstance(env, DummyVecEnv):
        whys = [restore_env(single, *each) for single, each in zip(env.envs, arguments, strict=True)]
    elif env.has_attr("restore_state"):
        whys = [env.env_method("restore_state", *each, indices=i)[0] for i, each in enumerate(arguments)]
    else:
        whys = [state["why"] or "there is no sb3_tdc.checkpoint.Restorable around it" for state in states]
    context.restarted += [f"{path}, environment {i}: {why}" for i, why in enumerate(whys) if why is not None]
    context.restore_attributes(attributes, env, path)
    return existing


def is_event_files(value: Any) -> bool:
    """Whether it writes event files."""
    return isinstance(value, TensorBoardOutputFormat)


def capture_output(context: Capture, value: TensorBoardOutputFormat, path: str) -> Any:
    """:return: how far its files go"""
    return context.capture(capture_event_files(value), path)


def restore_output(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Cut event files to what they were."""
    output = existing_as(TensorBoardOutputFormat, existing, path)
    state = context.restore(content, MISSING, path)
    if context.with_files:
        restore_event_files(output, state, context.step, context.locations)
    return output


def _own_attributes(env: VecEnv) -> dict[str, Any]:
    """What else there is is overwritten by every step."""
    names = ("observation_space", "action_space", "_seeds", "_options")
    return {name: vars(env)[name] for name in names}
