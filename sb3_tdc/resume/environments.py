"""Capture of vectorised environments, and of each environment with all of its wrappers, in the middle of an episode."""

from typing import Any

import gymnasium as gym
from stable_baselines3.common.logger import TensorBoardOutputFormat
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecEnvWrapper

from sb3_tdc.common.words import count
from sb3_tdc.resume.event_files import capture_event_files, restore_event_files
from sb3_tdc.resume.kinds.generators import GENERATORS
from sb3_tdc.resume.kinds.objects import claim, uses_native_package
from sb3_tdc.resume.locations import Locations
from sb3_tdc.resume.walk import (
    MISSING,
    Capture,
    Kinds,
    NotRestoredError,
    Restore,
    attributes_of,
    existing_as,
    name_of,
    uncovered,
)


def capture_env(kinds: Kinds, env: gym.Env) -> dict[str, Any]:
    """
    Capture one environment with all of its wrappers.

    :return: a dict of plain values and arrays. Generators and the ``Monitor`` are captured separately, so that they
        continue even if the rest does not; then the whole environment, or the reason why it cannot be captured
    """
    monitors = _monitors(env)
    context = Capture(kinds, _known(monitors))
    content: dict[str, Any] = {
        "generators": _capture_generators(context, _owners(env)),
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


def restore_env(
    kinds: Kinds, env: gym.Env, state: dict[str, Any], with_files: bool, locations: Locations
) -> str | None:
    """
    Restore one environment from the result of :func:`capture_env`.

    :param with_files: restore files, too
    :param locations: the locations of the run's files, with the texts that this environment was built with
    :return: None, or the reason why the episode must start again
    """
    if state["content"] is None:
        return state["why"]
    monitors = _monitors(env)
    context = Restore(kinds, state["arrays"], _known(monitors), with_files=with_files, locations=locations)
    _restore_generators(context, state["content"]["generators"], _owners(env))
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
    """Return the objects that may hold generators: an environment, its wrappers, and their spaces."""
    layers = {f"env{'.env' * i}": layer for i, layer in enumerate(_layers(env))}
    spaces = ("action_space", "observation_space")
    parts = {f"{name}.{space}": vars(layer).get(space) for name, layer in layers.items() for space in spaces}
    return {name: owner for name, owner in (layers | parts).items() if owner is not None}


def _capture_generators(context: Capture, owners: dict[str, Any]) -> dict[str, Any]:
    generators = {
        name: {a: value for a, value in attributes_of(owner).items() if isinstance(value, GENERATORS)}
        for name, owner in owners.items()
    }
    return {name: context.capture_attributes(each, name, optional=True) for name, each in generators.items() if each}


def _restore_generators(context: Restore, captured: dict[str, Any], owners: dict[str, Any]) -> None:
    for name, owner in owners.items():
        context.restore_attributes(captured.get(name, {}), owner, name, optional=True)


# ---------------------------------------------------------------- vectorised environments


def is_vec_env(value: Any) -> bool:
    """Return whether a value is a vectorised environment whose environments are captured one by one."""
    return isinstance(value, (DummyVecEnv, SubprocVecEnv))


def capture_vec_env(context: Capture, env: Any, path: str) -> Any:
    """Return the state of every environment, captured in the process that runs it, and ``env``'s own attributes."""
    if isinstance(env, DummyVecEnv):
        states = [capture_env(context.kinds, single) for single in env.envs]
    elif env.has_attr("capture_state"):
        states = env.env_method("capture_state")
    else:
        why = f"{path} is a SubprocVecEnv: wrap its environments in sb3_tdc.resume.Restorable (wrapper_class)"
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
    return [captured, context.capture_attributes(_own_attributes(env), path, optional=True)]


def _tell_what_is_not_covered(context: Capture, state: dict[str, Any], path: str) -> None:
    context.left_out += [f"{path}: {why}" for why in state["left_out"]]
    context.texts |= {f"{path}: {name}": text for name, text in state["texts"].items()}
    context.shared_elsewhere |= {f"{path}: {group}": f"{path}: {paths}" for group, paths in state["shared"].items()}
    if state["why"] is not None:
        return
    whole = context.attributes[path] = state["content"]["whole"]
    if context.initial is not None:
        missing = uncovered(context.kinds, whole, context.initial.attributes.get(path), path)
        context.left_out += [f"{why}: its episode will begin again" for why in missing]


def restore_vec_env(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Restore the state of every environment, and note the environments whose episodes must start again."""
    env = existing_as((DummyVecEnv, SubprocVecEnv), existing, path)
    captured, attributes = content
    if len(captured) != env.num_envs:
        raise NotRestoredError(f"{path} had {count(len(captured), 'environment')}, and has {env.num_envs}")
    states = [{**state, "arrays": [context.array(number) for number in state["arrays"]]} for state in captured]
    built = [context.locations.below(f"{path}, environment {i}: ") for i in range(len(states))]
    arguments = [(state, context.with_files, locations) for state, locations in zip(states, built, strict=True)]
    if isinstance(env, DummyVecEnv):
        whys = [restore_env(context.kinds, single, *each) for single, each in zip(env.envs, arguments, strict=True)]
    elif env.has_attr("restore_state"):
        whys = [env.env_method("restore_state", *each, indices=i)[0] for i, each in enumerate(arguments)]
    else:
        whys = [state["why"] or "there is no sb3_tdc.resume.Restorable around it" for state in states]
    context.restarted += [f"{path}, environment {i}: {why}" for i, why in enumerate(whys) if why is not None]
    context.restore_attributes(attributes, env, path, optional=True)
    return existing


def _own_attributes(env: VecEnv) -> dict[str, Any]:
    """Return the attributes of a vectorised environment that are captured; every step overwrites the others."""
    names = ("observation_space", "action_space", "_seeds", "_options")
    return {name: vars(env)[name] for name in names}


# ---------------------------------------------------------------- vectorised environments captured as one object


def is_other_vec_env(value: Any) -> bool:
    """Return whether a value is a vectorised environment whose environments cannot be captured one by one."""
    return isinstance(value, VecEnv) and not isinstance(value, (DummyVecEnv, SubprocVecEnv, VecEnvWrapper))


def capture_other_vec_env(context: Capture, env: Any, path: str) -> Any:
    """
    Return the class, the generators, and all attributes or the reason why they are not captured.

    The generators are captured separately, so that they continue even if the rest does not.
    """
    generators = _capture_generators(context, _inside(env, path))
    n_left_out, mark = len(context.left_out), context.mark()
    attributes: dict[str, Any] = {}
    if package := uses_native_package(type(env)):
        context.left_out.append(f"{path} is a {name_of(type(env))}, which uses {package}")
    else:
        attributes = context.capture_attributes(attributes_of(env), path, optional=True)
    why = next(iter(context.left_out[n_left_out:]), None)
    if why is not None:  # handles restored without the native objects they refer to would do harm
        context.return_to(mark)
        attributes = {}
    return {"class": name_of(type(env)), "generators": generators, "attributes": attributes, "why": why}


def restore_other_vec_env(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Restore the state of vectorised environments, or note why their episodes must start again."""
    claim(context, content["class"], existing, path)
    context.begin(existing)
    _restore_generators(context, content["generators"], _inside(existing, path))
    why = content["why"]
    if why is None:
        n_noted = len(context.not_restored)
        context.restore_attributes(content["attributes"], existing, path, optional=True)
        why = next(iter(context.not_restored[n_noted:]), None)
        del context.not_restored[n_noted:]
        for extra in set(attributes_of(existing)) - set(content["attributes"]):
            delattr(existing, extra)
    if why is not None:
        context.restarted.append(why)
    return existing


def _inside(env: VecEnv, path: str) -> dict[str, Any]:
    """Return a vectorised environment, the environments in it, and all of their spaces, by path."""
    found: list[tuple[str, Any]] = [(path, env)]
    seen = {id(env)}
    for place, part in found:  # grows in the loop
        for name, value in attributes_of(part).items():
            items = enumerate(value) if isinstance(value, (list, tuple)) else [(None, value)]
            for i, item in items:
                if isinstance(item, (gym.Env, gym.vector.VectorEnv, gym.Space)) and id(item) not in seen:
                    seen.add(id(item))
                    found.append((f"{place}.{name}" if i is None else f"{place}.{name}[{i}]", item))
    return dict(found)


# ---------------------------------------------------------------- event files


def is_event_files(value: Any) -> bool:
    """Return whether a value writes TensorBoard's event files."""
    return isinstance(value, TensorBoardOutputFormat)


def capture_output(context: Capture, value: TensorBoardOutputFormat, path: str) -> Any:
    """Return the folder and the sizes of the event files."""
    return context.capture(capture_event_files(value), path)


def restore_output(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Cut event files to their captured sizes."""
    output = existing_as(TensorBoardOutputFormat, existing, path)
    state = context.restore(content, MISSING, path)
    if context.with_files:
        restore_event_files(output, state, context.step, context.locations)
    return output
