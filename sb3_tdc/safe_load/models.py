"""Safe reader for saved models."""

import importlib
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_tdc.common.untrusted import shown
from sb3_tdc.safe_load.archives import MAX_BYTES, MODEL_ENTRIES, read_archive
from sb3_tdc.safe_load.budget import Budget, UnsafeFileError
from sb3_tdc.safe_load.fields import (
    TEMPERATURE,
    check_noise,
    check_replay_memory,
    foreign_names,
    known_policies,
    parse_data,
    read_fields,
)
from sb3_tdc.safe_load.reading import reading
from sb3_tdc.safe_load.regular_files import open_regular
from sb3_tdc.safe_load.weights import check_optimizer, check_weights, read_tensors


def load_safely(
    path: str | Path,
    env: GymEnv | None = None,
    device: th.device | str = "auto",
    custom_objects: dict[str, Any] | None = None,
    algorithm: type[OffPolicyAlgorithm] | None = None,
    **kwargs: Any,
) -> OffPolicyAlgorithm:
    """
    Load a saved model as ``Algorithm.load`` does, without running anything that is in the file.

    The model may be one of TDC, MEOW, AdvB-TD3, AdvB-SAC and AdvB-TDC, SB3's TD3, SAC and DDPG, or sb3-contrib's TQC.

    The returned model predicts and continues to learn like the saved one, with three differences. ``tensorboard_log``
    is never the file's. The last observation and the statistics of the last episodes are not kept (an environment is
    reset when learning begins). A custom schedule or class is refused unless ``custom_objects`` replaces it.

    :param path: zip of a saved model, with or without its suffix
    :param env: the environment to run the model on; None if the model only predicts
    :param device: PyTorch device
    :param custom_objects: values by field name that replace those of the file, which are then not used
    :param algorithm: the class of the returned model; None for the algorithm that the file's policy belongs to (TD3 for
        a DDPG, which has the same policies). Required for a variant of TDC
    :param kwargs: attributes that replace those of the file, for instance ``buffer_size=1``
    :raises UnsafeFileError: (a ``ValueError``) if the file is refused or damaged, in one sentence that names the field
    :raises ValueError: if the file is of another algorithm, or of an environment with other spaces
    """
    path = Path(path)
    if not path.exists() and path.with_name(f"{path.name}.zip").is_file():
        path = path.with_name(f"{path.name}.zip")
    # The first optimizer imports it, which takes seconds where Python has not compiled it yet: not the file's cost
    importlib.import_module("torch._dynamo")
    with reading(f"{path} was not opened"):
        entries, budget = _read_entries(path)
        given = {**kwargs, **(custom_objects or {})}
        data = parse_data(entries["data"])
        fields, algorithm = read_fields(data, given, budget, algorithm)
        new_temperature = "ent_coef" in given and given["ent_coef"] != data.get("ent_coef")
        fields.update({name: given[name] for name in kwargs})
        policy_class: Any = fields.pop("policy_class")
        tensors = {}
        for name in (name for name in entries if name.endswith(".pth")):
            with reading(name):
                tensors[name.removesuffix(".pth")] = read_tensors(entries[name], budget)

    if env is not None:
        env = algorithm._wrap_env(env, fields.get("verbose", 0))
        for name in ("observation_space", "action_space"):
            fields.setdefault(name, getattr(env, name))
        check_for_correct_spaces(env, fields["observation_space"], fields["action_space"])
        fields["n_envs"] = env.num_envs
    with reading(f"{path} was not opened"):
        for name in ("observation_space", "action_space"):
            if name not in fields:
                raise UnsafeFileError(f"it has no {name}: give env")
        check_replay_memory(fields)
        if "action_noise" not in given:
            check_noise(fields, budget)
        check_weights(policy_class, fields, tensors["policy"], budget)
        return _make_model(algorithm, policy_class, env, device, fields, tensors, new_temperature)


def read_model_fields(path: Path, algorithm: type[OffPolicyAlgorithm] | None = None) -> dict[str, Any]:
    """
    Read and check the fields of a saved model as :func:`load_safely` does, but not its weights.

    :raises UnsafeFileError: as :func:`load_safely`
    """
    with reading(f"{path} was not opened"):
        entries, budget = _read_entries(path)
        fields, _ = read_fields(parse_data(entries["data"]), {}, budget, algorithm)
        return fields


def _read_entries(path: Path) -> tuple[dict[str, bytes], Budget]:
    """Return the entries of a saved model, and the budget for what is read from them."""
    known_policies()  # imports sb3-contrib, which is not the file's cost
    with open_regular(path, MAX_BYTES) as (file, size):
        budget = Budget(size)
        entries = read_archive(file, MODEL_ENTRIES, budget)
    for required in ("data", "policy.pth"):
        if required not in entries:
            raise UnsafeFileError(f"it is not the zip of a saved model, it has no {required}")
    return entries, budget


def read_data(path: str | Path) -> dict[str, Any]:
    """
    Read the fields of a saved model as JSON.

    :return: the JSON of a saved model, unchanged: nothing in it is checked, rebuilt or run
    :raises UnsafeFileError: if it is not the zip of a saved model
    """
    with reading(f"{path} is not the zip of a saved model"):
        return parse_data(_read_entry(path, "data"))


def read_system_info(path: str | Path) -> str:
    """
    Read SB3's description of the system that a model was saved on.

    :return: lines of text
    :raises UnsafeFileError: if it is not the zip of a saved model
    """
    with reading(f"{path} is not the zip of a saved model"):
        return _read_entry(path, "system_info.txt").decode()


def _read_entry(path: str | Path, name: str) -> bytes:
    with open_regular(path, MAX_BYTES) as (file, size):
        entries = read_archive(file, MODEL_ENTRIES, Budget(size), only=name)
    if name not in entries:
        raise UnsafeFileError(f"it has no {name}")
    return entries[name]


def names_code(path: str | Path) -> bool:
    """
    Return whether SB3's ``load`` would run code for a field of a saved model.

    :raises UnsafeFileError: if it is not the zip of a saved model
    """
    with reading(f"{path} is not the zip of a saved model"):
        budget = Budget(Path(path).stat().st_size)
        return any(foreign_names(value, budget) for value in read_data(path).values())


def _make_model(
    algorithm: type[OffPolicyAlgorithm],
    policy_class: type[BasePolicy],
    env: VecEnv | None,
    device: th.device | str,
    fields: dict[str, Any],
    tensors: dict[str, Any],
    new_temperature: bool,
) -> OffPolicyAlgorithm:
    model: Any = algorithm(policy_class, env, device=device, _init_setup_model=False)  # type: ignore[arg-type,call-arg]
    vars(model).update(fields)
    model._setup_model()
    state_dicts, variables = model._get_torch_save_params()
    saved_variables = _variables(tensors)
    if new_temperature:
        saved_variables = {name: value for name, value in saved_variables.items() if name not in TEMPERATURE}
        tensors = {name: value for name, value in tensors.items() if name not in TEMPERATURE}
        tensors |= {name: getattr(model, name).state_dict() for name in state_dicts if name in TEMPERATURE}
    for name in state_dicts:
        if name.endswith("optimizer"):
            with reading(f"{name}.pth"):
                optimizer = model
                for attribute in name.split("."):
                    optimizer = getattr(optimizer, attribute)
                check_optimizer(optimizer, tensors[name])
    model.set_parameters(tensors, exact_match=True, device=device)
    if not new_temperature and (missing := [name for name in variables if saved_variables.get(name) is None]):
        raise UnsafeFileError(f"pytorch_variables.pth: {missing[0]} is missing")
    for name, value in saved_variables.items():
        with reading(f"pytorch_variables.pth, {shown(name)}"):
            if name not in variables:
                if value is None:  # SB3 writes None for a variable that the model lacks
                    continue
                raise UnsafeFileError("it is unknown")
            current = getattr(model, name)
            if value.shape != current.shape or value.dtype != current.dtype or not value.isfinite().all():
                raise UnsafeFileError("it is of another shape or type, or not finite")
            current.data = value.data.to(current.device)
    if model.use_sde:
        model.policy.reset_noise()
    return model


def _variables(tensors: dict[str, Any]) -> dict[str, Any]:
    """Remove and return the single tensors among the parts of a zip; early SB3 versions call them ``tensors.pth``."""
    found: dict[str, Any] = {}
    for part in ("tensors", "pytorch_variables"):
        values = tensors.pop(part, None) or {}
        with reading(f"{part}.pth"):
            if not isinstance(values, dict) or not all(isinstance(v, th.Tensor | None) for v in values.values()):
                raise UnsafeFileError("it does not hold tensors by name")
        found |= values
    return found
