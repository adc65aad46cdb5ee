"""YAML files: Table 1 as printed, the default under every entry, and the messages about mistakes."""

import re

import pytest
import torch as th
import yaml
from stable_baselines3 import DDPG, HerReplayBuffer
from stable_baselines3.common.utils import LinearSchedule

from sb3_tdc import TDC
from sb3_tdc.algorithms import ALGORITHMS
from sb3_tdc.common.checks import suggest
from sb3_tdc.hyperparams import hyperparams_file, parse, read_entry

# Table 1: steps, warm-up, λ, τ, learning rates of actor and critics
TABLE_1 = {
    "HalfCheetah-v4": (1_500_000, 25_000, 1.0, 0.005, 3e-4, 3e-4),
    "Walker2d-v4": (4_000_000, 30_000, 1.0, 0.005, 3e-4, 3e-4),
    "Humanoid-v4": (5_000_000, 5_000, 1.0, 0.0005, 3e-4, 2e-4),
    "Ant-v4": (4_000_000, 5_000, 0.9, 0.005, 2e-4, 2e-4),
    "Hopper-v4": (1_500_000, 5_000, 0.9, 0.005, 2e-4, 2e-4),
}


def parse_tdc(entry, algorithm=TDC):
    return parse({"n_timesteps": 1, **entry}, algorithm, "file.yml, Env-v0")


@pytest.mark.parametrize("env_id", TABLE_1)
def test_table_1(env_id):
    entry, name = read_entry(hyperparams_file("tdc"), env_id)
    assert name == env_id
    h = parse(entry, TDC, "")
    m = h.model
    rates = (m["learning_rate"], m["qf_learning_rate"])
    assert (h.n_timesteps, m["learning_starts"], m["lam"], m["tau"], *rates) == TABLE_1[env_id]
    assert (m["gamma"], m["kappa"], m["policy_delay"], m["batch_size"], m["buffer_size"]) == (0.99, 1, 2, 256, 10**6)
    assert (m["target_policy_noise"], m["target_noise_clip"]) == (0.2, 0.5)
    assert (h.noise_type, h.noise_std) == ("normal", 0.1)
    assert m["policy_kwargs"] == {"net_arch": [256, 256], "n_quantiles": 64}


# Warm-up, α, τ, upper limit of log σ
MEOW_TABLE = {
    "HalfCheetah-v4": (10_000, 0.25, 0.003, 2.0),
    "Hopper-v4": (5_000, 0.25, 0.005, -0.3),
    "Walker2d-v4": (10_000, 0.1, 0.005, -0.3),
    "Ant-v4": (5_000, 0.05, 0.0001, -0.3),
    "Humanoid-v4": (5_000, 0.125, 0.0005, -0.3),
}


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_every_file_is_valid_in_every_entry(algo):
    path = hyperparams_file(algo)
    for env_id in yaml.safe_load(path.read_text()):
        entry, _ = read_entry(path, env_id)
        h = parse(entry, ALGORITHMS[algo], str(path))
        if algo == "meow":  # as its authors ran it
            assert env_id == "default" or (h.n_timesteps, *_of_meow(h)) == (TABLE_1[env_id][0], *MEOW_TABLE[env_id])
            continue
        if h.n_envs == 1:
            assert h.model["policy_kwargs"]["net_arch"] == [256, 256]
        if env_id in TABLE_1:  # all algorithms have the same steps and warm-up
            assert (h.n_timesteps, h.model["learning_starts"]) == TABLE_1[env_id][:2]


def _of_meow(h):
    m, p = h.model, h.model["policy_kwargs"]
    assert (m["learning_rate"], m["gamma"], m["batch_size"], m["buffer_size"]) == (1e-3, 0.99, 256, 10**6)
    assert (m["max_grad_norm"], p["net_arch"], p["shift_arch"], p["log_std_min"]) == (30, [64, 64], [256, 256], -5)
    return m["learning_starts"], m["ent_coef"], m["tau"], p["log_std_max"]


def test_the_default_lies_under_every_entry(tmp_path):
    path = tmp_path / "my.yml"
    path.write_text("default: {n_timesteps: 7, lam: 0.5}\nA-v0: {lam: 0.2}\n")
    assert read_entry(path, "A-v0") == ({"n_timesteps": 7, "lam": 0.2}, "A-v0")
    assert read_entry(path, "B-v0") == ({"n_timesteps": 7, "lam": 0.5}, "default")


@pytest.mark.parametrize(
    ("env_id", "name"),
    [
        ("A-v2", "A-v2"),
        ("A-v3", "A-v2"),
        ("A-v4", "A-v6"),  # as near as A-v2, and newer
        ("A-v99", "A-v6"),
        ("A-v0", "A-v2"),
        ("A", "A-v6"),
        ("B-v1", "B"),
        ("my/A-v3", "my/A-v1"),
        ("AA-v2", "default"),
        ("A-vx", "default"),
        ("-v2", "default"),
    ],
)
def test_another_version_of_an_environment_gets_the_entry_of_the_nearest(tmp_path, env_id, name):
    path = tmp_path / "my.yml"
    names = ("default", "A-v2", "A-v6", "B", "my/A-v1")
    path.write_text("".join(f"{name}: {{n_timesteps: {i}}}\n" for i, name in enumerate(names)))
    assert read_entry(path, env_id) == ({"n_timesteps": names.index(name)}, name)


def test_without_a_default_the_nearest_version_is_enough(tmp_path):
    path = tmp_path / "my.yml"
    path.write_text("A-v2: {n_timesteps: 7}\n")
    assert read_entry(path, "A-v3") == ({"n_timesteps": 7}, "A-v2")


def test_values_become_what_the_constructor_wants():
    h = parse_tdc(
        {
            "n_timesteps": "1e6",
            "learning_rate": "3e-4",  # YAML reads this as a text
            "lam": "lin_0.9",
            "train_freq": [2, "episode"],
            "gradient_steps": -1,
            "ent_coef": 0.2,
            "action_noise": 0.3,
            "policy_kwargs": {
                "net_arch": {"pi": [8], "qf": [9]},
                "activation_fn": "nn.ELU",
                "optimizer_class": "AdamW",
            },
            "normalize": {"norm_reward": False},
            "gamma": 0.9,
            "replay_buffer_class": "HerReplayBuffer",
            "env_wrapper": [{"gymnasium.wrappers.TimeLimit": {"max_episode_steps": 5}}],
        }
    )
    assert (h.n_timesteps, h.model["learning_rate"], h.model["train_freq"]) == (1_000_000, 3e-4, (2, "episode"))
    assert isinstance(h.model["lam"], LinearSchedule)
    assert h.model["lam"](0.5) == pytest.approx(0.45)
    assert (h.model["ent_coef"], h.model["action_noise"]) == (0.2, 0.3)
    assert h.model["policy_kwargs"]["activation_fn"] is th.nn.ELU
    assert h.model["policy_kwargs"]["optimizer_class"] is th.optim.AdamW
    assert h.model["replay_buffer_class"] is HerReplayBuffer
    assert h.normalize == {"norm_reward": False, "gamma": 0.9}
    assert len(h.env_wrapper) == 1
    assert parse_tdc({"normalize": False}).normalize is None


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"learning_rte": 1}, "file.yml, Env-v0: unknown key 'learning_rte'; did you mean 'learning_rate'?"),
        ({"Lam": 1}, "unknown key 'Lam'; did you mean 'lam'?"),
        ({"seed": 1}, "file.yml, Env-v0: seed is not a hyperparameter; use --seed"),
        ({"policy_kwargs": {"device": "cpu"}}, "policy_kwargs: unknown key 'device'"),
        ({"zzz": 1}, "unknown key 'zzz'; known: policy, learning_rate, buffer_size, "),
        (
            {"normalize": {"foo": None}},
            "file.yml, Env-v0: normalize: unknown key 'foo'; known: training, norm_obs, norm_reward, clip_obs, "
            "clip_reward, gamma, epsilon, norm_obs_keys",
        ),
        ({"normalize": {"clip_obs": "x"}}, "normalize: clip_obs must be a number, got 'x'"),
        ({"monitor_kwargs": {"info_keyword": ["a"]}}, "unknown key 'info_keyword'; did you mean 'info_keywords'?"),
        ({"policy": "Foo"}, "unknown policy 'Foo'; known: MlpPolicy, CnnPolicy, MultiInputPolicy, or module.Class"),
        ({"gamma": "high"}, "file.yml, Env-v0: gamma must be a number, got 'high'"),
        ({"batch_size": 2.5}, "batch_size must be an integer, got 2.5"),
        ({"batch_size": float("inf")}, "batch_size must be an integer, got inf"),
        ({7: 1}, "unknown key 7"),
        ({"batch_size": True}, "batch_size must be an integer, got True"),
        ({"stochastic_actor": 1}, "stochastic_actor must be true or false, got 1"),
        (
            {"learning_rate": "sometimes"},
            "learning_rate must be a number or a schedule (\"lin_\" and a number), got 'sometimes'",
        ),
        ({"train_freq": [1, 2, 3]}, "train_freq must be an integer or a list of an integer, a text, got [1, 2, 3]"),
        (
            {"policy_kwargs": "dict(net_arch=range(2))"},
            "policy_kwargs must be a mapping or null, got 'dict(net_arch=range(2))' ('range(2)' is neither",
        ),
        ({"policy_kwargs": {"n_quantile": 3}}, "policy_kwargs: unknown key 'n_quantile'; did you mean 'n_quantiles'?"),
        ({"policy_kwargs": {"activation_fn": "os.system"}}, "activation_fn must be the name of a Module class"),
        ({"policy_kwargs": {"activation_fn": "ReLUU"}}, "'ReLUU' names no Module class"),
        ({"replay_buffer_class": "no.such.Buffer"}, "there is no module 'no'"),
        ({"policy": "MlpPolic"}, "unknown policy 'MlpPolic'; did you mean 'MlpPolicy'?"),
        ({"noise_type": "pink"}, "noise_type must be one of normal, ornstein-uhlenbeck, got 'pink'"),
        ({"noise_type": "normal"}, "noise_type normal requires noise_std"),
        (
            {"noise_type": "normal", "noise_std": 0.1, "action_noise": 0.1},
            "must be either action_noise, or noise_type and noise_std",
        ),
        ({"noise_std": 0.3}, "noise_std requires noise_type, one of normal, ornstein-uhlenbeck"),
        ({"n_envs": 0}, "n_envs must be an integer of at least 1, got 0"),
        ({"noise_type": "normal", "noise_std": -0.1}, "noise_std must be a finite number of at least 0.0, got -0.1"),
        ({"noise_std": float("nan")}, "noise_std must be a finite number of at least 0.0, got nan"),
        ({"noise_type": "normal", "noise_std": [0.1, -1]}, "noise_std must be a finite number of at least 0.0, got -1"),
        ({"train_freq": 0}, "file.yml, Env-v0: train_freq must be an integer of at least 1, got 0"),
        ({"train_freq": [0, "episode"]}, "train_freq must be an integer of at least 1, got 0"),
        ({"tau": 1.5}, "tau must be a finite number between 0.0 and 1.0, got 1.5"),
        ({"lam": -1}, "file.yml, Env-v0: lam must be a finite number of at least 0.0, got -1"),
        ({"learning_rate": "lin_-1e-3"}, "learning_rate must be a finite number of at least 0.0, got -0.001"),
        (
            {"policy_kwargs": {"net_arch": [64, -3]}},
            "file.yml, Env-v0: policy_kwargs: net_arch must be an integer of at least 1, got -3",
        ),
        ({"policy_kwargs": {"net_arch": {"pi": [8], "qf": [0]}}}, "net_arch must be an integer of at least 1, got 0"),
        ({"env_wrapper": "print"}, "env_wrapper must name a class"),
        (
            {"vec_env_wrapper": [{"stable_baselines3.common.vec_env.VecNormalize": {"gamma": 0.9}}]},
            "vec_env_wrapper: the statistics of VecNormalize are not saved with a model; use normalize",
        ),
        ({"env_wrapper": "gymnasium.wrappers.NormalizeObservation"}, "NormalizeObservation are not saved with a model"),
        ({"callback": {"a.B": {}, "c.D": {}}}, "callback must name a class, or map it to its keyword arguments"),
    ],
    ids=lambda value: str(value)[:40],
)
def test_mistakes_are_named(entry, message):
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        parse_tdc(entry)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("algo", ALGORITHMS)
@pytest.mark.parametrize("entry", [{"batch_size": 0}, {"gamma": 1.01}, {"buffer_size": -5}, {"learning_starts": -1}])
def test_numbers_are_checked_for_every_algorithm(algo, entry):
    """SB3's own constructors accept any number."""
    with pytest.raises(ValueError, match=f"file.yml, Env-v0: {next(iter(entry))} must be "):
        parse_tdc(entry, ALGORITHMS[algo])


def test_another_algorithm_has_another_schema():
    with pytest.raises(ValueError, match="unknown key 'lam'"):
        parse_tdc({"lam": 0.5}, DDPG)


def test_nothing_is_evaluated(tmp_path):
    path = tmp_path / "evil.yml"
    path.write_text(f"A-v0: {{n_timesteps: !!python/object/apply:pathlib.Path.touch [{tmp_path}/touched]}}")
    with pytest.raises(ValueError, match="is not YAML of plain values"):
        read_entry(path, "A-v0")
    with pytest.raises(ValueError, match="policy_kwargs must be a mapping"):
        parse_tdc({"policy_kwargs": f"open('{tmp_path}/touched', 'w')"})
    assert not (tmp_path / "touched").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "No such file"),
        ("[1, 2]", "must map environment ids to hyperparameters"),
        ("A-v0: 3", "must map environment ids to hyperparameters"),
        ("{", "is not YAML of plain values"),
        ("Hopper-v4: {lam: 1}", "has no entry for Hoper-v4 and no default; did you mean 'Hopper-v4'?"),
    ],
)
def test_files_that_cannot_be_used(tmp_path, text, message):
    path = tmp_path / "my.yml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ValueError, match=r"my\.yml") as error:
        read_entry(path, "Hoper-v4")
    assert message in str(error.value)


def test_a_preset_is_an_entry_and_never_a_version_of_one(tmp_path):
    path = tmp_path / "my.yml"
    path.write_text("default: {n_timesteps: 7}\nA-v0: {lam: 0.2}\n")
    assert read_entry(path, "B-v0", "A-v0") == ({"n_timesteps": 7, "lam": 0.2}, "A-v0")
    with pytest.raises(ValueError, match=r"my.yml: unknown entry 'A-v1'; did you mean 'A-v0'\?; known: default, A-v0"):
        read_entry(path, "A-v0", "A-v1")


def test_suggestions_need_not_exist():
    assert suggest("zzz", ["lam", "kappa"]) == ""


def test_what_depends_on_several_keys_is_checked_on_all_of_them_together():
    entry = {"n_timesteps": 1, "noise_type": "normal", "noise_std": 0.1, "policy": "CnnPolicy"}
    overrides = {"noise_std": [0.1, 0.4], "policy_kwargs": {"net_arch": [8]}}
    h = parse(entry, TDC, "file.yml", overrides, "command line")
    assert (h.noise_type, h.noise_std) == ("normal", [0.1, 0.4])
    assert h.raw == {**entry, **overrides}
    assert parse(entry, TDC, "file.yml", {"noise_type": None, "noise_std": 0}, "command line").noise_type is None
    for overrides in ({"action_noise": 0.3}, {"action_noise": None}):
        h = parse(entry, TDC, "file.yml", overrides, "command line")
        assert (h.noise_type, h.model["action_noise"], "noise_std" in h.raw) == (None, overrides["action_noise"], False)
    h = parse({"n_timesteps": 1, "action_noise": 0.3}, TDC, "file.yml", {"noise_type": None}, "command line")
    assert (h.noise_type, "action_noise" in h.model) == (None, False)
    with pytest.raises(ValueError, match="command line: noise_std must be a number, or two with noise_type normal"):
        parse({**entry, "noise_std": [0.1, 0.4]}, TDC, "file.yml", {"noise_type": "ornstein-uhlenbeck"}, "command line")


@pytest.mark.parametrize(
    ("entry", "overrides", "where"),
    [
        ({"gamma": "high"}, {"tau": 0.1}, "file.yml"),
        ({"tau": 0.1}, {"gamma": "high"}, "command line"),
        ({"policy_kwargs": {"foo": 1}}, {"policy": "CnnPolicy"}, "file.yml"),
        ({"policy": "CnnPolicy"}, {"policy_kwargs": {"foo": 1}}, "command line"),
    ],
)
def test_a_mistake_is_named_with_its_source(entry, overrides, where):
    with pytest.raises(ValueError, match=f"^{where}: "):
        parse({"n_timesteps": 1, **entry}, TDC, "file.yml", overrides, "command line")
    assert parse({"n_timesteps": 1, "gamma": "high"}, TDC, "file.yml", {"gamma": 0.9}, "command line").n_timesteps == 1
