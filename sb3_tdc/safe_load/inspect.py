"""Description of a saved file: its contents, the code in it, and whether it would be opened."""

import contextlib
import io
import mmap
import warnings
import zipfile
from pathlib import Path
from typing import Any

import gymnasium as gym
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize
from stable_baselines3.her import HerReplayBuffer

from sb3_tdc.common.untrusted import escaped
from sb3_tdc.safe_load.archives import MAX_BYTES, MODEL_ENTRIES, read_archive
from sb3_tdc.safe_load.budget import Budget
from sb3_tdc.safe_load.fields import MAX_REPLAY_BYTES, foreign_names, on_the_command_line, parse_data
from sb3_tdc.safe_load.inert_pickle import Call, Name, code_in, read_pickle
from sb3_tdc.safe_load.known_objects import CLASSES, TAKEN, pickled_name
from sb3_tdc.safe_load.models import load_safely, read_model_fields
from sb3_tdc.safe_load.reading import reading
from sb3_tdc.safe_load.regular_files import open_regular

_SHOWN = 12  # most lines of each list


_PICKLED = {
    pickled_name(kind) for kind in (VecNormalize, ReplayBuffer, DictReplayBuffer, NStepReplayBuffer, HerReplayBuffer)
}


def inspect(path: Path, algorithm: type[OffPolicyAlgorithm] | None = None) -> tuple[list[str], bool]:
    """
    Describe a file without running, importing or unpickling anything in it.

    :param path: the zip of a model, ``VecNormalize`` statistics or a replay buffer
    :param algorithm: the algorithm of a model; None for the one that its policy belongs to
    :return: lines for the screen, and whether the file would be opened
    :raises ValueError: if the file cannot be read as one of these
    """
    with reading(str(path)), open_regular(path, MAX_REPLAY_BYTES) as (file, size):
        if zipfile.is_zipfile(file):
            lines = _describe_model(path, size)
        else:
            return _describe_pickle(path, size)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            env = _stand_in(path, algorithm)
            model = load_safely(path, env, device="cpu", algorithm=algorithm, buffer_size=1)
    except ValueError as error:
        reason = on_the_command_line(str(error).removeprefix(f"{path} was not opened: "))
        return [*lines, f"Refused: {escaped(reason)}"], False
    return [*lines, f"Would be opened as a {type(model).__name__} of {model.num_timesteps:,} steps."], True


class _StandIn(gym.Env):
    """
    Environment that only has spaces and is never stepped.

    :param fields: the fields of a model, including its spaces
    """

    def __init__(self, fields: dict[str, Any]):
        self.observation_space, self.action_space = fields["observation_space"], fields["action_space"]


def _stand_in(path: Path, algorithm: type[OffPolicyAlgorithm] | None) -> VecEnv | None:
    """
    Return a stand-in environment for a model with a hindsight buffer, which cannot be opened without one.

    :return: the environment; None for all other models
    :raises ValueError: if the model is refused
    """
    fields = read_model_fields(path, algorithm)
    is_of_hindsight = fields.get("replay_buffer_class") is HerReplayBuffer
    return DummyVecEnv([lambda: _StandIn(fields)]) if is_of_hindsight and "action_space" in fields else None


def _describe_model(path: Path, size: int) -> list[str]:
    budget = Budget(size)
    with open_regular(path, MAX_BYTES) as (file, _):
        entries = read_archive(file, MODEL_ENTRIES, budget)
    lines = [f"{escaped(str(path))}: the zip of a model, {size:,} bytes", "Entries:"]
    lines += [f"  {name:28} {len(content):12,} bytes" for name, content in sorted(entries.items())]
    if "data" in entries:
        data = parse_data(entries["data"])
        code = {name: foreign_names(value, budget) for name, value in data.items()}
        lines += [f"Fields: {len(data)}", *_list_code({name: found for name, found in code.items() if found})]
    return lines


def _list_code(code: dict[str, list[str]]) -> list[str]:
    if not code:
        return ["Code: none that SB3's own load would import, except for what it always imports."]
    lines = [
        f"  {escaped(name):28} {', '.join(found[:3])}{' …' if len(found) > 3 else ''}" for name, found in code.items()
    ]
    return ["Code that SB3's own load would import or run:", *lines[:_SHOWN], *(["  …"] if len(lines) > _SHOWN else [])]


def _describe_pickle(path: Path, size: int) -> tuple[list[str], bool]:
    with open_regular(path, MAX_REPLAY_BYTES) as (file, _):
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            noted: list[Name | Call] = []
            value = read_pickle(content, Budget(size), noted)  # type: ignore[arg-type]  # it reads like a file
    kind = str(value.function) if isinstance(value, Call) else f"a {type(value).__name__}"
    is_known = isinstance(value, Call) and value.function in _PICKLED
    foreign = code_in(noted, CLASSES, {**dict.fromkeys(_PICKLED, lambda call: call.args == ()), **TAKEN})
    verdict = (
        "Would be read as data, if it fits the environment." if is_known else f"Refused: {kind} is not known here."
    )
    lines = [f"{escaped(str(path))}: a pickle of {kind}, {size:,} bytes", "Names in it that are not used here:"]
    return [*lines, *(f"  {name}" for name in foreign[:_SHOWN] or ["none"]), verdict], is_known
