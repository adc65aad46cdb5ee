"""TDC inside the real RL Zoo: training, enjoying, and Optuna search."""

from collections import OrderedDict

import pytest
import yaml

from sb3_tdc import MEOW, TDC, zoo
from sb3_tdc.cli import train as our_train
from sb3_tdc.hyperparams import hyperparams_file
from sb3_tdc.runs.folder import RunFolder
from sb3_tdc.runs.settings import MAX_SEED

rl_zoo3 = pytest.importorskip("rl_zoo3")

SMALL = ["-params", "policy_kwargs:dict(net_arch=[16, 16], n_quantiles=5)", "learning_starts:100", "buffer_size:1000"]


def test_training_and_enjoying(tmp_path, capsys):
    zoo.main(["train", "--algo", "tdc", "--env", "Hopper-v4", "-n", "300", "-f", str(tmp_path), "--seed", "1", *SMALL])
    model = TDC.load(tmp_path / "tdc" / "Hopper-v4_1" / "Hopper-v4.zip")
    assert (model.lam, model.learning_rate(1.0), model._n_updates) == (0.9, 2e-4, 200)  # from hyperparams/tdc.yml
    enjoy = ["enjoy", "--algo", "tdc", "--env", "Hopper-v4", "-f", str(tmp_path), "--no-render", "-n", "100"]
    zoo.main(enjoy)
    assert "Mean reward" in capsys.readouterr().out


def test_training_meow_with_its_own_hyperparameters(tmp_path):
    small = ["-params", "policy_kwargs:dict(net_arch=[8, 8], shift_arch=[8], log_std_max=-0.3)", "buffer_size:1000"]
    small += ["learning_starts:100"]
    zoo.main(
        ["train", "--algo", "meow", "--env", "Walker2d-v4", "-n", "120", "-f", str(tmp_path), "--seed", "1", *small]
    )
    model = MEOW.load(tmp_path / "meow" / "Walker2d-v4_1" / "Walker2d-v4.zip")
    assert (model.ent_coef, model.learning_rate(1.0), model._n_updates) == (0.1, 1e-3, 20)  # from hyperparams/meow.yml


@pytest.mark.parametrize("network", ["small", "big"])
def test_the_search_space_of_meow_makes_models(network):
    import optuna

    fixed = {"one_minus_gamma": 0.01, "batch_size_pow": 5, "learning_rate": 1e-3, "train_freq": 2, "tau": 0.01}
    fixed |= {"noise_type": "normal", "noise_std": 0.1, "net_arch": network, "log_std_max": 1.0, "ent_coef": 0.2}
    trial = optuna.trial.FixedTrial(fixed)
    sampled = zoo.sample_meow_params(trial, 1, 1, {"using_her_replay_buffer": False})
    model = MEOW("MlpPolicy", "Pendulum-v1", buffer_size=10, **sampled)
    assert (model.ent_coef, model.network.flow.log_std_max, model.action_noise) == (0.2, 1.0, None)
    assert zoo.convert_meow_params(trial.params) == sampled


def test_zoo_enjoys_a_run_of_train_py(tmp_path, capsys):
    small = ["policy_kwargs:{net_arch: [16, 16]}", "normalize:true"]
    our_train.main(["--env", "Hopper-v4", "-n", "200", "-f", str(tmp_path), "--eval-freq", "100", "-params", *small])
    zoo.main(["enjoy", "--algo", "tdc", "--env", "Hopper-v4", "-f", str(tmp_path), "--no-render", "-n", "100"])
    assert "Mean reward" in capsys.readouterr().out


@pytest.fixture
def zoo_args(monkeypatch):
    """Return the ``args.yml`` that RL Zoo's ``train`` writes, from its flags."""
    train = pytest.importorskip("rl_zoo3.train")
    parsed = []

    def manager(args, *others, **kwargs):
        parsed.append(vars(args))
        raise KeyboardInterrupt

    def write(*flags):
        with pytest.raises(KeyboardInterrupt):
            zoo.main(["train", *flags])
        return yaml.dump(OrderedDict(sorted(parsed.pop().items())))

    monkeypatch.setattr(train, "ExperimentManager", manager)
    return write


@pytest.mark.parametrize("seed", [1, MAX_SEED])
def test_a_run_of_rl_zoo_starts_over(tmp_path, zoo_args, seed):
    run = RunFolder.create(tmp_path, "tdc", "Pendulum-v1")
    flags = ["--algo", "tdc", "--env", "Pendulum-v1", "--seed", str(seed), "--device", "cpu", "--eval-freq", "50"]
    (run.path / "Pendulum-v1" / "args.yml").write_text(zoo_args(*flags))
    config = OrderedDict(n_timesteps=100.0, policy_kwargs="dict(net_arch=[4])", learning_starts=90, batch_size=4)
    (run.path / "Pendulum-v1" / "config.yml").write_text(yaml.dump(config))
    assert our_train.main(["--resume", str(run.path), "--start-over"]) == 0
    assert run.steps_at_end == 100


def test_search(tmp_path):
    storage = str(tmp_path / "study.log")
    search = ["-optimize", "--n-trials", "2", "--n-evaluations", "1", "--eval-episodes", "1", "--no-optim-plots"]
    search += ["--storage", storage, "--study-name", "s", "--sampler", "random"]
    run = ["train", "--algo", "tdc", "--env", "Pendulum-v1", "-n", "210", "-f", str(tmp_path), "--seed", "0"]
    zoo.main([*run, *search, "-params", "learning_starts:200", "buffer_size:1000"])
    import optuna

    backend = optuna.storages.journal.JournalFileBackend(storage)
    study = optuna.load_study(study_name="s", storage=optuna.storages.JournalStorage(backend))
    assert len(study.trials) == 2
    for trial in study.trials:
        assert round(10 * trial.params["lam"], 9) in range(11)
        hyperparams = zoo.convert_tdc_params(trial.params)
        assert hyperparams["policy_kwargs"]["n_quantiles"] in (16, 25, 64)
        noise = {k: v for k, v in hyperparams.items() if k.startswith("noise_")}
        keywords = {k: v for k, v in hyperparams.items() if k not in noise}
        TDC("MlpPolicy", "Pendulum-v1", buffer_size=10, **keywords)
        assert bool(noise) == (trial.params["noise_type"] is not None)


def test_it_says_how_to_install_rl_zoo(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "rl_zoo3", None)
    with pytest.raises(ImportError, match=r'pip install "sb3-tdc\[zoo\]"'):
        zoo.register()


@pytest.mark.parametrize("flag", ["-conf", "--conf-file", "--conf"])
def test_the_user_s_hyperparameters_count(monkeypatch, flag):
    train = pytest.importorskip("rl_zoo3.train")
    taken = []

    def manager(*args, **kwargs):
        taken.append(kwargs["config"])
        raise KeyboardInterrupt

    monkeypatch.setattr(train, "ExperimentManager", manager)
    for given, expected in (([flag, "my.yml"], "my.yml"), ([], str(hyperparams_file("tdc")))):
        with pytest.raises(KeyboardInterrupt):
            zoo.main(["train", "--algo", "tdc", "--env", "Pendulum-v1", *given])
        assert taken.pop() == expected


def test_usage():
    with pytest.raises(SystemExit, match="usage"):
        zoo.main(["fly"])
