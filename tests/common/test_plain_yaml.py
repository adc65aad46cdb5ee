"""One reader for everything that users write: numbers as in YAML 1.2, RL Zoo's Python notation, nothing evaluated."""

import importlib.util
import math
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3 import SAC
from stable_baselines3.common.monitor import Monitor

from sb3_tdc import TDC
from sb3_tdc.algorithms import ALGORITHMS
from sb3_tdc.cli.train import make_parser
from sb3_tdc.common import plain_yaml
from sb3_tdc.envs.make import make_envs
from sb3_tdc.experiments.search_space import parse_space
from sb3_tdc.hyperparams import parse, read_entry
from sb3_tdc.runs.folder import RunFolder


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 0.001), ("1E6", 1e6), ("-2e+2", -200.0), ("1.5", 1.5), ("1.", 1.0), (".5", 0.5), ("-.5e3", -500.0),
        ("1_000_000", 1_000_000), ("12", 12), ("-3", -3), ("0x10", 16), (".inf", math.inf), ("-.inf", -math.inf),
        ("1e", "1e"), ("e3", "e3"), ("1e-3x", "1e-3x"), ("'1e-3'", "1e-3"), (".", "."), ("v1.2.3", "v1.2.3"),
        ("12:30.5", "12:30.5"), ("true", True), ("null", None), ("lin_3e-4", "lin_3e-4"), ("_1", "_1"),
    ],
)  # fmt: skip
def test_scalars(text, value):
    for content, expected in ((text, value), (f"[{text}]", [value]), (f"a: {{b: [{text}]}}", {"a": {"b": [value]}})):
        read = plain_yaml.load(content, "")
        assert read == expected
        assert type(read) is type(expected)
    assert type(plain_yaml.load(text, "")) is type(value)


plain = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text()
number_like = st.from_regex(r"[-+0-9_.eE:xinfaN]{1,8}", fullmatch=True)
nested = st.recursive(plain | number_like, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner))


@given(nested)
def test_what_is_written_is_read(value):
    assert plain_yaml.load(plain_yaml.dump(value), "") == value
    assert yaml.safe_load(plain_yaml.dump(value)) == value  # RL Zoo's reader finds the same


def test_a_key_that_is_given_twice_is_refused_with_its_line():
    with pytest.raises(ValueError, match=r"my.yml is not YAML of plain values: line 3 gives lam a second time"):
        plain_yaml.load("A-v0:\n  lam: 1\n  lam: 2", "my.yml")
    with pytest.raises(ValueError, match=r"gives \\x1b\[31m a second time"):  # the terminal never sees the escape
        plain_yaml.load('"\\e[31m": 1\n"\\e[31m": 2', "my.yml")
    # A key may override a merged one, even where the merged mapping itself merges another: it is not given twice
    text = "a: &a {x: 1, y: 1}\nb: &b {<<: *a, x: 2}\nc: {<<: *b, x: 3, 1: 4, '1': 5}"
    assert plain_yaml.load(text, "")["c"] == {"x": 3, "y": 1, 1: 4, "1": 5}


def test_every_place_reads_numbers_alike(tmp_path):
    args = make_parser().parse_args(
        ["--env-kwargs", "a:{b: [1e-3]}", "--eval-env-kwargs", "a:1e3", "-params", "policy_kwargs:{log_std_init: -3e0}"]
    )
    assert args.env_kwargs == {"a": {"b": [0.001]}}
    assert args.eval_env_kwargs == {"a": 1000.0}
    assert args.hyperparams == {"policy_kwargs": {"log_std_init": -3.0}}
    path = tmp_path / "my.yml"
    path.write_text("A-v0: {n_timesteps: 1e6, normalize: {epsilon: 1e-5}, env_wrapper: {my.Wrapper: {scale: 1e-2}}}")
    entry, _ = read_entry(path, "A-v0")
    assert (entry["n_timesteps"], entry["normalize"]["epsilon"]) == (1e6, 1e-5)
    assert entry["env_wrapper"]["my.Wrapper"]["scale"] == 0.01
    assert parse_space(["policy_kwargs:[{optimizer_kwargs: {eps: 1e-5}}]"]) == {
        "policy_kwargs": [{"optimizer_kwargs": {"eps": 1e-5}}]
    }
    folder = RunFolder.create(tmp_path, "tdc", "A-v0")
    folder.write_config({"x": "1e-3", "y": 1e-3}, {})
    assert folder.config == {"x": "1e-3", "y": 0.001}


# ---------------------------------------------------------------- RL Zoo's Python notation


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("dict(net_arch=[400, 300])", {"net_arch": [400, 300]}),
        ("{'norm_obs': True, 'norm_reward': False}", {"norm_obs": True, "norm_reward": False}),
        ("dict(log_std_init=-3.67, net_arch=dict(pi=[64], qf=(400, 300)))",
         {"log_std_init": -3.67, "net_arch": {"pi": [64], "qf": [400, 300]}}),
        (" dict( activation_fn=nn.ReLU, n=None ) ", {"activation_fn": "nn.ReLU", "n": None}),
        ("dict(optimizer_class=th.optim.RMSprop, optimizer_kwargs=dict(eps=1e-5, alpha=+0.99))",
         {"optimizer_class": "th.optim.RMSprop", "optimizer_kwargs": {"eps": 1e-5, "alpha": 0.99}}),
    ],
)  # fmt: skip
def test_notation(text, value):
    assert plain_yaml.read_notation(text) == value


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os').system('true')", "dict([('a', 1)])", "dict(**{'a': 1})", "dict(a=open('x'))",
        "[x for x in 'a']",
        "{**{}}", "lambda: 0", "f'{1}'", "1 + 1", "'a' * 10**9", "(1).__class__", "dict(a=1", "", "b'x'", "{1: 2}[1]",
        "(" * 300, "...", "1j", "{[1]: 2}",
    ],
)  # fmt: skip
def test_everything_else_is_refused(text):
    with pytest.raises(ValueError, match="literal"):
        plain_yaml.read_notation(text)


def test_hyperparameters_in_notation():
    entry = {
        "n_timesteps": 1,
        "policy_kwargs": "dict(log_std_init=-3, net_arch=[32], activation_fn=nn.ELU, optimizer_class=th.optim.AdamW)",
        "normalize": "{'norm_obs': True, 'norm_reward': False}",
        "replay_buffer_kwargs": "dict(handle_timeout_termination=False)",
        "env_kwargs": "dict(g=9.81)",
    }
    parsed = parse(entry, SAC, "file.yml")
    import torch as th

    assert parsed.model["policy_kwargs"] == {
        "log_std_init": -3.0,
        "net_arch": [32],
        "activation_fn": th.nn.ELU,
        "optimizer_class": th.optim.AdamW,
    }
    assert parsed.normalize == {"gamma": 0.99, "norm_obs": True, "norm_reward": False}
    assert parsed.model["replay_buffer_kwargs"] == {"handle_timeout_termination": False}
    assert parsed.env_kwargs == {"g": 9.81}
    with pytest.raises(ValueError, match=r"normalize must be .*neither a literal nor dict"):
        parse({"n_timesteps": 1, "normalize": "dict(norm_obs=open('x'))"}, SAC, "file.yml")


# Entries whose wrappers are in modules that have been removed, or that RL Zoo does not depend on
_ELSEWHERE = {("sac", "CarRacing-v3"), ("sac", "donkey-generated-track-v0")}


@pytest.mark.skipif(importlib.util.find_spec("rl_zoo3") is None, reason="needs rl_zoo3")
@pytest.mark.parametrize("algo", ["sac", "td3", "ddpg"])
def test_every_entry_of_rl_zoo_is_read(algo):
    path = Path(importlib.util.find_spec("rl_zoo3").origin).parent / "hyperparams" / f"{algo}.yml"
    entries = plain_yaml.load(path.read_text(), str(path))
    assert len(entries) > 10
    for env_id in (env_id for env_id in entries if (algo, env_id) not in _ELSEWHERE):
        entry, _ = read_entry(path, env_id)
        parsed = parse(entry, ALGORITHMS[algo], str(path))
        assert parsed.n_timesteps == int(entry["n_timesteps"])


def test_a_monitor_takes_the_tuples_that_it_needs():
    entry = {"n_timesteps": 1, "monitor_kwargs": {"info_keywords": ["is_success"], "allow_early_resets": False}}
    parsed = parse(entry, TDC, "file.yml")
    assert parsed.monitor_kwargs == {"info_keywords": ("is_success",), "allow_early_resets": False}
    env = make_envs("Pendulum-v1", parsed, 1, 1)
    (monitor,) = env.get_attr("info_keywords")
    assert monitor == ("is_success",)
    assert isinstance(env.envs[0], Monitor)
    with pytest.raises(ValueError, match=r"monitor_kwargs: unknown key 'info_keyword'; did you mean 'info_keywords'"):
        parse({"n_timesteps": 1, "monitor_kwargs": {"info_keyword": []}}, TDC, "file.yml")
