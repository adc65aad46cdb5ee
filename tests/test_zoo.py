"""TDC inside the real RL Zoo: training, enjoying, and Optuna search."""

import pytest

from sb3_tdc import TDC, zoo
from sb3_tdc import train as our_train

rl_zoo3 = pytest.importorskip("rl_zoo3")

SMALL = ["-params", "policy_kwargs:dict(net_arch=[16, 16], n_quantiles=5)", "learning_starts:100", "buffer_size:1000"]


def test_training_and_enjoying(tmp_path, capsys):
    zoo.main(["train", "--algo", "tdc", "--env", "Hopper-v4", "-n", "300", "-f", str(tmp_path), "--seed", "1", *SMALL])
    model = TDC.load(tmp_path / "tdc" / "Hopper-v4_1" / "Hopper-v4.zip")
    assert (model.lam, model.learning_rate(1.0), model._n_updates) == (0.9, 2e-4, 200)  # from hyperparams/tdc.yml
    enjoy = ["enjoy", "--algo", "tdc", "--env", "Hopper-v4", "-f", str(tmp_path), "--no-render", "-n", "100"]
    zoo.main(enjoy)
    assert "Mean reward" in capsys.readouterr().out


def test_zoo_enjoys_a_run_of_train_py(tmp_path, capsys):
    small = ["policy_kwargs:{net_arch: [16, 16]}", "normalize:true"]
    our_train.main(["--env", "Hopper-v4", "-n", "200", "-f", str(tmp_path), "--eval-freq", "100", "-params", *small])
    zoo.main(["enjoy", "--algo", "tdc", "--env", "Hopper-v4", "-f", str(tmp_path), "--no-render", "-n", "100"])
    assert "Mean reward" in capsys.readouterr().out


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


def test_usage():
    with pytest.raises(SystemExit, match="usage"):
        zoo.main(["fly"])
