"""Models that are trained further with the hyperparameters of another run."""

import pytest
import torch as th
from stable_baselines3.common.env_util import make_vec_env

from sb3_tdc.hyperparams import parse
from sb3_tdc.runs.algorithms import KNOWN_ALGORITHMS
from sb3_tdc.runs.models import continue_model, make_model

ARGUMENTS = (
    *("learning_rate", "batch_size", "gamma", "train_freq", "gradient_steps", "n_steps"),
    *("replay_buffer_class", "replay_buffer_kwargs", "policy_kwargs", "policy_class"),
)


@pytest.fixture
def env():
    env = make_vec_env("Pendulum-v1")
    yield env
    env.close()


@pytest.mark.parametrize("algo", ["tdc", "meow", "td3", "sac", "ddpg", "advb_sac"])
@pytest.mark.parametrize("trust", [False, True])
def test_a_model_is_trained_further_with_the_arguments_of_a_new_one(tmp_path, env, algo, trust):
    network = {"policy_kwargs": {"net_arch": [8, 8]}, "buffer_size": 100}
    others = {"gradient_steps": 8, "train_freq": 4, "gamma": 0.5, "learning_rate": "lin_0.1"}
    saved = make(algo, env, **network, **others, n_steps=3)
    saved.save(tmp_path / "model.zip")
    hyperparams = parse({"n_timesteps": 1, **network, "batch_size": 17}, KNOWN_ALGORITHMS[algo], "")
    further = continue_model(tmp_path / "model.zip", algo, hyperparams, env, trust, device="cpu")
    new = make(algo, env, **network, batch_size=17)
    assert {name: getattr(further, name) for name in ARGUMENTS} == {name: getattr(new, name) for name in ARGUMENTS}
    for name, weights in saved.policy.state_dict().items():
        assert th.equal(further.policy.state_dict()[name], weights), name


@pytest.mark.parametrize("trust", [False, True])
@pytest.mark.parametrize("algo", ["sac", "tdc"])
@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        ("auto_0.5", 0.1, 0.1),
        (0.5, "auto_0.1", 0.1),
        (0.5, 0.1, 0.1),
        ("auto_0.5", "auto_0.1", 0.1),
        ("auto_0.5", "auto_0.5", 0.25),  # unchanged: the value in the file
        (0.5, 0.5, 0.25),
    ],
)
def test_a_model_is_trained_further_with_another_temperature(tmp_path, env, before, after, expected, algo, trust):
    head = {"stochastic_actor": True} if algo == "tdc" else {}
    arguments = {"policy_kwargs": {"net_arch": [8]}, "buffer_size": 100, "learning_starts": 10, **head}
    saved = make(algo, env, **arguments, ent_coef=before)
    saved.learn(30)
    with th.no_grad():
        if saved.log_ent_coef is None:
            saved.ent_coef_tensor.fill_(0.25)
        else:
            saved.log_ent_coef.copy_(th.tensor(0.25).log())
    saved.save(tmp_path / "model.zip")
    hyperparams = parse({"n_timesteps": 1, **arguments, "ent_coef": after}, KNOWN_ALGORITHMS[algo], "")
    further = continue_model(tmp_path / "model.zip", algo, hyperparams, env, trust, device="cpu")
    temperature = further.ent_coef_tensor if further.log_ent_coef is None else further.log_ent_coef.exp()
    assert temperature.item() == pytest.approx(expected)
    assert further.ent_coef == after
    for name, weights in saved.policy.state_dict().items():
        assert th.equal(further.policy.state_dict()[name], weights), name
    for part in ("actor", "critic"):
        moments = [getattr(each, part).optimizer.state_dict()["state"] for each in (saved, further)]
        assert moments[0].keys() == moments[1].keys() != set()
        for old, new in zip(*(each.values() for each in moments), strict=True):
            assert th.equal(old["exp_avg_sq"], new["exp_avg_sq"])
    further.learn(30)
    if isinstance(after, str):  # the new temperature is learned
        assert further.log_ent_coef.exp().item() != pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("trust", [False, True])
def test_a_temperature_that_is_never_learned_is_an_argument_like_others(tmp_path, env, trust):
    arguments = {"policy_kwargs": {"net_arch": [8]}, "buffer_size": 100}
    saved = make("meow", env, **arguments, ent_coef=0.5)
    saved.save(tmp_path / "model.zip")
    hyperparams = parse({"n_timesteps": 1, **arguments, "ent_coef": 0.1}, KNOWN_ALGORITHMS["meow"], "")
    further = continue_model(tmp_path / "model.zip", "meow", hyperparams, env, trust, device="cpu")
    assert further.ent_coef == 0.1
    assert not vars(further).keys() & {"log_ent_coef", "ent_coef_optimizer", "ent_coef_tensor"}
    for name, weights in saved.policy.state_dict().items():
        assert th.equal(further.policy.state_dict()[name], weights), name


def make(algo, env, **arguments):
    return make_model(algo, parse({"n_timesteps": 1, **arguments}, KNOWN_ALGORITHMS[algo], ""), env, device="cpu")


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (
            {"policy_kwargs": {"net_arch": [32]}},
            r"policy_kwargs must be that of the saved model, .*: {'net_arch': \[8\]}",
        ),
        ({"policy": "CnnPolicy"}, "policy must be that of the saved model, or left out: "),
        ({"use_sde": True}, "use_sde must be that of the saved model, or left out: False, got True"),
    ],
)
def test_another_network_than_that_of_the_model_is_refused(tmp_path, env, other, message):
    make("sac", env, policy_kwargs={"net_arch": [8]}, buffer_size=100).save(tmp_path / "model.zip")
    hyperparams = parse({"n_timesteps": 1, "buffer_size": 100, **other}, KNOWN_ALGORITHMS["sac"], "")
    with pytest.raises(ValueError, match=message):
        continue_model(tmp_path / "model.zip", "sac", hyperparams, env, False, device="cpu")
