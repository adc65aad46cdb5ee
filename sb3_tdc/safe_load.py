"""
Open saved models of others: nothing in the file is imported, called or unpickled.

SB3's ``load`` runs whatever a zip asks for, and so do its replay buffers and ``VecNormalize`` files. Here every pickled
field is read as data, recognised by name and rebuilt from known classes, or refused by name; sizes are bounded before
anything is decompressed or allocated. What that covers, and what not: docs/safety.md.
"""

import base64
import io
import json
import math
import mmap
import re
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.type_aliases import GymEnv, TrainFreq
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from stable_baselines3.her import HerReplayBuffer

from sb3_tdc.hyperparams import POLICY_ARGUMENTS, constructor_hints
from sb3_tdc.inert_pickle import PERSISTENT, Call, Name, Rebuild, UnsafeFileError, read_pickle, rebuild
from sb3_tdc.known_objects import CALLS, CLASSES, name_of
from sb3_tdc.tdc import TDC
from sb3_tdc.tdc.checks import check_integer, check_number

MAX_BYTES = 2**30  # of a file, and of what it decompresses to
MAX_RATIO = 100  # of decompressed to compressed; SB3 itself does not compress
MAX_DIRECTORY = 2**20  # bytes of a zip's list of entries
MAX_REPLAY_BYTES = 2**36  # of the replay buffer that a loaded model gets
MAX_LAYERS = 64
MAX_CRITICS = 256
MAX_ENVS = 10_000


def load_safely(
    path: str | Path,
    env: GymEnv | None = None,
    device: th.device | str = "auto",
    custom_objects: dict[str, Any] | None = None,
    algorithm: type[OffPolicyAlgorithm] | None = None,
    **kwargs: Any,
) -> OffPolicyAlgorithm:
    """
    What ``Algorithm.load`` does for TDC, TD3, SAC, DDPG and TQC, without running anything that is in the file.

    The model predicts and goes on learning as the saved one. It differs in this: ``tensorboard_log`` is never the
    file's, the last observation and the statistics of the last episodes are not kept (an environment is reset when
    learning begins), and a schedule or a class of your own is refused unless ``custom_objects`` replaces it.

    :param path: zip of a saved model, with or without its suffix
    :param env: the environment to run it on; None to only predict
    :param device: PyTorch device
    :param custom_objects: what to take for fields of the file, by name, which are then not looked at
    :param algorithm: the class to make; None: by the file's policy (for DDPG, which has TD3's policies, TD3)
    :param kwargs: attributes to set over the file's, for instance ``buffer_size=1``
    :raises UnsafeFileError: (a ``ValueError``) if the file is refused or damaged, in one sentence that names the field
    :raises ValueError: if it is of another algorithm, or of an environment with other spaces
    """
    path = Path(path)
    if not path.exists() and path.with_name(f"{path.name}.zip").is_file():
        path = path.with_name(f"{path.name}.zip")
    with _reading(f"{path} was not opened"):
        with path.open("rb") as file:
            entries = _read_archive(file, _MODEL_ENTRIES)
        for required in ("data", "policy.pth"):
            if required not in entries:
                raise UnsafeFileError(f"it is not the zip of a saved model, it has no {required}")
        fields = _read_fields(entries["data"], {**kwargs, **(custom_objects or {})})
        policy_class = fields.pop("policy_class", None)
        saved_by = _policies().get(policy_class) or _nearest(policy_class)
        fields.update(kwargs)
        if saved_by is None:
            raise UnsafeFileError("it has no policy_class of TDC, TD3, SAC, DDPG or TQC")
        if algorithm is not None and not issubclass(algorithm, saved_by):
            raise UnsafeFileError(f"it was saved by {saved_by.__name__}, not by {algorithm.__name__}")
        algorithm = algorithm or saved_by
        tensors = {}
        for name in (name for name in entries if name.endswith(".pth")):
            with _reading(name):
                tensors[name.removesuffix(".pth")] = _read_tensors(entries[name], device)

    if env is not None:
        env = algorithm._wrap_env(env, fields.get("verbose", 0))
        for name in ("observation_space", "action_space"):
            fields.setdefault(name, getattr(env, name))
        check_for_correct_spaces(env, fields["observation_space"], fields["action_space"])
        fields["n_envs"] = env.num_envs
    with _reading(f"{path} was not opened"):
        for name in ("observation_space", "action_space"):
            if name not in fields:
                raise UnsafeFileError(f"it has no {name}: give env")
        _check_replay_memory(fields)
        _check_weights(policy_class, fields, tensors["policy"])
        return _make_model(algorithm, policy_class, env, device, fields, tensors)


def read_data(path: str | Path) -> dict[str, Any]:
    """
    :return: the JSON of a saved model, as it stands there: nothing in it is checked, rebuilt or run
    :raises UnsafeFileError: if it is not the zip of a saved model
    """
    with _reading(f"{path} is not the zip of a saved model"):
        with Path(path).open("rb") as file:
            return _parse_data(_read_archive(file, _MODEL_ENTRIES)["data"])


def load_normalization(path: str | Path, env: VecEnv) -> VecNormalize:
    """
    What ``VecNormalize.load`` does, without running anything that is in the file.

    :param path: statistics as SB3 and RL Zoo save them (``vecnormalize.pkl``)
    :param env: the environment to normalise
    :raises UnsafeFileError: if the file is refused or damaged, or is of other observations
    """
    with _reading(f"{path} was not opened"):
        state = _read_object(path, VecNormalize, _normalization_state)
        statistics = {name: state.pop(name) for name in ("obs_rms", "ret_rms")}
        normalized = VecNormalize(env, **state)
        for name, saved in statistics.items():
            fresh = getattr(normalized, name, None)
            if not _same_layout(saved, fresh):
                raise UnsafeFileError(f"its {name} are not those of {env.observation_space}")
            setattr(normalized, name, saved)
        return normalized


def load_replay_buffer(path: str | Path, model: OffPolicyAlgorithm) -> None:
    """
    What ``model.load_replay_buffer`` does, without running anything that is in the file.

    :param path: a replay buffer as SB3 saves it, of the same class, size and number of environments as the model's
    :raises UnsafeFileError: if the file is refused or damaged, or is not such a replay buffer
    """
    buffer = model.replay_buffer
    assert buffer is not None
    with _reading(f"{path} was not opened"):
        saved = _read_object(path, type(buffer), _arrays_like(buffer))
        if saved["n_envs"] != buffer.n_envs:
            raise UnsafeFileError(f"it is of {saved['n_envs']} environments, this run has {buffer.n_envs}")
        for name, fresh in vars(buffer).items():
            if name in saved and not _same_layout(saved[name], fresh):
                raise UnsafeFileError(f"its {name} are not those of this run (buffer_size, observations, actions)")
        if not 0 <= saved["pos"] < buffer.buffer_size:
            raise UnsafeFileError(f"its position, {saved['pos']}, is outside")
        vars(buffer).update(saved)
        if isinstance(buffer, HerReplayBuffer):
            buffer.truncate_last_trajectory()


@contextmanager
def _reading(what: str) -> Iterator[None]:
    """Whatever a damaged file makes a library raise becomes one error of one sentence, with its place before it."""
    try:
        yield
    except Exception as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:300]
        raise UnsafeFileError(f"{what}: {reason}") from error


# -------------------------------------------------------------------- zips

_MODEL_ENTRIES = re.compile(
    r"data|_stable_baselines3_version|system_info\.txt|pytorch_variables\.pth|tensors\.pth|policy\.pth"
    r"|(actor|critic)\.optimizer\.pth|ent_coef_optimizer\.pth"
)
_TENSOR_ENTRIES = re.compile(
    r"[\w.-]+/(data\.pkl|version|byteorder|\.format_version|\.storage_alignment|\.data/serialization_id|data/\d+)"
)


def _read_archive(file: IO[bytes], allowed: re.Pattern) -> dict[str, bytes]:
    """
    :param allowed: what entries may be called
    :return: the bytes of each entry
    :raises UnsafeFileError: for other, repeated, encrypted, oversized or suspiciously compressed entries, unread
    """
    if _directory_size(file) > MAX_DIRECTORY:
        raise UnsafeFileError("it is a zip of too many entries")
    with zipfile.ZipFile(file) as archive:
        entries = archive.infolist()
        names = [entry.filename for entry in entries]
        for entry in entries:
            if not allowed.fullmatch(entry.filename) or names.count(entry.filename) > 1:
                raise UnsafeFileError(f"its entry {entry.filename[:100]!r} is unknown or repeated")
            if entry.flag_bits & 1 or entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise UnsafeFileError(f"its entry {entry.filename!r} is encrypted, or compressed in an unknown way")
            if entry.file_size > MAX_RATIO * max(entry.compress_size, 100):
                raise UnsafeFileError(f"its entry {entry.filename!r} is compressed more than {MAX_RATIO}-fold")
        if sum(entry.file_size for entry in entries) > MAX_BYTES:
            raise UnsafeFileError(f"it holds more than {MAX_BYTES:,} bytes")
        return {entry.filename: archive.read(entry) for entry in entries}


def _directory_size(file: IO[bytes]) -> int:
    """The size of a zip's list of entries, which ``ZipFile`` would read whole; from the records at its end alone."""
    size = file.seek(0, io.SEEK_END)
    if size > MAX_BYTES:
        raise UnsafeFileError(f"it has {size:,} bytes, more than {MAX_BYTES:,}")
    file.seek(max(size - 98, 0))
    tail = file.read().rjust(98, b"\0")
    zip64, locator, end = tail[:56], tail[56:76], tail[76:]
    if end[:4] != b"PK\5\6" or end[20:] != b"\0\0":
        raise UnsafeFileError("it is not a zip, or is truncated")
    if locator[:4] != b"PK\6\7":
        return int.from_bytes(end[12:16], "little")
    if zip64[:4] != b"PK\6\6" or int.from_bytes(locator[8:16], "little") != size - 98:
        raise UnsafeFileError("it is a damaged zip")
    return int.from_bytes(zip64[40:48], "little")


# -------------------------------------------------------------------- weights

_STORAGE_BYTES = {
    "DoubleStorage": 8, "FloatStorage": 4, "HalfStorage": 2, "BFloat16Storage": 2, "LongStorage": 8, "IntStorage": 4,
    "ShortStorage": 2, "CharStorage": 1, "ByteStorage": 1, "BoolStorage": 1,
}  # fmt: skip


def _read_tensors(raw: bytes, device: th.device | str) -> Any:
    """
    Check a ``.pth`` file, tensor by tensor, against the bytes that are there; then ``torch.load`` it.

    :return: what ``torch.save`` was given: numbers, texts and tensors, in dicts, lists and tuples
    """
    entries = _read_archive(io.BytesIO(raw), _TENSOR_ENTRIES)
    records = {name.partition("/")[2]: content for name, content in entries.items()}
    if "data.pkl" not in records or len(records) != len(entries):
        raise UnsafeFileError("it is not a file of tensors")

    def check_tensor(call: Call, make: Rebuild) -> th.Tensor:
        storage, offset, shape, stride = call.args[:4]
        if not isinstance(storage, Call) or storage.function != PERSISTENT or len(storage.args) != 5:
            raise UnsafeFileError("a tensor without its storage")
        kind, key, size = storage.args[1], storage.args[2], storage.args[4]
        item = _STORAGE_BYTES.get(kind.attribute) if isinstance(kind, Name) and kind.module == "torch" else None
        if item is None or type(size) is not int or size * item != len(records.get(f"data/{key}", b"")):
            raise UnsafeFileError("a tensor with other bytes than it says")
        whole = all(type(number) is int and number >= 0 for number in (offset, *shape, *stride))
        contiguous = tuple(math.prod(shape[i + 1 :]) for i in range(len(shape)))
        if not whole or (math.prod(shape) > 1 and stride != contiguous) or offset + math.prod(shape) > size:
            raise UnsafeFileError("a tensor that is larger than its storage")
        return th.empty(0)

    def check_dict(call: Call, make: Rebuild) -> dict:
        if call.args != () or (call.state is not None and set(call.state) != {"_metadata"}):
            raise UnsafeFileError("a mapping with attributes")
        return {key: make(item) for key, item in call.items}

    known = {Name("torch._utils", "_rebuild_tensor_v2"): check_tensor, Name("collections", "OrderedDict"): check_dict}
    rebuild(read_pickle(records["data.pkl"]), {}, known)
    repacked = io.BytesIO()  # so that torch sees the entries that were checked, and no others
    with zipfile.ZipFile(repacked, "w") as archive:
        for name, content in records.items():
            archive.writestr(f"archive/{name}", content)
    repacked.seek(0)
    return th.load(repacked, map_location=th.device("cpu") if device == "auto" else device, weights_only=True)


class _OnMeta:
    """Before a policy class: its networks get shapes, but no memory."""

    device = th.device("meta")


def _check_weights(policy_class: type[BasePolicy], fields: dict[str, Any], weights: Any) -> None:
    """Compare the weights of the file with the networks that its arguments ask for, before these are built."""
    kwargs = {**fields.get("policy_kwargs", {}), "optimizer_class": th.optim.SGD, "optimizer_kwargs": {}}
    if "stochastic_actor" in fields:
        kwargs["stochastic_actor"] = fields["stochastic_actor"]
    shaped: type[Any] = type(policy_class.__name__, (_OnMeta, policy_class), {})
    validates = th.distributions.Distribution._validate_args
    th.distributions.Distribution.set_default_validate_args(False)  # it would look at values, of which there are none
    try:
        with _reading("policy_kwargs"), th.device("meta"):
            policy = shaped(fields["observation_space"], fields["action_space"], lambda _: 1.0, **kwargs)
    finally:
        th.distributions.Distribution.set_default_validate_args(validates)
    expected = {name: tuple(tensor.shape) for name, tensor in policy.state_dict().items()}
    if not isinstance(weights, dict) or not all(isinstance(tensor, th.Tensor) for tensor in weights.values()):
        raise UnsafeFileError("policy.pth: it does not hold weights")
    found = {name: tuple(tensor.shape) for name, tensor in weights.items()}
    for name in [*expected, *found]:
        if expected.get(name) != found.get(name):
            raise UnsafeFileError(
                f"policy.pth: {str(name)[:100]} is {found.get(name, 'missing')}, but the environment and policy_kwargs "
                f"make it {expected.get(name, 'nothing')}"
            )
    for name, tensor in weights.items():
        if not tensor.isfinite().all():
            raise UnsafeFileError(f"policy.pth: {name} has values that are not finite")


_OF_THE_SHAPE_OF_ITS_PARAMETER = {
    "exp_avg", "exp_avg_sq", "max_exp_avg_sq", "exp_inf", "square_avg", "grad_avg", "momentum_buffer",
}  # fmt: skip
_OF_ONE_NUMBER = {"step", "mu_product"}


def _check_optimizer(optimizer: th.optim.Optimizer, saved: Any) -> None:
    """:raises UnsafeFileError: unless the saved state is that of this optimizer's parameters"""
    groups = saved["param_groups"]
    if set(saved) != {"state", "param_groups"} or len(groups) != len(optimizer.param_groups):
        raise UnsafeFileError("it is not the state of this optimizer")
    parameters: list[th.Tensor] = []
    for group, fresh in zip(groups, optimizer.param_groups, strict=True):
        first, n = len(parameters), len(fresh["params"])
        if group["params"] != list(range(first, first + n)):
            raise UnsafeFileError("it is of other parameters")
        parameters += fresh["params"]
        for name, value in group.items():
            if name != "params" and (name not in fresh or not _is_plain(value)):
                raise UnsafeFileError(f"its {str(name)[:100]!r} is unknown, or is not a finite number")
    for index, state in saved["state"].items():
        for name, value in state.items():
            shape = parameters[index].shape
            fits = (name in _OF_THE_SHAPE_OF_ITS_PARAMETER and value.shape == shape) or (
                name in _OF_ONE_NUMBER and (not isinstance(value, th.Tensor) or value.numel() == 1)
            )
            if value is not None and not fits:
                raise UnsafeFileError(f"its {str(name)[:100]!r} of parameter {index} is unknown, or of another shape")


def _is_plain(value: Any, depth: int = 0) -> bool:
    """Whether a value is of finite numbers, texts, booleans, None and classes, in short lists and mappings."""
    if isinstance(value, (bool, str, type, type(None))):
        return True
    if isinstance(value, (int, float)):
        return math.isfinite(value) and abs(value) < 2**63
    if isinstance(value, dict):
        return _is_plain([*value, *value.values()], depth)
    if isinstance(value, (list, tuple)):
        return depth < 4 and len(value) <= MAX_LAYERS and all(_is_plain(item, depth + 1) for item in value)
    return False


# -------------------------------------------------------------------- fields


def _policies() -> dict[Any, type[OffPolicyAlgorithm]]:
    """The known policy classes, and the algorithm of each."""
    algorithms: list[type[OffPolicyAlgorithm]] = [TDC, TD3, SAC]
    with suppress(ImportError):  # contrib is an extra
        from sb3_contrib import TQC

        algorithms.append(TQC)
    return {policy: algorithm for algorithm in algorithms for policy in algorithm.policy_aliases.values()}


def _nearest(policy_class: Any) -> type[OffPolicyAlgorithm] | None:
    """The algorithm of a policy of the caller's own, which custom_objects gave."""
    bases = policy_class.__mro__ if isinstance(policy_class, type) else ()
    return next((algorithm for base, algorithm in _policies().items() if base in bases), None)


def _integer(minimum: int, maximum: int = 2**62) -> Callable[[str, Any], int]:
    def check(name: str, value: Any) -> int:
        if check_integer(name, value, minimum) > maximum:
            raise ValueError(f"{name} must be at most {maximum:,}, got {value:,}")
        return value

    return check


def _boolean(name: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError(f"{name} must be true or false, got {value!r:.100}")
    return value


def _instance(*kinds: type) -> Callable[[str, Any], Any]:
    def check(name: str, value: Any) -> Any:
        if isinstance(value, bool) or not isinstance(value, kinds):
            raise ValueError(f"{name} must be a {' or '.join(k.__name__ for k in kinds)}, got {value!r:.100}")
        return value

    return check


def _schedule(name: str, value: Any) -> Any:
    return value if callable(value) and not isinstance(value, type) else check_number(name, value, 0.0)


def _text_or_number(name: str, value: Any) -> Any:
    return value if isinstance(value, str) and len(value) < 100 else check_number(name, value)


def _noise(name: str, value: Any) -> Any:
    return value if isinstance(value, ActionNoise) else check_number(name, value, 0.0)


def _subclass(base: type) -> Callable[[str, Any], Any]:
    def check(name: str, value: Any) -> Any:
        if not isinstance(value, type) or not issubclass(value, base):
            raise ValueError(f"{name} must be a {base.__name__} class, got {value!r:.100}")
        return value

    return check


def _train_freq(name: str, value: Any) -> Any:
    if isinstance(value, TrainFreq):
        return value
    if isinstance(value, list):
        return (_integer(1)(name, value[0]), value[1])
    return _integer(1)(name, value)


def _arguments(name: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value) or not _is_plain(value):
        raise ValueError(f"{name} must be a mapping of names to finite numbers, texts and known classes")
    if value.get("n_critics") is not None:
        _integer(1, MAX_CRITICS)("n_critics", value["n_critics"])
    return value


def _or_none(check: Callable[[str, Any], Any]) -> Callable[[str, Any], Any]:
    return lambda name, value: None if value is None else check(name, value)


# Every field that is taken from a file, and what it may be
_FIELDS: dict[str, Callable[[str, Any], Any]] = {
    "policy_class": _subclass(BasePolicy),
    "policy_kwargs": _arguments,
    "observation_space": _instance(spaces.Space),
    "action_space": _instance(spaces.Box),
    "learning_rate": _schedule,
    "lam": _schedule,
    "qf_learning_rate": _or_none(_schedule),
    "action_noise": _or_none(_noise),
    "train_freq": _train_freq,
    "replay_buffer_class": _or_none(_subclass(ReplayBuffer)),
    "replay_buffer_kwargs": _arguments,
    "ent_coef": _text_or_number,
    "target_entropy": _or_none(_text_or_number),
    "seed": _or_none(_integer(0)),
    "fused": _or_none(_boolean),
    "fused_kwargs": _arguments,
    "verbose": _integer(0, 2),
    "n_envs": _integer(1, MAX_ENVS),
    **dict.fromkeys(("gradient_steps", "sde_sample_freq"), _integer(-1)),
    **dict.fromkeys(("buffer_size", "batch_size", "n_steps", "policy_delay", "target_update_interval"), _integer(1)),
    **dict.fromkeys(
        (
            *("num_timesteps", "_total_timesteps", "_num_timesteps_at_start", "_episode_num", "_n_updates"),
            *("learning_starts", "_stats_window_size", "top_quantiles_to_drop_per_net"),
        ),
        _integer(0),
    ),
    **dict.fromkeys(
        ("tau", "gamma", "kappa", "target_policy_noise", "target_noise_clip", "_current_progress_remaining"),
        check_number,
    ),
    **dict.fromkeys(
        (
            *("use_sde", "use_sde_at_warmup", "optimize_memory_usage", "stochastic_actor", "_built_stochastic_actor"),
            *("remove_time_limit_termination",),
        ),
        _boolean,
    ),
}  # fmt: skip
# What is made anew when a model is set up or learns; the file's is not looked at
_MADE_ANEW = {
    "lr_schedule", "start_time", "ep_info_buffer", "ep_success_buffer", "_last_obs", "_last_original_obs",
    "_last_episode_starts", "_last_dones", "_target_entropy", "tensorboard_log", "device", "env", "eval_env",
    "create_eval_env", "_logger", "_custom_logger", "_vec_normalize_env", "replay_buffer", "sde_support",
    *(f"{of}batch_norm_stats{target}" for of in ("", "actor_", "critic_") for target in ("", "_target")),
}  # fmt: skip


def _read_fields(raw: bytes, custom_objects: dict[str, Any]) -> dict[str, Any]:
    """
    :return: the fields of ``data`` that are known, each checked; those of ``custom_objects`` as they are given
    :raises UnsafeFileError: for any other, by name
    """
    data = _parse_data(raw)
    classes = {**CLASSES, **{name_of(policy): policy for policy in _policies()}}
    fields = {}
    for name, value in data.items():
        if name in custom_objects:
            fields[name] = custom_objects[name]
        elif name in _FIELDS:
            with _reading(f"the field {name} (custom_objects can replace it)"):
                if isinstance(value, dict) and ":serialized:" in value:
                    value = rebuild(read_pickle(base64.b64decode(value[":serialized:"], validate=True)), classes, CALLS)
                fields[name] = _FIELDS[name](name, value)
        elif name not in _MADE_ANEW:
            raise UnsafeFileError(f"the field {name[:100]!r} is unknown (custom_objects can replace it)")
    known = constructor_hints(fields.get("policy_class", BasePolicy)).keys() - POLICY_ARGUMENTS
    fields.setdefault("policy_kwargs", {}).pop("device", None)
    for name in fields["policy_kwargs"]:
        if name not in known:
            raise UnsafeFileError(f"the field policy_kwargs has the unknown key {name[:100]!r}")
    return fields


def _parse_data(raw: bytes) -> dict[str, Any]:
    with _reading("data"):
        data = json.loads(raw, object_pairs_hook=_unique)
        if not isinstance(data, dict):
            raise UnsafeFileError("it does not hold fields")
        return data


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len({name for name, _ in pairs}) != len(pairs):
        raise UnsafeFileError("it has a field twice")
    return dict(pairs)


def _check_replay_memory(fields: dict[str, Any]) -> None:
    size, observations = fields.get("buffer_size", 1), fields["observation_space"]
    parts: Any = observations.spaces.values() if isinstance(observations, spaces.Dict) else [observations]
    n_bytes = size * sum(2 * math.prod(part.shape) * part.dtype.itemsize for part in parts)
    if n_bytes > MAX_REPLAY_BYTES:
        raise UnsafeFileError(
            f"its replay buffer of {size:,} transitions takes {n_bytes / 2**30:,.0f} GiB: give a smaller buffer_size"
        )


# -------------------------------------------------------------------- models


def _make_model(
    algorithm: type[OffPolicyAlgorithm],
    policy_class: type[BasePolicy],
    env: VecEnv | None,
    device: th.device | str,
    fields: dict[str, Any],
    tensors: dict[str, Any],
) -> OffPolicyAlgorithm:
    model: Any = algorithm(policy_class, env, device=device, _init_setup_model=False)  # type: ignore[arg-type,call-arg]
    vars(model).update(fields)
    model._setup_model()
    state_dicts, variables = model._get_torch_save_params()
    saved_variables = {**tensors.pop("tensors", {}), **tensors.pop("pytorch_variables", {})}
    for name in state_dicts:
        if name.endswith("optimizer"):
            with _reading(f"{name}.pth"):
                optimizer = model
                for attribute in name.split("."):
                    optimizer = getattr(optimizer, attribute)
                _check_optimizer(optimizer, tensors[name])
    model.set_parameters(tensors, exact_match=True, device=device)
    for name, value in saved_variables.items():
        with _reading(f"pytorch_variables.pth, {str(name)[:100]}"):
            if name not in variables:
                raise UnsafeFileError("it is unknown")
            if value is not None:
                current = getattr(model, name)
                if value.shape != current.shape or not value.isfinite().all():
                    raise UnsafeFileError("it is of another shape, or not finite")
                current.data = value.data.to(current.device, current.dtype)
    if model.use_sde:
        model.policy.reset_noise()
    return model


# -------------------------------------------------------------------- normalisation and replay buffers


def _read_object(path: str | Path, cls: type, read_state: Callable[[Call, Rebuild], dict[str, Any]]) -> dict[str, Any]:
    """:return: what ``read_state`` takes from the one pickled object of a class that a file holds"""
    size = Path(path).stat().st_size
    if size > MAX_REPLAY_BYTES:
        raise UnsafeFileError(f"it has {size:,} bytes, more than {MAX_REPLAY_BYTES:,}")
    with Path(path).open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        saved = read_pickle(content)  # type: ignore[arg-type]  # a mapped file reads like a file
    if not isinstance(saved, Call) or saved.function != name_of(cls):
        raise UnsafeFileError(f"it does not hold a {cls.__name__}")
    return rebuild(saved, {}, {**CALLS, name_of(cls): read_state})


def _normalization_state(call: Call, make: Rebuild) -> dict[str, Any]:
    """The keyword arguments of ``VecNormalize``, and its statistics; nothing else of the pickle is looked at."""
    state = call.state
    fields: dict[str, Any] = {name: make(state[name]) for name in ("obs_rms", "ret_rms") if name in state}
    for name in ("training", "norm_obs", "norm_reward"):
        fields[name] = _boolean(name, make(state[name]))
    for name in ("clip_obs", "clip_reward", "gamma", "epsilon"):
        fields[name] = check_number(name, make(state[name]), 0.0)
    keys = make(state.get("norm_obs_keys"))
    if keys is not None and not (isinstance(keys, list) and all(isinstance(key, str) for key in keys)):
        raise UnsafeFileError("norm_obs_keys that are not names")
    return {"obs_rms": None, "ret_rms": None, **fields, "norm_obs_keys": keys}


def _arrays_like(buffer: ReplayBuffer) -> Callable[[Call, Rebuild], dict[str, Any]]:
    """Of a replay buffer only its arrays of numbers, its position and its number of environments are looked at."""
    names = [name for name, value in vars(buffer).items() if isinstance(value, dict) or _is_numeric(value)]

    def read_state(call: Call, make: Rebuild) -> dict[str, Any]:
        position = {"pos": _integer(0)("pos", make(call.state["pos"])), "full": _boolean("full", call.state["full"])}
        n_envs = _integer(1, MAX_ENVS)("n_envs", make(call.state["n_envs"]))
        return {**position, "n_envs": n_envs, **{name: make(call.state[name]) for name in names if name != "infos"}}

    return read_state


def _is_numeric(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype.kind in "biuf"


def _same_layout(saved: Any, fresh: Any) -> bool:
    if isinstance(fresh, dict):
        return (
            isinstance(saved, dict)
            and saved.keys() == fresh.keys()
            and all(_same_layout(saved[key], fresh[key]) for key in fresh)
        )
    if isinstance(fresh, RunningMeanStd):
        return isinstance(saved, RunningMeanStd) and np.shape(saved.mean) == np.shape(fresh.mean)
    if isinstance(fresh, np.ndarray):
        # The fused update keeps observations as float32, whatever SB3 would
        return isinstance(saved, np.ndarray) and (saved.shape, saved.dtype.kind) == (fresh.shape, fresh.dtype.kind)
    return type(saved) is type(fresh)
