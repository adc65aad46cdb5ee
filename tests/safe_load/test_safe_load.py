"""Untrusted files: what SB3 saves opens, bit for bit; what is poisoned, damaged or huge is refused, and never runs."""

import base64
import collections
import contextlib
import io
import json
import os
import pickle
import re
import shutil
import struct
import subprocess
import sys
import time
import tracemalloc
import warnings
import zipfile
from pathlib import Path

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
import torch as th
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from stable_baselines3 import DDPG, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.her import GoalSelectionStrategy

from sb3_tdc import TDC, UnsafeFileError, load_safely
from sb3_tdc.ablations.calibration import CalibratedTDC
from sb3_tdc.algorithms import ALGORITHMS
from sb3_tdc.cli import enjoy, inspect
from sb3_tdc.runs.folder import RunFolder
from sb3_tdc.safe_load import budget, load_normalization, load_replay_buffer, weights
from sb3_tdc.safe_load.archives import MODEL_ENTRIES, read_archive
from sb3_tdc.safe_load.budget import Budget
from sb3_tdc.safe_load.fields import foreign_names, saved_fields
from sb3_tdc.safe_load.inert_pickle import Call, Name, Rebuild, read_pickle
from sb3_tdc.safe_load.known_objects import CALLS, CLASSES
from sb3_tdc.safe_load.models import names_code
from sb3_tdc.tdc.policies import TDCPolicy
from tests.helpers.command_line import SMALL, run_enjoy, run_train
from tests.helpers.saved_models import HER, MODELS, TINY, frames, goal_env, noise, pendulum
from tests.safe_load.attacks.data import layers
from tests.safe_load.attacks.pickles import (
    choices_of_bytes,
    choices_of_one_array,
    images_of_many_names,
    noise_of_bytes,
    noise_of_one_array,
)
from tests.safe_load.attacks.tensors import one_storage
from tests.safe_load.attacks.tools import Op, pickled
from tests.safe_load.attacks.zips import crowd, understated


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """The zip of a small TDC model with one field of every kind: schedules, noise, classes, spaces."""
    path = tmp_path_factory.mktemp("saved") / "model.zip"
    MODELS["tdc-stochastic"]().save(path)
    return path


@pytest.fixture
def marker(tmp_path, monkeypatch):
    """A file that exists if anything poisoned ran."""
    path = tmp_path / "executed"
    monkeypatch.setenv("MARKER", str(path))
    return path


def touch_marker():
    Path(os.environ["MARKER"]).touch()


class Poison:
    """An object that runs code when it is unpickled: by a builtin, without this module, as an attacker's would."""

    def __reduce__(self):
        return (exec, ("import os, pathlib; pathlib.Path(os.environ['MARKER']).touch()",))


POISONS = {
    "reduce": Poison(),
    "in a dict": {"net_arch": [8, 8], "activation_fn": Poison()},
    "in a list in a dict": {"net_arch": [[Poison()]]},
    "function": lambda *_: touch_marker(),
    "class": type("Mine", (), {"__init__": lambda self, *_: touch_marker()}),
    "foreign class": pickle.Pickler,
}


def serialized(value):
    return {":type:": "?", ":serialized:": base64.b64encode(cloudpickle.dumps(value)).decode()}


def rewrite(source, target, **entries):
    """A copy of a zip with some of its entries replaced or added (``None``: left out)."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        contents = {**{name: old.read(name) for name in old.namelist()}, **entries}
        for name, content in contents.items():
            if content is not None:
                new.writestr(name, content)
    return target


def fields_of(path):
    with zipfile.ZipFile(path) as archive:
        return json.loads(archive.read("data"))


def with_fields(source, target, **fields):
    return rewrite(source, target, data=json.dumps({**fields_of(source), **fields}))


def error_of(path, **kwargs):
    """The sentence with which a file is refused, or None if it opens."""
    message = None
    try:
        load_safely(path, device="cpu", **kwargs)
    except UnsafeFileError as error:
        message = str(error)
    assert message is None or (len(message) < 800 and "\n" not in message)
    return message


def refuse(path, **kwargs):
    message = error_of(path, **kwargs)
    assert message is not None, "it was opened"
    return message


# -------------------------------------------------------------------- what opens


@pytest.mark.parametrize("name", MODELS)
def test_it_opens_what_sb3_saves_and_is_the_same_model(tmp_path, name, monkeypatch):
    model = MODELS[name]()
    path = tmp_path / "model"
    model.save(path)
    env = model.get_env()
    algorithm = DDPG if name == "ddpg" else None
    given_env = env if "her" in name else None  # as SB3, whose HerReplayBuffer needs one

    def forbidden(*args, **kwargs):
        raise AssertionError("an unpickler was used")

    with monkeypatch.context() as patch:  # torch.load's restricted unpickler is a separate one
        for module, attribute in ((pickle, "load"), (pickle, "loads"), (cloudpickle, "loads")):
            patch.setattr(module, attribute, forbidden)
        opened = load_safely(path, given_env, device="cpu", algorithm=algorithm)
    reference = type(model).load(path, env=given_env, device="cpu")

    assert type(opened) is type(model)
    observation = env.reset()
    for deterministic in (True, False) if name != "sac-sde" else (True,):  # SB3 draws gSDE's noise anew
        actions = []
        for of in (opened, reference):
            th.manual_seed(0)
            actions.append(of.predict(observation, deterministic=deterministic)[0])
        np.testing.assert_array_equal(*actions)
    assert str(opened.get_parameters()) == str(reference.get_parameters())  # with the optimizers
    left = {"start_time", "ep_info_buffer", "ep_success_buffer", "_last_obs", "_last_original_obs", "action_noise"}
    left |= {"_last_episode_starts"}
    for key, value in vars(reference).items():
        if key not in left and " object at 0x" not in str(value):
            assert str(vars(opened)[key]) == str(value), key
    assert str(opened.action_noise) in str(reference.action_noise)  # the latter may be in a VectorizedActionNoise

    opened.set_env(env)  # the opened model continues to learn
    steps = opened.num_timesteps
    opened.learning_starts = steps + 10  # HER can only sample after an episode has ended
    opened.learn(30, reset_num_timesteps=False)
    assert opened.num_timesteps > steps


def test_a_schedule_of_ones_own_is_refused_by_name_and_can_be_replaced(tmp_path, marker):
    model = pendulum(SAC, learning_rate=lambda _: 1e-3)
    model.learning_rate = POISONS["function"]
    path = tmp_path / "model.zip"
    model.save(path)
    assert "the field learning_rate (custom_objects can replace it): a call of cloudpickle" in refuse(path)
    opened = load_safely(path, custom_objects={"learning_rate": 5e-4}, device="cpu")
    assert opened.lr_schedule(1.0) == 5e-4
    assert load_safely(path, learning_rate=2e-4, device="cpu").lr_schedule(1.0) == 2e-4
    assert not marker.exists()


def test_tqc_opens_too(tmp_path):
    contrib = pytest.importorskip("sb3_contrib")
    model = pendulum(contrib.TQC)
    model.save(tmp_path / "tqc")
    opened = load_safely(tmp_path / "tqc", device="cpu")
    observation = np.ones(3, np.float32)
    assert type(opened) is contrib.TQC
    np.testing.assert_array_equal(*(m.predict(observation, deterministic=True)[0] for m in (opened, model)))


def test_the_environment_must_be_that_of_the_model(saved):
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        load_safely(saved, gym.make("MountainCarContinuous-v0"), device="cpu")
    space = gym.spaces.Box(-1, 1, (5,), np.float32)
    message = refuse(saved, custom_objects={"observation_space": space})
    assert "actor.latent_pi.0.weight is (8, 3), but the environment and policy_kwargs make it (8, 5)" in message
    assert "was saved by TDC, not by SAC" in refuse(saved, algorithm=SAC)


def test_the_folder_of_logs_is_not_the_files(saved, tmp_path):
    path = with_fields(saved, tmp_path / "x.zip", tensorboard_log=str(tmp_path / "elsewhere"))
    assert load_safely(path, device="cpu").tensorboard_log is None


def test_a_model_of_very_many_environments(saved, tmp_path):
    # One rollout of 16,384 steps where 5,000 were asked for: 1 - 16,384 / 5,000 is left
    path = with_fields(saved, tmp_path / "x.zip", n_envs=16_384, _current_progress_remaining=-2.2768)
    opened = load_safely(path, device="cpu")
    assert opened.n_envs == 16_384
    assert opened.action_noise().shape == (16_384, 1)


# -------------------------------------------------------------------- what does not run


@pytest.mark.parametrize("poison", POISONS)
def test_no_poisoned_field_runs(saved, tmp_path, marker, poison):
    names = [*fields_of(saved), "unknown", "predict", "policy", "__class__"]
    assert len(names) > 50
    for name in names:
        path = with_fields(saved, tmp_path / "x.zip", **{name: serialized(POISONS[poison])})
        message = error_of(path)
        if name.startswith(("_last", "lr_schedule", "start_time", "ep_", "tensorboard")):
            assert message is None, name  # not looked at
        else:
            assert message is not None, name
            assert name in message
        assert not marker.exists(), name


class ByName:
    """``getattr(owner, name)``, as Python 3.11.0 to 3.11.3 pickle ``TrainFrequencyUnit.STEP``."""

    def __init__(self, owner, name):
        self.owner, self.name = owner, name

    def __reduce__(self):
        return getattr, (self.owner, self.name)


class Every:
    """``TrainFreq(frequency, unit)``."""

    def __init__(self, unit):
        self.unit = unit

    def __reduce__(self):
        return TrainFreq, (3, self.unit)


def test_units_as_all_versions_of_python_pickle_them(saved, tmp_path, marker):
    for unit in (TrainFrequencyUnit.EPISODE, ByName(TrainFrequencyUnit, "EPISODE")):
        path = with_fields(saved, tmp_path / "x.zip", train_freq=serialized(Every(unit)))
        assert load_safely(path, device="cpu").train_freq == TrainFreq(3, TrainFrequencyUnit.EPISODE)
    for owner, name in ((TrainFrequencyUnit, "mro"), (TrainFreq, "count"), (os, "system"), (Poison(), "x")):
        path = with_fields(saved, tmp_path / "x.zip", train_freq=serialized(Every(ByName(owner, name))))
        assert "train_freq" in refuse(path)
        assert not marker.exists()


def test_the_poison_is_one(saved, tmp_path, marker):
    """The control: SB3 runs it."""
    TDC.load(with_fields(saved, tmp_path / "x.zip", start_time=serialized(Poison())))
    assert marker.exists()


@pytest.mark.parametrize(
    "value",
    [
        *("os.system", {"__module__": "os", "__name__": "system"}, {":serialized:": 3}, {":serialized:": "%%"}, [1]),
        *(float("inf"), -(10**9), {"a": {"b": {"c": {"d": {"e": {}}}}}}, float("nan"), None, "x" * 1000),
    ],
    ids=str,
)
def test_odd_values_give_one_sentence(saved, tmp_path, value):
    opened = 0
    for name in fields_of(saved):
        path = with_fields(saved, tmp_path / "x.zip", **{name: value})
        opened += error_of(path) is None
    assert opened < 25  # fields that are not read, and fields that may have the value


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"policy_kwargs": {"net_arch": [8, 8], "n_quantiles": 10**9}}, "critic.layers.4.weight"),
        ({"policy_kwargs": {"net_arch": [10**9, 10**9]}}, "actor.latent_pi.0.weight"),
        ({"policy_kwargs": {"net_arch": [8] * 100_000}}, "policy_kwargs"),
        ({"policy_kwargs": {"net_arch": [8, 8], "n_critics": 10**8}}, "n_critics must be an integer from 1 to 256"),
        ({"policy_kwargs": {"net_arch": [8, 8], "n_quantiles": 10**30}}, "policy_kwargs"),
        ({"policy_kwargs": {"net_arch": [8, 8], "features_extractor_class": "os.system"}}, "policy_kwargs"),
        ({"policy_kwargs": {"net_arch": [8, 8], "surprise": 1}}, "unknown key 'surprise'"),
        ({"buffer_size": 10**12}, "give a smaller buffer_size"),
        ({"n_envs": 10**9}, "n_envs must be an integer from 1 to 65,536"),
        ({"policy_class": "sb3_tdc.tdc.policies.TDCPolicy"}, "policy_class"),
        ({"replay_buffer_class": serialized(TDC)}, "replay_buffer_class"),
        ({"unknown": 1}, "'unknown' is unknown"),
    ],
)
def test_absurd_sizes_are_refused_before_memory_is_taken(saved, tmp_path, fields, message):
    assert message in refuse(with_fields(saved, tmp_path / "x.zip", **fields))


@pytest.mark.parametrize("attack", [layers("td3", n_critics=256), layers("meow", n_blocks=256)], ids=["td3", "meow"])
def test_networks_of_very_many_layers_are_refused_before_they_are_built(tmp_path, monkeypatch, attack):
    path = attack(tmp_path, None)
    assert "policy_kwargs: networks of more than 8,192 tensors of parameters" in refuse(path)
    monkeypatch.setattr(weights, "MAX_PARAMETERS", 10**6)
    monkeypatch.setattr(budget, "MAX_SECONDS", 1.0)
    start = time.process_time()
    assert "policy_kwargs: it takes too long to read" in refuse(path)
    assert time.process_time() - start < 5  # it takes 1 s; building all of the networks takes 16 s and 67 s


def test_dict_spaces_of_very_many_parts_are_refused(saved, tmp_path):
    path = with_fields(saved, tmp_path / "x.zip", observation_space=pickled(images_of_many_names(65)))
    assert "a Dict space of 65 parts, more than 64" in refuse(path)
    path = with_fields(saved, tmp_path / "x.zip", observation_space=pickled(images_of_many_names(64)))
    assert "policy_kwargs" in refuse(path)


def test_numbers_of_eight_bytes_are_paid_for_before_they_are_made(saved, tmp_path):
    assert "the field action_noise (custom_objects can replace it): it would take far more memory" in refuse(
        noise_of_bytes(tmp_path, saved)
    )
    assert "a MultiDiscrete space whose nvec is no array of at most 65,536 numbers" in refuse(
        choices_of_bytes(tmp_path, saved)
    )


@pytest.mark.parametrize("raw", [choices_of_one_array(2**14), noise_of_one_array(2**14)], ids=["space", "noise"])
def test_copies_of_one_array_are_paid_for(raw):
    spent = Budget(0)
    spent.bytes = 2**24  # a thousand spaces hold 250 MiB, and as many noises 375 MiB
    tracemalloc.start()
    with pytest.raises(UnsafeFileError, match="far more memory"):
        Rebuild(CLASSES, CALLS, spent)(read_pickle(raw, spent))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2**24 + 2**21  # the records of the pickle take 1 MiB


@pytest.mark.parametrize("text", ["1" * 32_000, ("1" * 32_000, None)], ids=["value", "key"])
def test_a_long_text_counts_as_often_as_it_is_reached(text):
    def rebuild(times):
        part = dict([text]) if isinstance(text, tuple) else text
        Rebuild({}, {}, Budget(0))(read_pickle(pickle.dumps([part] * times), Budget(10**6)))

    rebuild(490)  # each counts as 1,000 values, one for 32 letters, and the value itself
    with pytest.raises(UnsafeFileError, match="more than 500,000 values"):
        rebuild(500)


_UNIT = Name("stable_baselines3.common.type_aliases", "TrainFrequencyUnit")


@pytest.mark.parametrize(
    ("name", "args", "state", "message"),
    [
        ("utils.ConstantSchedule", (), {"val": [[1]]}, "val must be a finite number, got a list"),
        ("noise.NormalActionNoise", (), {"_mu": ["1"], "_sigma": [1]}, "an array of something else than numbers"),
        ("type_aliases.TrainFreq", ([1], Call(_UNIT, ("step",))), None, "frequency must be an integer .* got a list"),
        ("type_aliases.TrainFrequencyUnit", ([1],), None, "a list instead of a TrainFrequencyUnit"),
    ],
)
def test_what_is_no_number_is_named_by_its_type(name, args, state, message):
    module, kind = f"stable_baselines3.common.{name}".rsplit(".", 1)
    with pytest.raises(ValueError, match=message):
        Rebuild(CLASSES, CALLS, Budget(0))(Call(Name(module, kind), args, state))


def test_what_a_model_makes_for_each_environment_is_paid_for(saved, tmp_path):
    many = {"n_envs": 10_000, "action_space": serialized(gym.spaces.Box(-1, 1, (2000,)))}
    path = with_fields(saved, tmp_path / "x.zip", **many, action_noise=0.1)  # two numbers of 8 bytes: 305 MiB
    assert "the field action_noise (custom_objects can replace it): it would take far more memory" in refuse(path)
    assert "policy.pth: actor" in refuse(with_fields(path, tmp_path / "y.zip", n_envs=5_000))
    assert "policy.pth: actor" in refuse(with_fields(path, tmp_path / "y.zip", action_noise=None))
    large = serialized(gym.spaces.Box(-1, 1, (10**6,)))
    path = with_fields(saved, path, n_envs=10_000, buffer_size=1, observation_space=large)
    assert "its replay buffer of 10,000 transitions takes 75 GiB" in refuse(path)  # twice 4 MB for each


@pytest.mark.parametrize(("size", "opens"), [((), True), (1, True), (6, True), (2, False), (12, False)])
def test_noise_is_of_one_number_or_of_the_actions(tmp_path, size, opens):
    env = make_vec_env("HalfCheetah-v5", 2)  # of 6 actions
    TDC("MlpPolicy", env, policy_kwargs={"net_arch": [4], "n_quantiles": 2}, **TINY).save(tmp_path / "model.zip")
    action_noise = serialized(NormalActionNoise(np.zeros(size), np.full(size, 0.1)))
    path = with_fields(tmp_path / "model.zip", tmp_path / "x.zip", action_noise=action_noise)
    if opens:
        assert load_safely(path, device="cpu").action_noise().shape[0] == 2
    else:
        assert f"noise of {size} numbers for 6 actions" in refuse(path)


def test_a_smaller_buffer_than_the_files(saved, tmp_path):
    path = with_fields(saved, tmp_path / "x.zip", buffer_size=10**12)
    assert load_safely(path, buffer_size=5, device="cpu").buffer_size == 5


def test_json_too_deep_or_with_a_field_twice(saved, tmp_path):
    assert "recursion" in refuse(rewrite(saved, tmp_path / "x.zip", data="[" * 10**5))
    assert "too many values" in refuse(rewrite(saved, tmp_path / "x.zip", data="[" * 10**6))
    assert "twice" in refuse(rewrite(saved, tmp_path / "x.zip", data='{"tau": 0.1, "tau": 0.2}'))
    refuse(rewrite(saved, tmp_path / "x.zip", data='{"tau": %s}' % ("9" * 10**5)))
    refuse(rewrite(saved, tmp_path / "x.zip", data="3"))


# -------------------------------------------------------------------- weights


def pth(content):
    file = io.BytesIO()
    th.save(content, file)
    return file.getvalue()


TENSOR_FILES = (
    "policy.pth", "actor.optimizer.pth", "critic.optimizer.pth", "ent_coef_optimizer.pth", "pytorch_variables.pth",
)  # fmt: skip


@pytest.mark.parametrize("name", TENSOR_FILES)
def test_no_poisoned_tensors_run(saved, tmp_path, marker, name):
    with zipfile.ZipFile(saved) as archive:
        good = archive.read(name)
    state = th.load(io.BytesIO(good), weights_only=True)
    poisoned = [
        pth(Poison()),
        pth({**state, "x": Poison()}),
        pth({**state, "x": th.nn.Linear(2, 2)}),
        pickle.dumps(Poison()),
        rewrite_bytes(good, "data.pkl", pickle.dumps(Poison(), 2)),
        rewrite_bytes(good, "data.pkl", b"cos\nsystem\n(S'true'\ntR."),
        rewrite_bytes(good, "code/evil.py", b"1"),
        good[:-30],
        good[:200],
        b"",
    ]
    for content in poisoned:
        assert name in refuse(rewrite(saved, tmp_path / "x.zip", **{name: content}))
        assert not marker.exists()


def rewrite_bytes(raw, suffix, content):
    with zipfile.ZipFile(io.BytesIO(raw)) as archive:
        prefix = archive.namelist()[0].partition("/")[0]
    target = io.BytesIO()
    rewrite(io.BytesIO(raw), target, **{f"{prefix}/{suffix}": content})
    return target.getvalue()


def test_tensors_that_say_more_than_their_bytes_are_refused(saved, tmp_path):
    """A storage's size is only a number in the pickle; nothing is read or allocated by it."""
    raw = pth({"w": th.zeros(8, 3)})
    with zipfile.ZipFile(io.BytesIO(raw)) as archive:
        tree = archive.read("archive/data.pkl")
    numbers = b"K\x18t"  # the 24 numbers of the storage
    assert tree.count(numbers) == 1
    for lie in (b"K\x19t", b"M\xff\xfft", b"J\xff\xff\xff\x7ft", b"J\xff\xff\xff\xfft"):
        poisoned = rewrite_bytes(raw, "data.pkl", tree.replace(numbers, lie))
        assert "a tensor with other bytes" in refuse(rewrite(saved, tmp_path / "x.zip", **{"policy.pth": poisoned}))
    huge = th.zeros(1).expand(10**12)  # one number, a stride of 0
    assert "a shape that it cannot have" in refuse(
        rewrite(saved, tmp_path / "x.zip", **{"policy.pth": pth({"w": huge})})
    )


def test_networks_may_not_be_far_larger_than_the_file(tmp_path):
    # These are small enough to be made; the state of the optimizer, of other networks, does not fit them
    assert "actor.optimizer.pth" in refuse(one_storage(tmp_path, None, width=256, depth=2))
    path = one_storage(tmp_path, None, width=2048, depth=4)
    assert path.stat().st_size < 2**20
    assert "far more memory than it has bytes" in refuse(path)


def test_weights_and_optimizers_that_do_not_fit_are_refused(saved, tmp_path):
    def state(name):
        with zipfile.ZipFile(saved) as archive:
            return th.load(io.BytesIO(archive.read(name)), weights_only=True)

    def refuse_with(name, content, match):
        assert re.search(match, refuse(rewrite(saved, tmp_path / "x.zip", **{name: pth(content)})))

    good = state("policy.pth")
    first = next(iter(good))
    refuse_with("policy.pth", {**good, first: good[first] * float("nan")}, f"{first} has values.*not finite")
    refuse_with("policy.pth", {**good, first: good[first].T.contiguous()}, rf"{first} is \(3, 8\)")
    refuse_with("policy.pth", {k: v for k, v in good.items() if k != first}, f"{first} is missing")
    refuse_with("policy.pth", {**good, "more": th.zeros(1)}, "more is")
    for change, match in (
        (lambda s: s["state"][0].update(exp_avg=th.zeros(1)), "'exp_avg' of parameter 0 is not what it can be"),
        (lambda s: s["state"][0].update(exp_avg=s["state"][0]["exp_avg"].half()), "'exp_avg' of parameter 0 is not"),
        (lambda s: s["state"][0].pop("exp_avg"), "state of parameter 0 lacks a part"),
        (lambda s: s["state"][0].update(step=th.tensor(float("nan"))), "'step' of parameter 0 is not"),
        (lambda s: s["state"].update({-1: s["state"][0]}), "a parameter that there is not"),
        (lambda s: s["param_groups"][0].update(betas=("a", "b")), "'betas' is unknown, or is not"),
        (lambda s: s["param_groups"][0].update(lr=True), "'lr' is unknown, or is not"),
        (lambda s: s["state"][0].update(surprise=th.zeros(1)), "has an unknown one"),
        (lambda s: s["state"].update({99: s["state"][0]}), "."),
        (lambda s: s["param_groups"][0].update(lr=float("inf")), "'lr'"),
        (lambda s: s["param_groups"][0].update(surprise=1), "'surprise'"),
        (lambda s: s["param_groups"][0].update(params=[0] * 5), "other parameters"),
        (lambda s: s["param_groups"].clear(), "not the state of this optimizer"),
    ):
        changed = state("actor.optimizer.pth")
        change(changed)
        refuse_with("actor.optimizer.pth", changed, match)
    refuse_with("pytorch_variables.pth", {"log_ent_coef": th.zeros(7)}, "another shape")
    refuse_with("pytorch_variables.pth", {"policy": th.zeros(1)}, "log_ent_coef is missing")
    variables = state("pytorch_variables.pth")
    refuse_with("pytorch_variables.pth", {**variables, "policy": th.zeros(1)}, "'policy': it is unknown")
    refuse_with("policy.pth", {**good, first: good[first].double()}, "is of torch.float64")
    assert "log_ent_coef is missing" in refuse(rewrite(saved, tmp_path / "x.zip", **{"pytorch_variables.pth": None}))


# -------------------------------------------------------------------- zips


@pytest.mark.parametrize(
    "name", ["../evil", "/etc/evil", "..\\evil", "evil.pth", "policy.pth/x", "env.pth", "data\n", "DATA", "actor.pth"]
)
def test_other_entries_are_refused_and_nothing_is_written(saved, tmp_path, name):
    assert "unknown or repeated" in refuse(rewrite(saved, tmp_path / "x.zip", **{name: b"1"}))
    assert {path.name for path in tmp_path.iterdir()} == {"x.zip"}


def test_a_repeated_entry_is_refused(saved, tmp_path):
    shutil.copy(saved, tmp_path / "x.zip")
    with zipfile.ZipFile(tmp_path / "x.zip", "a") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr("data", "{}")
    assert "unknown or repeated" in refuse(tmp_path / "x.zip")


def test_zip_bombs_are_refused_unread(saved, tmp_path, monkeypatch):
    path = tmp_path / "x.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("data", b"0" * 50_000_000)

    def forbidden(*_):
        raise AssertionError("it was read")

    with monkeypatch.context() as patch:
        patch.setattr(zipfile.ZipFile, "open", forbidden)
        assert "compressed more than 100-fold" in refuse(path)
    many = tmp_path / "many.zip"
    with zipfile.ZipFile(many, "w") as archive:
        for i in range(25_000):
            archive.writestr(f"{i}", b"")
    with monkeypatch.context() as patch:
        patch.setattr(zipfile, "ZipFile", forbidden)
        assert "too many entries" in refuse(many)
    lie = bytearray(saved.read_bytes())  # an entry that claims to have 4 GB
    entry = lie.rindex(b"PK\1\2")
    struct.pack_into("<LL", lie, entry + 20, 2**32 - 2, 2**32 - 2)
    path.write_bytes(lie)
    assert "far more memory than it has bytes" in refuse(path)


def test_no_more_of_an_entry_is_decompressed_than_it_says(saved, tmp_path):
    path = understated(tmp_path, saved, says=2**20, inflates_to=2**28)
    tracemalloc.start()
    with open(path, "rb") as file:
        entries = read_archive(file, MODEL_ENTRIES, Budget(path.stat().st_size))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(entries["system_info.txt"]) == 2**20
    assert peak < 2**24


def test_reading_entries_takes_its_time_from_the_budget(saved):
    spent = Budget(saved.stat().st_size)
    spent.take_bytes = lambda _: setattr(spent, "deadline", 0.0)  # the time is up once the entries are listed
    with open(saved, "rb") as file, pytest.raises(UnsafeFileError, match="takes too long"):
        read_archive(file, MODEL_ENTRIES, spent)


def test_only_processor_time_counts(monkeypatch):
    """A busy machine does not refuse a file; work on it does."""
    monkeypatch.setattr(budget, "MAX_SECONDS", 0.2)
    spent = Budget(0)
    time.sleep(0.3)
    spent.check_time()
    start = time.thread_time()
    while time.thread_time() - start < 0.3:
        pass
    with pytest.raises(UnsafeFileError, match="takes too long"):
        spent.check_time()


def test_a_file_does_not_pay_for_imports(saved):
    """Where Python has not compiled them yet, they take longer than any file may."""
    code = f"""
import sys
from sb3_tdc import load_safely
from sb3_tdc.safe_load import budget
class Noted(budget.Budget):
    def __init__(self, size):
        self.modules = set(sys.modules)
        super().__init__(size)
        noted.append(self)
noted = []
sys.modules["sb3_tdc.safe_load.models"].Budget = Noted
load_safely({str(saved)!r})
print(len(sys.modules.keys() - noted[0].modules))
"""
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 20  # they were 846


def test_entries_are_counted_once(saved, tmp_path):
    start = time.process_time()
    assert "policy.pth: it does not hold weights" in refuse(crowd(tmp_path, saved))
    assert time.process_time() - start < 1.5  # 0.2 s; counting each name among all entries takes 4 s


def test_a_compressed_copy_opens(saved, tmp_path):
    with zipfile.ZipFile(saved) as old, zipfile.ZipFile(tmp_path / "x.zip", "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            new.writestr(name, old.read(name))
    load_safely(tmp_path / "x.zip", device="cpu")


def test_files_that_are_no_models(saved, tmp_path):
    path = tmp_path / "x.zip"
    content = saved.read_bytes()
    for broken in (b"", b"PK", content[:-1], content[1000:], content[:1000], b"\0" * 10_000, content + b"x"):
        path.write_bytes(broken)
        refuse(path)
    assert "has no policy.pth" in refuse(rewrite(saved, path, **{"policy.pth": None}))
    assert "has no data" in refuse(rewrite(saved, path, data=None))
    assert "No such file" in refuse(tmp_path / "nothing.zip")


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_damaged_file_opens_or_is_refused(saved, tmp_path, data):
    content = bytearray(saved.read_bytes())
    places = st.integers(0, len(content) - 1)
    for place in data.draw(st.lists(places, max_size=4), label="changed bytes"):
        content[place] = data.draw(st.integers(0, 255))
    if data.draw(st.booleans(), label="cut"):
        del content[data.draw(places) :]
    path = tmp_path / "x.zip"
    path.write_bytes(content)
    error_of(path)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damage_under_right_checksums(saved, tmp_path, marker, data):
    """What a forger can do, and a bad disk cannot: the zip is whole, the pickle of a field or of tensors is not."""
    fields = fields_of(saved)
    pickled = sorted(name for name, value in fields.items() if isinstance(value, dict) and ":serialized:" in value)
    where = data.draw(st.sampled_from([*pickled, *TENSOR_FILES]))
    if where in TENSOR_FILES:
        with zipfile.ZipFile(saved) as archive:
            good = archive.read(where)
        with zipfile.ZipFile(io.BytesIO(good)) as archive:
            content = bytearray(archive.read("archive/data.pkl"))
    else:
        content = bytearray(base64.b64decode(fields[where][":serialized:"]))
    for place in data.draw(st.lists(st.integers(0, len(content) - 1), min_size=1, max_size=3)):
        content[place] = data.draw(st.integers(0, 255))
    if where in TENSOR_FILES:
        path = rewrite(saved, tmp_path / "x.zip", **{where: rewrite_bytes(good, "data.pkl", bytes(content))})
    else:
        value = {":serialized:": base64.b64encode(content).decode()}
        path = with_fields(saved, tmp_path / "x.zip", **{where: value})
    error_of(path)
    assert not marker.exists()


PICKLES = [
    cloudpickle.dumps(value)
    for value in (gym.spaces.Box(-1, 1, (2,)), noise(), {"a": [1, (2.0, None)]}, TDC, lambda x: x, collections.deque())
]


@settings(max_examples=300, deadline=None)
@given(raw=st.one_of(st.binary(max_size=200), st.sampled_from(PICKLES)), data=st.data())
def test_any_bytes_are_read_as_a_pickle_or_refused(raw, data):
    content = bytearray(raw)
    for place in data.draw(st.lists(st.integers(0, max(len(raw) - 1, 0)), max_size=3)) if raw else []:
        content[place] = data.draw(st.integers(0, 255))
    with contextlib.suppress(UnsafeFileError):
        read_pickle(bytes(content), Budget(10_000))


def test_pickles_that_grow_are_refused(saved, tmp_path):
    doubled: list = []
    for _ in range(200):  # 2**200 lists, in 200
        doubled = [doubled, doubled]
    itself: list = []
    itself.append(itself)
    for value in (doubled, itself):
        path = with_fields(saved, tmp_path / "x.zip", policy_kwargs=serialized({"net_arch": value}))
        assert "contains itself, or is nested too deeply" in refuse(path)
    raw = pickle.dumps(1 << 10_000)
    path = with_fields(saved, tmp_path / "x.zip", tau={":serialized:": base64.b64encode(raw).decode()})
    assert "an integer of 10,001 bits" in refuse(path)


# -------------------------------------------------------------------- normalisation and replay buffers


def test_normalisation_is_that_of_sb3(tmp_path, marker):
    path = tmp_path / "vecnormalize.pkl"
    env = VecNormalize(make_vec_env("Pendulum-v1", 2, seed=0), gamma=0.9, clip_obs=3.0, norm_reward=False)
    env.reset()
    for _ in range(20):
        env.step(np.ones((2, 1)))
    env.save(str(path))
    opened, reference = load_normalization(path, env.venv), VecNormalize.load(str(path), env.venv)
    observations, rewards = np.random.RandomState(0).randn(5, 3), np.arange(5.0)
    np.testing.assert_array_equal(opened.normalize_obs(observations), reference.normalize_obs(observations))
    np.testing.assert_array_equal(opened.normalize_reward(rewards), reference.normalize_reward(rewards))
    assert (opened.gamma, opened.clip_obs, opened.norm_reward, opened.training) == (0.9, 3.0, False, True)

    with pytest.raises(UnsafeFileError, match="obs_rms are not those of"):
        load_normalization(path, make_vec_env("MountainCarContinuous-v0"))
    for name in ("obs_rms", "gamma", "norm_obs_keys", "training"):
        poisoned = VecNormalize.load(str(path), env.venv)
        setattr(poisoned, name, Poison())
        poisoned.save(str(path.with_name("poisoned.pkl")))
        with pytest.raises(UnsafeFileError, match=r"builtins\.exec|must be"):
            load_normalization(path.with_name("poisoned.pkl"), env.venv)
    for broken in (pickle.dumps(Poison()), path.read_bytes()[:-9], b"", pickle.dumps({})):
        path.write_bytes(broken)
        with pytest.raises(UnsafeFileError):
            load_normalization(path, env.venv)
    assert not marker.exists()


@pytest.mark.parametrize("name", ["clip_obs", "clip_reward"])
def test_normalisation_without_clipping(tmp_path, name):
    env = VecNormalize(make_vec_env("Pendulum-v1"), **{name: np.inf})
    env.save(str(tmp_path / "vecnormalize.pkl"))
    assert getattr(load_normalization(tmp_path / "vecnormalize.pkl", env.venv), name) == np.inf
    for field, value in ((name, np.nan), (name, -np.inf), ("epsilon", np.inf)):
        poisoned = VecNormalize(env.venv)
        setattr(poisoned, field, value)
        poisoned.save(str(tmp_path / "poisoned.pkl"))
        with pytest.raises(UnsafeFileError, match=f"{field} must be a finite number"):
            load_normalization(tmp_path / "poisoned.pkl", env.venv)


@pytest.mark.parametrize("name", ["tdc", "tdc-stochastic", "tdc-dict", "tdc-her"])
def test_a_replay_buffer_is_that_of_sb3(tmp_path, marker, name):
    model = MODELS[name]()
    path = tmp_path / "replay_buffer.pkl"
    model.save_replay_buffer(path)
    opened, reference = (MODELS[name]() for _ in range(2))
    opened.learn(30)
    load_replay_buffer(path, opened)
    reference.load_replay_buffer(path)
    batches = []
    for of in (opened, reference):
        np.random.seed(0)
        batches.append(str(of.replay_buffer.sample(16)))
    assert batches[0] == batches[1]
    opened.learn(30)

    small = MODELS[name]()
    small.buffer_size, small.replay_buffer = 100, None
    small._setup_model()
    with pytest.raises(UnsafeFileError, match=rf"its buffer_size is {model.buffer_size}, and that of this run is 100$"):
        load_replay_buffer(path, small)
    for attribute in ("observations", "pos", "rewards"):
        poisoned = MODELS[name]()
        setattr(poisoned.replay_buffer, attribute, Poison())
        poisoned.save_replay_buffer(path)
        with pytest.raises(UnsafeFileError):
            load_replay_buffer(path, opened)
    path.write_bytes(pickle.dumps(Poison()))
    with pytest.raises(UnsafeFileError, match="does not hold a"):
        load_replay_buffer(path, opened)
    assert not marker.exists()


class Weighted(BitFlippingEnv):
    """An environment whose rewards depend on its infos."""

    def step(self, action):
        *results, info = super().step(action)
        kinds = {"weight": np.float32(0.1), "parts": [1, (2.5, None)], "name": "left", "of": {"forces": np.arange(3.0)}}
        return *results, {**info, **kinds}

    def compute_reward(self, achieved_goal, desired_goal, info):
        if info is None:  # in a step of the environment
            return super().compute_reward(achieved_goal, desired_goal, info)
        return np.array([each["weight"] * each["of"]["forces"].sum() for each in info])


def weighted(copies=True, **kwargs):
    env = Weighted(n_bits=3, continuous=True)
    kwargs = {**HER, **TINY, "replay_buffer_kwargs": {"copy_info_dict": copies}, **kwargs}
    return SAC("MultiInputPolicy", env, policy_kwargs={"net_arch": [4]}, **kwargs)


def test_infos_of_hindsight_are_those_of_sb3(tmp_path, marker):
    path = tmp_path / "buffer.pkl"
    model = weighted().learn(60)
    model.save_replay_buffer(path)
    opened, reference = weighted(), weighted()
    load_replay_buffer(path, opened)
    reference.load_replay_buffer(path)
    assert str(opened.replay_buffer.infos.tolist()) == str(reference.replay_buffer.infos.tolist())
    assert type(opened.replay_buffer.infos[5, 0]["weight"]) is np.float32
    opened.learn(30)  # rewards of new goals are computed with them

    for poison in (Poison(), collections.deque([1]), [{"object": pickle.Pickler}], np.array([None])):
        model.replay_buffer.infos[7, 0]["contact"] = poison
        model.save_replay_buffer(path)
        with pytest.raises(UnsafeFileError, match=r"infos \(copy_info_dict\), which may hold .*: (a|an) "):
            load_replay_buffer(path, opened)
    del model.replay_buffer.infos[7, 0]["contact"]
    model.replay_buffer.infos = model.replay_buffer.infos[:50]
    model.save_replay_buffer(path)
    with pytest.raises(UnsafeFileError, match="its infos are not those of this run"):
        load_replay_buffer(path, opened)
    model.replay_buffer.infos[3, 0] = 3
    model.save_replay_buffer(path)
    with pytest.raises(UnsafeFileError, match="something else than a mapping for each transition"):
        load_replay_buffer(path, opened)
    weighted(copies=False).save_replay_buffer(path)
    with pytest.raises(UnsafeFileError, match="saved without copy_info_dict, which this run has"):
        load_replay_buffer(path, opened)
    assert not marker.exists()


@pytest.mark.parametrize("name", ["optimize_memory_usage", "handle_timeout_termination"])
def test_a_replay_buffer_that_samples_otherwise_is_refused(tmp_path, name):
    def learned(value):
        both = {"optimize_memory_usage": False, "handle_timeout_termination": False, name: value}
        of_buffer = {"handle_timeout_termination": both.pop("handle_timeout_termination")}
        return pendulum(TDC, n=20, replay_buffer_kwargs=of_buffer, **both)

    for saved, of_run in ((True, False), (False, True)):
        learned(saved).save_replay_buffer(tmp_path / "buffer.pkl")
        model = learned(of_run)
        before = model.replay_buffer.observations.copy()
        with pytest.raises(UnsafeFileError, match=f"it was saved with {name}={saved}, this run has {of_run}$"):
            load_replay_buffer(tmp_path / "buffer.pkl", model)
        np.testing.assert_array_equal(model.replay_buffer.observations, before)
    load_replay_buffer(tmp_path / "buffer.pkl", learned(saved))


def test_infos_of_tens_of_thousands_of_transitions_are_not_too_many(tmp_path):
    model = weighted(buffer_size=50_000)
    for i in range(50_000):
        model.replay_buffer.infos[i, 0] = {"TimeLimit.truncated": False, "is_success": 0.0, "distance": i / 10, "n": i}
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    opened = weighted(buffer_size=50_000)
    load_replay_buffer(tmp_path / "buffer.pkl", opened)
    assert opened.replay_buffer.infos[-1, 0]["n"] == 49_999


def test_observations_of_the_fused_update_load_into_a_fresh_model(tmp_path):
    """The fused update keeps them as float32, like its packed rows; a new buffer, as float64, like the environment."""
    model = TDC("MlpPolicy", "Hopper-v4", fused=True, policy_kwargs={"net_arch": [8, 8]}, **TINY).learn(60)
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    fresh = TDC("MlpPolicy", "Hopper-v4", policy_kwargs={"net_arch": [8, 8]}, **TINY)
    assert fresh.replay_buffer.observations.dtype == np.float64
    load_replay_buffer(tmp_path / "buffer.pkl", fresh)
    assert np.array_equal(fresh.replay_buffer.observations, model.replay_buffer.observations)
    fresh.learn(60, reset_num_timesteps=False)
    load_replay_buffer(tmp_path / "buffer.pkl", model)
    for dtype in (np.float16, np.int8):
        other = TDC("MlpPolicy", "Hopper-v4", policy_kwargs={"net_arch": [8, 8]}, **TINY)
        other.replay_buffer.rewards = other.replay_buffer.rewards.astype(dtype)
        other.save_replay_buffer(tmp_path / "other.pkl")
        with pytest.raises(
            UnsafeFileError, match=f"rewards are not those of this run: {np.dtype(dtype)} .*, not float32"
        ):
            load_replay_buffer(tmp_path / "other.pkl", fresh)


# -------------------------------------------------------------------- enjoy.py and train.py


@pytest.fixture
def run(tmp_path):
    small = [*SMALL, "normalize:true"]
    assert run_train(tmp_path, "--save-replay-buffer", small=small) == 0
    return tmp_path / "tdc" / "Hopper-v4_1"


def test_enjoy_runs_nothing_unless_it_is_trusted(run, marker, capsys):
    assert run_enjoy(run) == 0
    safely = capsys.readouterr()
    assert run_enjoy(run, "--trust") == 0
    trusting = capsys.readouterr()
    assert trusting.out == safely.out  # the same returns
    assert "--trust: whatever code these files hold runs with your rights" in trusting.err
    assert safely.err == ""

    model, normalization = run / "Hopper-v4.zip", run / "Hopper-v4" / "vecnormalize.pkl"
    poisoned = with_fields(model, run / "poisoned", gamma=serialized(Poison())).read_bytes()
    for path, content, message in (
        (
            model,
            poisoned,
            "the field gamma (if you know its origin, enjoy, evaluate and train open it with --trust): "
            "a call of builtins.exec",
        ),
        (normalization, pickle.dumps(Poison()), "it does not hold a VecNormalize"),
    ):
        good = path.read_bytes()
        path.write_bytes(content)
        with pytest.raises(SystemExit):
            run_enjoy(run)
        assert f"{path} was not opened: {message}" in capsys.readouterr().err
        assert not marker.exists()
        with contextlib.suppress(Exception, SystemExit):  # what the poison returns is no model
            run_enjoy(run, "--trust")
        assert marker.exists()
        marker.unlink()
        path.write_bytes(good)


def test_going_on_runs_nothing_unless_it_is_trusted(run, tmp_path, marker, capsys):
    buffer = run / "replay_buffer.pkl"
    buffer.write_bytes(pickle.dumps(Poison()))
    small = [*SMALL, "normalize:true"]
    with pytest.raises(SystemExit):
        run_train(tmp_path, "-i", run / "Hopper-v4.zip", small=small)
    assert "replay_buffer.pkl was not opened: it does not hold a ReplayBuffer" in capsys.readouterr().err
    assert not marker.exists()


def test_a_run_of_others_imports_nothing_that_is_not_named(run, tmp_path, monkeypatch, marker, capsys):
    (tmp_path / "evil.py").write_text("import os, pathlib; pathlib.Path(os.environ['MARKER']).touch()")
    monkeypatch.syspath_prepend(tmp_path)
    files = {name: run / "Hopper-v4" / name for name in ("args.yml", "config.yml")}
    good = {name: yaml.safe_load(path.read_text()) for name, path in files.items()}
    for name, change, message in (
        ("args.yml", {"gym_packages": ["evil"]}, "add --gym-packages evil"),
        ("args.yml", {"env": "evil:Hopper-v4"}, "add --gym-packages evil"),
        ("config.yml", {"env_wrapper": "evil.Wrapper"}, "asks for env_wrapper evil.Wrapper"),
        ("config.yml", {"env_wrapper": [{"evil.Wrapper": {}}]}, "asks for env_wrapper evil.Wrapper"),
        ("config.yml", {"vec_env_wrapper": ["subprocess.Popen"]}, "asks for vec_env_wrapper subprocess.Popen"),
    ):
        files[name].write_text(yaml.safe_dump({**good[name], **change}))
        with pytest.raises(SystemExit):
            run_enjoy(run)
        assert message in capsys.readouterr().err
        files[name].write_text(yaml.safe_dump(good[name]))
    files["config.yml"].write_text("!!python/object/apply:os.system [true]")
    with pytest.raises(SystemExit):
        run_enjoy(run)
    assert "is not YAML of plain values" in capsys.readouterr().err
    files["config.yml"].write_text(yaml.safe_dump({**good["config.yml"], "policy": "evil.P", "callback": "evil.C"}))
    assert run_enjoy(run) == 0  # neither is needed to watch
    assert not marker.exists()
    files["args.yml"].write_text(yaml.safe_dump({**good["args.yml"], "gym_packages": ["evil"]}))
    assert run_enjoy(run, "--gym-packages", "evil") == 0
    assert marker.exists()


def test_a_folder_of_rl_zoo_opens(tmp_path, monkeypatch, capsys):
    pytest.importorskip("rl_zoo3")
    conf = tmp_path / "td3.yml"
    conf.write_text(
        "Pendulum-v1:\n  n_timesteps: 250\n  policy: MlpPolicy\n  normalize: true\n  learning_rate: lin_1e-3\n"
        "  noise_type: normal\n  noise_std: 0.1\n  learning_starts: 50\n  batch_size: 16\n  buffer_size: 1000\n"
        '  policy_kwargs: "dict(net_arch=[16, 16])"\n'
    )
    from rl_zoo3.train import train as zoo_train

    argv = ["--algo", "td3", "--env", "Pendulum-v1", "-f", str(tmp_path), "-conf", str(conf), "--eval-freq", "100"]
    monkeypatch.setattr("sys.argv", ["train", *argv, "--eval-episodes", "1", "--device", "cpu", "--seed", "1"])
    zoo_train()
    capsys.readouterr()
    for arguments in ([], ["--load-best"]):
        assert run_enjoy(tmp_path / "td3" / "Pendulum-v1_1", *arguments) == 0
        assert "mean ± std of 2 episodes" in capsys.readouterr().out
    assert enjoy.make_parser().parse_args(["x"]).trust is False


# -------------------------------------------------------------------- code in fields that are not used, and inspection


def test_code_in_a_field_that_is_not_read_is_named(saved, tmp_path, marker):
    path = with_fields(saved, tmp_path / "x.zip", lr_schedule=serialized(Poison()), _last_obs=serialized(np.zeros(3)))
    with pytest.warns(
        RuntimeWarning, match=r"The field 'lr_schedule' is not used here, but .* builtins\.exec$"
    ) as told:
        assert load_safely(path, device="cpu").num_timesteps > 0
    assert len([w for w in told if issubclass(w.category, RuntimeWarning)]) == 1
    with pytest.warns(RuntimeWarning, match=r"The field 'lam' is not used here"):
        load_safely(with_fields(saved, path, lam=serialized(Poison())), device="cpu", custom_objects={"lam": 0.5})
    assert not marker.exists()


def call(function, *args):
    return function + Op.tuple_of(*args) + Op.REDUCE


def attribute(of, name):
    return call(Op.name("builtins", "getattr"), of, Op.text(name))


_STEP = attribute(Op.name("stable_baselines3.common.type_aliases", "TrainFrequencyUnit"), "STEP")
_RUNS = Op.name("builtins", "exec"), Op.text("import os, pathlib; pathlib.Path(os.environ['MARKER']).touch()")


def code_of_known_names():
    """``Box.sample.__globals__.get("__builtins__").get("exec")(…)``, of names that are all known."""
    known = attribute(attribute(Op.name("gymnasium.spaces.box", "Box"), "sample"), "__globals__")
    builtins = call(attribute(known, "get"), Op.text("__builtins__"))
    return call(call(attribute(builtins, "get"), Op.text("exec")), _RUNS[1], Op.EMPTY_DICT)


@pytest.mark.parametrize(
    ("field", "found"),
    [
        (code_of_known_names(), ["builtins.getattr", "what another call returns"]),
        (call(*_RUNS) + Op.POP + Op.NONE, ["builtins.exec"]),  # the value does not hold what was called
        (
            Op.EMPTY_DICT + Op.text("a") + call(*_RUNS) + Op.SETITEM + Op.text("a") + Op.NONE + Op.SETITEM,
            ["builtins.exec"],
        ),
        (_STEP + Op.EMPTY_DICT + Op.BUILD, ["builtins.getattr"]),  # it would change the enum
        (_STEP, []),
    ],
    ids=["known names", "dropped", "replaced", "an enum that is changed", "an enum"],
)
def test_code_in_a_field_is_found_by_how_names_are_called(saved, tmp_path, marker, field, found):
    path = with_fields(saved, tmp_path / "x.zip", start_time=pickled(Op.PROTO + field + Op.STOP))
    assert foreign_names(fields_of(path)["start_time"], Budget(10_000)) == found
    assert names_code(path) == bool(found)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", RuntimeWarning)
        load_safely(path, device="cpu")
    assert any("'start_time' is not used here, but" in str(each.message) for each in told) == bool(found)
    assert not marker.exists()
    with contextlib.suppress(Exception):  # the control: SB3 runs it
        TDC.load(path, device="cpu")
    assert marker.exists() == any(name != "builtins.getattr" for name in found)


def test_code_in_statistics_is_found_by_how_names_are_called(tmp_path, capsys):
    (tmp_path / "stats.pkl").write_bytes(pickle.dumps(frames(), 2)[:-1] + code_of_known_names() + Op.POP + Op.STOP)
    _, out = inspected(tmp_path / "stats.pkl", capsys)
    assert re.search(r"not used here:\n(  .*\n)*  builtins\.getattr\n(  .*\n)*  what another call returns\n", out)


def test_an_object_that_is_changed_twice_is_refused():
    changed = Op.name("gymnasium.spaces.box", "Box") + Op.EMPTY_TUPLE + Op.REDUCE + Op.EMPTY_DICT + Op.BUILD
    with pytest.raises(UnsafeFileError, match="changed twice"):
        read_pickle(Op.PROTO + changed + Op.NONE + Op.BUILD + Op.STOP, Budget(10_000))


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("name", MODELS)
def test_nothing_is_named_of_what_sb3_writes(tmp_path, name):
    model = MODELS[name]()
    model.save(tmp_path / "model.zip")
    load_safely(tmp_path / "model.zip", model.get_env() if "her" in name else None, device="cpu")


def test_a_strategy_of_hindsight_as_an_enum(tmp_path):
    kwargs = {**HER, "replay_buffer_kwargs": {"goal_selection_strategy": GoalSelectionStrategy.FINAL}}
    TDC("MultiInputPolicy", goal_env(), **kwargs, **TINY).learn(40).save(tmp_path / "model.zip")
    model = load_safely(tmp_path / "model.zip", goal_env(), device="cpu")
    assert model.replay_buffer.goal_selection_strategy is GoalSelectionStrategy.FINAL


def inspected(path, capsys):
    status = inspect.main([str(path)])
    return status, capsys.readouterr().out


def test_a_file_can_be_inspected(saved, tmp_path, marker, capsys):
    status, out = inspected(saved, capsys)
    assert status == 0
    assert re.search(r"policy\.pth +[\d,]+ bytes", out)
    assert "Code: none that SB3's own load would import" in out
    assert "Would be opened as a TDC of 60 steps." in out

    path = with_fields(saved, tmp_path / "x.zip", lr_schedule=serialized(Poison()), lam=serialized(lambda left: 1.0))
    status, out = inspected(path, capsys)
    assert status == 1
    assert re.search(r"lr_schedule +builtins\.exec\n", out)
    assert re.search(r"lam +cloudpickle\.", out)
    assert "Refused: the field lam" in out
    assert len(out.splitlines()) < 30
    assert not marker.exists()


def test_a_model_with_a_hindsight_buffer_can_be_inspected(tmp_path, marker, capsys):
    TDC("MultiInputPolicy", goal_env(), **HER, **TINY).learn(40).save(tmp_path / "model.zip")
    status, out = inspected(tmp_path / "model.zip", capsys)
    assert (status, out.splitlines()[-1]) == (0, "Would be opened as a TDC of 40 steps.")
    path = with_fields(tmp_path / "model.zip", tmp_path / "x.zip", replay_buffer_kwargs=serialized(Poison()))
    status, out = inspected(path, capsys)
    assert (status, "Refused: the field replay_buffer_kwargs" in out, marker.exists()) == (1, True, False)


def test_statistics_buffers_and_folders_can_be_inspected(run, tmp_path, marker, capsys):
    assert inspected(run, capsys)[0] == 0
    (tmp_path / "stats.pkl").write_bytes(pickle.dumps(frames()))
    status, out = inspected(tmp_path / "stats.pkl", capsys)
    assert "a pickle of stable_baselines3.common.vec_env.vec_normalize.VecNormalize" in out
    (tmp_path / "evil.pkl").write_bytes(pickle.dumps(Poison()))
    status, out = inspected(tmp_path / "evil.pkl", capsys)
    assert (status, "Refused: builtins.exec is not known here." in out) == (1, True)
    with pytest.raises(SystemExit):
        inspect.main([])
    assert not marker.exists()


def made_folder(folder, **args):
    """Return the folder of a run that has no models yet."""
    run = RunFolder.create(folder, "tdc", "Pendulum-v1")
    run.write_config(
        {"n_timesteps": 60}, {"algo": "tdc", "env": "Pendulum-v1", "gym_packages": [], "env_kwargs": {}, **args}
    )
    return run


@pytest.mark.parametrize(
    "name",
    [
        *("Pendulum-v1.zip", "best_model.zip", "rl_model_20_steps.zip", "Pendulum-v1/trained_agent.zip"),
        *("Pendulum-v1/vecnormalize.pkl", "best_model_vecnormalize.pkl", "rl_model_vecnormalize_20_steps.pkl"),
        *("replay_buffer.pkl", "rl_model_replay_buffer_20_steps.pkl"),
    ],
)
def test_every_file_of_a_folder_is_inspected(saved, tmp_path, marker, name, capsys):
    run = made_folder(tmp_path)
    shutil.copy(saved, run.model)
    assert inspected(run.path, capsys)[0] == 0
    if name.endswith(".zip"):
        with_fields(saved, run.path / name, lam=serialized(Poison()))
    else:
        (run.path / name).write_bytes(pickle.dumps(Poison()))
    status, out = inspected(run.path, capsys)
    assert (status, out.count("Refused: "), marker.exists()) == (1, 1, False)
    assert f"{run.path / name}: " in out
    assert "builtins.exec" in out


def test_a_folder_of_an_unknown_algorithm_or_without_models_is_refused(saved, tmp_path, capsys):
    empty, unknown = made_folder(tmp_path), made_folder(tmp_path, algo="tcd")
    assert inspected(empty.path, capsys)[0] == 1
    shutil.copy(saved, unknown.model)
    status, out = inspected(unknown.path, capsys)
    assert (status, "algo must be one of tdc, " in out) == (1, True)
    assert "Would be opened as a TDC of 60 steps." in out


class ReplayBuffer:
    """A class named like SB3's, in another module, which SB3's own load would import."""


def test_a_pickle_is_known_by_its_module_too(tmp_path, capsys):
    (tmp_path / "buffer.pkl").write_bytes(pickle.dumps(ReplayBuffer()))
    status, out = inspected(tmp_path / "buffer.pkl", capsys)
    name = f"{ReplayBuffer.__module__}.ReplayBuffer"
    assert (status, f"Refused: {name} is not known here." in out) == (1, True)
    assert f"  {name}\n" in out


def test_a_model_is_inspected_as_the_algorithm_that_is_named(tmp_path, capsys):
    path = tmp_path / "model.zip"
    model = CalibratedTDC("MlpPolicy", "Pendulum-v1", **TINY)
    model._calibrate(np.array([1.0]))
    model.save(path)
    assert "Refused: the field '_calibrated' is unknown" in inspected(path, capsys)[1]
    assert inspect.main([str(path), "--algo", "tdc-auto"]) == 0
    assert "Would be opened as a CalibratedTDC of 0 steps." in capsys.readouterr().out
    run = RunFolder.create(tmp_path, "tdc-auto", "Pendulum-v1")
    run.write_config({"n_timesteps": 60}, {"algo": "tdc-auto", "env": "Pendulum-v1", "seed": 1, "gym_packages": []})
    shutil.copy(path, run.model)
    assert "Would be opened as a CalibratedTDC of 0 steps." in inspected(run.path, capsys)[1]


def test_what_is_nothing_of_this_is_one_sentence(run, tmp_path, capsys):
    (tmp_path / "text.txt").write_text("hello")
    (tmp_path / "empty").mkdir()
    for name, sentence in (
        ("nothing", "inspect: error: {path} does not exist\n"),
        ("text.txt", "inspect: error: {path}: a damaged pickle; it must be a zip of a model, a pickle of VecNormalize"),
        ("empty", "inspect: error: {path} is not the folder of a run: it has no <environment>/config.yml\n"),
    ):
        with pytest.raises(SystemExit) as stopped:
            inspect.main([str(tmp_path / name)])
        assert stopped.value.code == 2
        assert sentence.format(path=tmp_path / name) in capsys.readouterr().err

    (run / "Hopper-v4.zip").write_bytes((run / "Hopper-v4.zip").read_bytes()[:-100])  # the best model is still shown
    status, out = inspected(run, capsys)
    assert status == 1
    assert f"Refused: {run / 'Hopper-v4.zip'}: " in out
    assert "Would be opened as a TDC of 300 steps." in out or "Would be opened as a TDC of 150 steps." in out


@pytest.mark.parametrize("name", [name for name in MODELS if not name.startswith("ddpg")])
def test_every_field_that_is_required_is_written_by_sb3_and_refused_without(tmp_path, name):
    MODELS[name]().save(tmp_path / "model.zip")
    fields = fields_of(tmp_path / "model.zip")
    declared = saved_fields(ALGORITHMS[name.split("-")[0]])
    required = sorted(field for field, how in declared.items() if how.is_required)
    assert {"gamma", "learning_rate", "_n_updates"} < set(required) <= set(fields)
    left_out = required[sum(map(ord, name)) % 10]  # chosen by the name of the model
    data = {field: value for field, value in fields.items() if field != left_out}
    error = refuse(rewrite(tmp_path / "model.zip", tmp_path / "x.zip", data=json.dumps(data)))
    assert f"the field {left_out} is missing" in error or left_out == "policy_class"


def test_plain_quantile_regression_opens(tmp_path):
    pendulum(TDC, kappa=0.0).save(tmp_path / "model.zip")
    assert load_safely(tmp_path / "model.zip", device="cpu").kappa == 0


def without(source, target, name):
    return rewrite(source, target, data=json.dumps({k: v for k, v in fields_of(source).items() if k != name}))


@pytest.mark.parametrize(("name", "value"), [("gamma", 0.5), ("ent_coef", 0.25), ("policy_class", TDCPolicy)])
def test_custom_objects_give_a_field_that_is_missing(saved, tmp_path, name, value):
    path = without(saved, tmp_path / "x.zip", name)
    opened = load_safely(path, device="cpu", custom_objects={name: value, "clip_range": 0.2})
    assert getattr(opened, name) == value
    assert not hasattr(opened, "clip_range")  # as SB3's load ignores what is a field of other algorithms
    if name == "ent_coef":
        assert opened.log_ent_coef is None
        assert opened.ent_coef_tensor.item() == 0.25


def test_a_field_of_another_algorithm_is_unknown(tmp_path):
    MODELS["td3"]().save(tmp_path / "model.zip")
    path = with_fields(tmp_path / "model.zip", tmp_path / "x.zip", lam=1.0)
    assert "the field 'lam' is unknown" in refuse(path)
