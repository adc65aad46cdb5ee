"""The model of a run: building it, loading it with its replay buffer, saving it with the normalisation statistics."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.her import HerReplayBuffer

from sb3_tdc.common.checks import check_observation_space
from sb3_tdc.common.files import write_atomically
from sb3_tdc.common.noise import NormalNoiseRange, noise_of_all
from sb3_tdc.common.signatures import constructor_parameters
from sb3_tdc.common.words import count
from sb3_tdc.envs.vector import GymnasiumVecEnv
from sb3_tdc.hyperparams import OF_ONE_RUN, OF_THE_NETWORK, Hyperparams
from sb3_tdc.runs.algorithms import KNOWN_ALGORITHMS
from sb3_tdc.runs.callbacks.finite_guard import check_before_saving
from sb3_tdc.runs.folder import RunFolder
from sb3_tdc.safe_load import UnsafeFileError, load_replay_buffer, load_safely, read_data
from sb3_tdc.safe_load.fields import TEMPERATURE, on_the_command_line
from sb3_tdc.safe_load.models import names_code, read_model_fields

# Raised when the disk is full: by Python and NumPy an OSError, by PyTorch a RuntimeError
DISK_ERRORS = (OSError, RuntimeError)


def make_model(algo: str, hyperparams: Hyperparams, env: VecEnv, **kwargs: Any) -> OffPolicyAlgorithm:
    """
    Build a model from its hyperparameters.

    :param algo: a key of ``KNOWN_ALGORITHMS``
    :param kwargs: further arguments of the algorithm's constructor
    :raises ValueError: if the policy or the replay buffer does not fit the environment, or there is too little memory
    """
    space = env.observation_space
    check_observation_space(space)
    if hyperparams.model["policy"] == "MultiInputPolicy" and not isinstance(space, spaces.Dict):
        raise ValueError(
            f"policy MultiInputPolicy is for Dict observations, got {space}: use policy:MlpPolicy or policy:CnnPolicy"
        )
    _check_hindsight(hyperparams, env)
    with _enough_memory(hyperparams):
        return KNOWN_ALGORITHMS[algo](env=env, **hyperparams.model, **_action_noise(hyperparams, env), **kwargs)


def _check_hindsight(hyperparams: Hyperparams, env: VecEnv) -> None:
    kind, vector = hyperparams.model.get("replay_buffer_class") or ReplayBuffer, env.unwrapped
    if issubclass(kind, HerReplayBuffer) and isinstance(vector, GymnasiumVecEnv) and not vector.has_single_envs:
        raise ValueError(
            f"{kind.__name__} calls compute_reward of single environments, and {vector.env} has none: "
            "use --vec-env dummy or subproc, or another replay_buffer_class"
        )


@contextmanager
def _enough_memory(hyperparams: Hyperparams) -> Iterator[None]:
    try:
        yield
    except MemoryError as error:
        size = hyperparams.model.get("buffer_size", "that of the algorithm")
        raise ValueError(
            f"The memory is too small for the model or its replay buffer (buffer_size {size}): {error}"
        ) from error


def continue_model(
    path: Path, algo: str, hyperparams: Hyperparams, env: VecEnv, trust: bool, **kwargs: Any
) -> OffPolicyAlgorithm:
    """
    Load a model to train it further: its network is the saved one, everything else comes from the hyperparameters.

    :param path: a zip
    :raises ValueError: as :func:`load_model`, if the hyperparameters contain another network, or if the replay buffer
        does not fit the environments
    """
    _check_hindsight(hyperparams, env)
    algorithm: Any = KNOWN_ALGORITHMS[algo]
    # The constructor derives some attributes from others, and gives those that are not named its default values
    wanted = algorithm(env=None, **hyperparams.model, **_action_noise(hyperparams, env), _init_setup_model=False)
    names = set(constructor_parameters(algorithm)) - {*OF_THE_NETWORK, *OF_ONE_RUN}
    attributes = {key: vars(wanted)[key] for name in names for key in (name, f"_{name}") if key in vars(wanted)}
    with _enough_memory(hyperparams):
        model = load_model(path, algo, env, trust, **attributes, **kwargs)
    _check_network(model, wanted, hyperparams)
    return model


def _check_network(model: OffPolicyAlgorithm, wanted: OffPolicyAlgorithm, hyperparams: Hyperparams) -> None:
    for name in (name for name in OF_THE_NETWORK if name in hyperparams.raw):
        saved, given = (_part_of_network(each, name) for each in (model, wanted))
        if saved != given:
            raise ValueError(
                f"{name} must be that of the saved model, or left out: {saved!r}, got {hyperparams.raw[name]!r}"
            )


def _part_of_network(model: OffPolicyAlgorithm, name: str) -> Any:
    if name == "policy":
        return model.policy_class
    if name == "policy_kwargs":  # SB3 adds use_sde to them
        return {key: value for key, value in model.policy_kwargs.items() if key not in OF_THE_NETWORK}
    return getattr(model, name)


def load_experience(model: OffPolicyAlgorithm, path: Path, trust: bool) -> None:
    """
    Load a saved replay buffer into a model, and let updates begin at the first step.

    :raises ValueError: if the buffer does not fit the model's environments
    """
    if trust:
        model.load_replay_buffer(path)
    else:
        load_replay_buffer(path, model)
    assert model.replay_buffer is not None
    assert model.env is not None
    if model.replay_buffer.n_envs != model.env.num_envs:
        n_envs = count(model.replay_buffer.n_envs, "environment")
        raise ValueError(f"{path} is of {n_envs}, this run has {model.env.num_envs}")
    model.learning_starts = 0  # no random steps on top of the loaded experience


def load_model(path: Path, algo: str, env: VecEnv | None, trust: bool, **kwargs: Any) -> OffPolicyAlgorithm:
    """
    Load a saved model.

    :param algo: a key of ``KNOWN_ALGORITHMS``
    :param trust: whether the file may run code, as SB3's ``load`` lets it
    :param kwargs: further arguments of the algorithm's ``load``
    :raises ValueError: if the file is not a saved model, is of another algorithm, or is refused
    """
    check_saved_by(path, algo)
    if trust:
        return _load_trusted(KNOWN_ALGORITHMS[algo], path, env, **kwargs)
    try:
        return load_safely(path, env, algorithm=KNOWN_ALGORITHMS[algo], **kwargs)
    except UnsafeFileError as error:
        raise UnsafeFileError(on_the_command_line(str(error))) from error


def _load_trusted(
    algorithm: type[OffPolicyAlgorithm], path: Path, env: VecEnv | None, **kwargs: Any
) -> OffPolicyAlgorithm:
    """Load as SB3 does, but SAC also with another ``ent_coef``: SB3 fails, or keeps the file's temperature."""
    if not issubclass(algorithm, SAC) or "ent_coef" not in kwargs:
        return algorithm.load(path, env=env, **kwargs)
    ent_coef = kwargs.pop("ent_coef")
    model: Any = algorithm.load(path, env=env, **kwargs)
    if model.ent_coef == ent_coef:
        return model
    saved = model.get_parameters()
    vars(model).update({**dict.fromkeys(TEMPERATURE), "ent_coef": ent_coef})
    model._setup_model()
    new = model.get_parameters()
    kept = {name: saved[name] for name in new if name not in TEMPERATURE}
    model.set_parameters({**new, **kept}, device=model.device)
    return model


def needs_trust(path: Path, algo: str) -> bool:
    """Return whether :func:`load_model` refuses a model because it refers to code, such as a custom class."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            read_model_fields(path, KNOWN_ALGORITHMS[algo])
    except UnsafeFileError:
        with suppress(UnsafeFileError):  # damaged: --trust would not help
            return names_code(path)
    return False


def check_saved_by(path: Path, algo: str) -> None:
    """
    Check that a zip was saved by an algorithm.

    :raises ValueError: if the file is not a saved model, or was saved by another algorithm
    """
    policy_class = read_data(path).get("policy_class")
    module = policy_class.get("__module__") if isinstance(policy_class, dict) else None
    modules = {a: {p.__module__ for p in KNOWN_ALGORITHMS[a].policy_aliases.values()} for a in KNOWN_ALGORITHMS}
    others = [a for a in KNOWN_ALGORITHMS if module in modules[a]]
    if others and algo not in others:
        named = list(dict.fromkeys(a.partition("-")[0] for a in others))  # variants are named after their algorithm
        raise ValueError(f"{path} was saved by {' or '.join(named)}, not by {algo}: --algo {named[0]}")


def save_model(model: BaseAlgorithm, folder: RunFolder, path: Path) -> None:
    """
    Save a model of a run, and the statistics of ``VecNormalize``.

    :raises NonFiniteError: if a weight is NaN or infinite
    """
    check_before_saving(model)
    write_atomically(model.save, path)
    normalization = model.get_vec_normalize_env()
    if normalization is not None:
        write_atomically(lambda part: normalization.save(str(part)), folder.normalization(path))


def _action_noise(hyperparams: Hyperparams, env: VecEnv) -> dict[str, Any]:
    """Return ``action_noise`` as a keyword argument if RL Zoo's ``noise_type`` is given; null means no noise."""
    if hyperparams.noise_type is None:
        is_none = "noise_type" in hyperparams.raw and "action_noise" not in hyperparams.model
        return {"action_noise": None} if is_none else {}
    # For scalar actions, a shape that can be added to those of one or of several environments, in SB3's classes too
    shape = env.action_space.shape or ((1,) if env.num_envs == 1 else ())
    zeros, sigmas = np.zeros(shape), [np.full(shape, sigma) for sigma in np.atleast_1d(hyperparams.noise_std)]
    if hyperparams.noise_type != "normal":
        return {"action_noise": OrnsteinUhlenbeckActionNoise(zeros, sigmas[0])}
    noise = NormalNoiseRange(zeros, *sigmas) if len(sigmas) == 2 else NormalActionNoise(zeros, sigmas[0])
    return {"action_noise": noise_of_all(noise, env.num_envs)}
