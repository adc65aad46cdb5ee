"""``train.py`` and ``enjoy.py`` from end to end, in a temporary folder."""

import importlib.metadata
import os
import pickle
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import yaml
from stable_baselines3.common.vec_env import DummyVecEnv
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_tdc import TDC
from sb3_tdc.cli import enjoy, train
from sb3_tdc.cli.arguments import Parser
from sb3_tdc.common.threads import set_threads
from sb3_tdc.runs.callbacks.stopping import StopOnSignalCallback
from sb3_tdc.runs.folder import RunFolder
from sb3_tdc.safe_load import load_normalization
from tests.helpers.command_line import SMALL, SMALL_ANY, run_enjoy, run_train
from tests.helpers.paths import ROOT
from tests.helpers.training import fails


def tags(folder):
    (events,) = Path(folder).glob("events.out.tfevents.*")
    accumulator = EventAccumulator(str(events)).Reload()
    return accumulator, set(accumulator.Tags()["scalars"])


@pytest.mark.parametrize(
    ("available", "asked", "variable", "expected"),
    [(16, -1, None, 2), (1, -1, None, 1), (16, 5, None, 5), (16, -1, "7", 16), (16, 3, "7", 3)],
)
def test_threads(monkeypatch, available, asked, variable, expected):
    """Two threads by default; the user's choice, on the command line or in the environment, takes precedence."""
    threads = [available]
    monkeypatch.setattr(th, "get_num_threads", lambda: threads[-1])
    monkeypatch.setattr(th, "set_num_threads", threads.append)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if variable:
        monkeypatch.setenv("OMP_NUM_THREADS", variable)
    set_threads(train.make_parser().parse_args(["--num-threads", str(asked)]).num_threads)
    assert threads[-1] == expected


def test_a_run_leaves_what_rl_zoo_leaves(tmp_path, capsys):
    assert run_train(tmp_path, "--save-freq", 100, "--save-replay-buffer") == 0
    folder = tmp_path / "tdc" / "Hopper-v4_1"
    assert {path.name for path in folder.iterdir() if "tfevents" not in path.name} == {
        "0.monitor.csv", "Hopper-v4", "Hopper-v4.zip", "best_model.zip", "evaluations.npz", "progress.csv",
        "replay_buffer.pkl", *(f"rl_model_{n}_steps.zip" for n in (100, 200, 300)),
        *(f"rl_model_replay_buffer_{n}_steps.pkl" for n in (100, 200, 300)),
    }  # fmt: skip
    assert {path.name for path in (folder / "Hopper-v4").iterdir()} == {
        "args.yml", "command.txt", "config.yml", "finished.yml", "versions.yml",
    }  # fmt: skip
    config = yaml.safe_load((folder / "Hopper-v4" / "config.yml").read_text())
    assert (config["lam"], config["n_timesteps"], config["learning_starts"]) == (0.9, 300, 100)
    assert yaml.safe_load((folder / "Hopper-v4" / "args.yml").read_text())["seed"] == 1
    versions = yaml.safe_load((folder / "Hopper-v4" / "versions.yml").read_text())
    assert versions["mujoco"] == importlib.metadata.version("mujoco")
    with np.load(folder / "evaluations.npz") as evaluations:
        assert evaluations["timesteps"].tolist() == [150, 300]
        assert evaluations["results"].shape == (2, 2)

    accumulator, scalars = tags(folder)
    assert {"eval/mean_reward", "train/critic_loss", "train/lam", "rollout/ep_rew_mean"} <= scalars
    assert "_hparams_/session_start_info" in accumulator.summary_metadata  # the HParams tab

    screen = capsys.readouterr().out
    assert "tdc.yml, Hopper-v4" in screen
    assert "      300 steps 100.0%" in screen
    assert "| eval " in screen
    assert f"sb3-tdc enjoy {folder}" in screen
    model = TDC.load(folder / "Hopper-v4.zip")
    assert (model.num_timesteps, model.lam, model.learning_rate) == (300, 0.9, 2e-4)


def test_the_seed_decides_everything(tmp_path):
    for seed in (1, 1, 2):
        assert run_train(tmp_path, seed=seed) == 0
    a, b, c = (TDC.load(tmp_path / "tdc" / f"Hopper-v4_{i}" / "Hopper-v4.zip").policy.state_dict() for i in (1, 2, 3))
    assert all(th.equal(a[k], b[k]) for k in a)
    assert any(not th.equal(a[k], c[k]) for k in a)


@pytest.mark.parametrize("algo", ["meow", "td3", "sac", "ddpg", "advb_td3"])
def test_the_baselines_run_through_the_same_pipeline(tmp_path, algo, capsys):
    assert run_train(tmp_path, algo=algo, small=SMALL_ANY) == 0
    assert run_enjoy("--algo", algo, "--env", "Hopper-v4", "-f", tmp_path) == 0
    assert "mean ± std of 2 episodes" in capsys.readouterr().out


def test_an_environment_without_an_entry_gets_the_default(tmp_path, capsys):
    assert run_train(tmp_path, "-tb", "", env="Pendulum-v1") == 0
    assert "tdc.yml, default (it has no entry for Pendulum-v1)" in capsys.readouterr().out
    assert not list((tmp_path / "tdc" / "Pendulum-v1_1").glob("events*"))  # -tb "" turns TensorBoard off


def test_an_environment_in_another_version_gets_the_entry_of_the_nearest(tmp_path, capsys):
    assert run_train(tmp_path, "-tb", "", env="Hopper-v5") == 0
    assert "tdc.yml, Hopper-v4 (it has no entry for Hopper-v5; this is the nearest version)" in capsys.readouterr().out
    saved = TDC.load(tmp_path / "tdc" / "Hopper-v5_1" / "Hopper-v5.zip")
    assert (saved.lam, saved.qf_learning_rate) == (0.9, 2e-4)  # Table 1


def test_stochastic_head_several_environments_and_normalisation(tmp_path, capsys):
    options = [*SMALL, "stochastic_actor:true", "n_envs:2", "normalize:true", "frame_stack:2"]
    assert run_train(tmp_path, "--vec-env", "subproc", "--n-eval-envs", 2, small=options) == 0
    folder = tmp_path / "tdc" / "Hopper-v4_1"
    assert (folder / "Hopper-v4" / "vecnormalize.pkl").is_file()
    assert (folder / "best_model_vecnormalize.pkl").is_file()
    assert {"0.monitor.csv", "1.monitor.csv"} <= {path.name for path in folder.iterdir()}
    capsys.readouterr()
    assert run_enjoy(folder) == 0
    returns = capsys.readouterr().out
    assert run_enjoy(folder / "Hopper-v4.zip") == 0  # the statistics next to a zip are used
    assert capsys.readouterr().out == returns
    assert run_enjoy(folder, "--load-best") == 0
    # The agent sees normalised observations, but the returns are the environment's: a Hopper gets 1 for each step
    episodes = [line.split() for line in returns.splitlines() if line.startswith("Episode")]
    assert all(float(words[3].rstrip(",")) > 0.5 * float(words[4]) for words in episodes)

    (folder / "Hopper-v4" / "vecnormalize.pkl").unlink()
    with pytest.raises(SystemExit):
        run_enjoy(folder)
    assert "vecnormalize.pkl is missing" in capsys.readouterr().err


def test_going_on_from_a_saved_model(tmp_path, capsys):
    normalized = [*SMALL, "normalize:true"]
    assert run_train(tmp_path, "--save-replay-buffer", "--save-freq", 200, small=normalized) == 0
    first = tmp_path / "tdc" / "Hopper-v4_1"
    for i, (name, updates) in enumerate((("Hopper-v4.zip", 200), ("rl_model_200_steps.zip", 99)), start=2):
        assert TDC.load(first / name)._n_updates == updates
        assert run_train(tmp_path, "-i", first / name, n=120, small=normalized) == 0
        after = TDC.load(tmp_path / "tdc" / f"Hopper-v4_{i}" / "Hopper-v4.zip")
        assert after._n_updates == updates + 120  # the replay buffer was there: no warm-up again
    assert run_train(tmp_path, "-i", first / "best_model.zip", n=120, small=normalized) == 0  # no buffer: warm-up again
    best, after = (TDC.load(p) for p in (first / "best_model.zip", tmp_path / "tdc" / "Hopper-v4_4" / "Hopper-v4.zip"))
    assert after._n_updates == best._n_updates + 20

    for arguments, small, message in (
        (["-i", first / "Hopper-v4.zip"], SMALL, "was trained with normalize: add -params normalize:true"),
        (["-i", first / "Hopper-v4.zip"], [*normalized, "n_envs:2"], "it is of 1 environment, this run has 2"),
        (
            ["-i", first / "Hopper-v4.zip"],
            [*normalized, "buffer_size:5000"],
            "replay_buffer.pkl was not opened: its buffer_size is 1000000, and that of this run is 5000",
        ),
        (["-i", first / "Hopper-v4.zip", "--algo", "sac"], SMALL_ANY, "was saved by tdc, not by sac: --algo tdc"),
    ):
        with pytest.raises(SystemExit):
            run_train(tmp_path, *arguments, small=small)
        assert message in capsys.readouterr().err


def test_a_model_keeps_its_network_alone_and_the_config_says_the_rest(tmp_path, capsys):
    (tmp_path / "my.yml").write_text(
        "default: {n_timesteps: 120, policy_kwargs: {net_arch: [8]}, learning_starts: 110}"
    )
    file, off = ["-conf", tmp_path / "my.yml", "--eval-freq", -1], {"env": "Pendulum-v1", "n": 120}
    saved = ["-params", "policy_kwargs:{net_arch: [24], n_quantiles: 5}", "gradient_steps:8", "stats_window_size:7"]
    assert run_train(tmp_path, *file, small=saved, **off) == 0
    first, second = (tmp_path / "tdc" / f"Pendulum-v1_{i}" for i in (1, 2))
    assert run_train(tmp_path, *file, "-i", first / "Pendulum-v1.zip", small=["-params", "n_steps:2"], **off) == 0
    model = TDC.load(second / "Pendulum-v1.zip")
    assert model.policy_kwargs == {"net_arch": [24], "n_quantiles": 5}
    assert (model.n_steps, model.gradient_steps, model._stats_window_size) == (2, 1, 100)  # 1, 100: the constructor's
    assert RunFolder.open(second).config == {"n_timesteps": 120, "learning_starts": 110, "n_steps": 2}
    for other, message in (
        (
            "policy_kwargs:{net_arch: [32]}",
            "policy_kwargs must be that of the saved model, or left out: {'net_arch': [24]",
        ),
        ("stochastic_actor:true", "stochastic_actor must be that of the saved model, or left out: False, got True"),
    ):
        with pytest.raises(SystemExit):
            run_train(tmp_path, *file, "-i", first / "Pendulum-v1.zip", small=["-params", other], **off)
        assert message in capsys.readouterr().err


def test_normalisation_goes_on_in_an_environment_of_another_id(tmp_path, capsys):
    gym.register("Other-v0", "gymnasium.envs.classic_control:PendulumEnv", max_episode_steps=100)
    normalized = [*SMALL, "normalize:true"]
    assert run_train(tmp_path, env="Pendulum-v1", n=120, small=normalized) == 0
    first = tmp_path / "tdc" / "Pendulum-v1_1" / "Pendulum-v1.zip"
    with pytest.raises(SystemExit):
        run_train(tmp_path, "-i", first, env="Other-v0", n=130)
    assert f"{first} was trained with normalize: add -params normalize:true" in capsys.readouterr().err
    assert run_train(tmp_path, "-i", first, env="Other-v0", n=130, small=normalized) == 0
    env = DummyVecEnv([lambda: gym.make("Other-v0")])
    saved = load_normalization(tmp_path / "tdc" / "Other-v0_1" / "Other-v0" / "vecnormalize.pkl", env)
    assert round(saved.obs_rms.count) == (1 + 120) + (1 + 130)  # the first observation, and one per step


def train_further(tmp_path, model, *params):
    """Train for 120 steps, with an evaluation; from a model unless it is None."""
    further = [] if model is None else ["-i", model]
    run_train(tmp_path, *further, "--eval-freq", 60, env="Pendulum-v1", n=120, small=[*SMALL, *params])
    return max((tmp_path / "tdc").glob("Pendulum-v1_*")) / "Pendulum-v1.zip"


def test_a_model_whose_observations_were_not_normalised_gets_none_that_are(tmp_path, capsys):
    rewards = 'normalize:{"norm_obs": false}'
    of_rewards = train_further(tmp_path / "rewards", None, rewards)
    plain = train_further(tmp_path / "plain", None)
    for model, params, message in (
        (of_rewards, [], f"{of_rewards} was trained with normalize: add -params '{rewards}'"),
        (of_rewards, ["normalize:true"], "normalize: norm_obs must be False, as in "),
        (plain, ["normalize:true"], f"{plain} was trained without normalize: add -params normalize:false"),
    ):
        with pytest.raises(SystemExit):
            train_further(tmp_path / "refused", model, *params)
        assert message in capsys.readouterr().err
    assert not (tmp_path / "refused").exists()
    assert train_further(tmp_path / "further", of_rewards, rewards).is_file()
    assert train_further(tmp_path / "too", plain, "normalize:{norm_obs: false, clip_reward: 3}").is_file()


def test_only_the_statistics_of_normalisation_come_from_the_model(tmp_path):
    first = train_further(tmp_path, None, "normalize:true")
    further = train_further(tmp_path, first, "normalize:{norm_reward: false, clip_obs: 5}")
    with open(further.parent / "Pendulum-v1" / "vecnormalize.pkl", "rb") as file:
        saved = pickle.load(file)
    assert (saved.norm_reward, saved.clip_obs, saved.clip_reward) == (False, 5, 10)  # 10 is VecNormalize's default
    assert round(saved.obs_rms.count) == 2 * (1 + 120)  # the first observation, and one per step


@pytest.mark.parametrize("small", [SMALL, [*SMALL, "normalize:true"]])
def test_normalisation_that_was_lost_does_not_begin_anew(tmp_path, capsys, small):
    assert run_train(tmp_path, env="Pendulum-v1", n=120, small=[*SMALL, "normalize:true"]) == 0
    first = tmp_path / "tdc" / "Pendulum-v1_1"
    statistics = first / "Pendulum-v1" / "vecnormalize.pkl"
    statistics.unlink()
    with pytest.raises(SystemExit):
        run_train(tmp_path, "-i", first / "Pendulum-v1.zip", env="Pendulum-v1", n=130, small=small)
    assert f"{statistics} is missing: Pendulum-v1.zip was trained on normalised obs" in capsys.readouterr().err
    assert not (tmp_path / "tdc" / "Pendulum-v1_2").exists()


def stop_at_150(self):
    self.requested = self.n_calls == 150
    return not self.requested


def test_the_command_to_go_on_is_the_same_experiment(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(StopOnSignalCallback, "_on_step", stop_at_150)
    params = [*SMALL, "lam:0.25", "normalize:true"]
    assert run_train(tmp_path, "--resume-freq", -1, small=params) == 130
    (command,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("  sb3-tdc train")]
    monkeypatch.undo()
    assert train.main(shlex.split(command)[2:]) == 0
    model = TDC.load(tmp_path / "tdc" / "Hopper-v4_2" / "Hopper-v4.zip")
    assert (model.lam, model.num_timesteps, model.batch_size) == (0.25, 150, 16)


def test_a_time_limit_of_the_hyperparameters_ends_episodes(tmp_path, capsys):
    (tmp_path / "my.yml").write_text(
        "default: {n_timesteps: 300, env_wrapper: [{gymnasium.wrappers.TimeLimit: {max_episode_steps: 20}}]}"
    )
    assert run_train(tmp_path, "-conf", tmp_path / "my.yml", env="Pendulum-v1") == 0
    with np.load(tmp_path / "tdc" / "Pendulum-v1_1" / "evaluations.npz") as evaluations:
        assert evaluations["ep_lengths"].tolist() == [[20, 20], [20, 20]]
    capsys.readouterr()
    assert run_enjoy(tmp_path / "tdc" / "Pendulum-v1_1") == 0
    assert ", 20 steps" in capsys.readouterr().out


def test_an_environment_named_with_its_package(tmp_path, monkeypatch, capsys):
    (tmp_path / "my_package.py").write_text(
        "import gymnasium as gym\n"
        "gym.register('Mine-v0', 'gymnasium.envs.classic_control:PendulumEnv', max_episode_steps=30)"
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert run_train(tmp_path, env="my_package:Mine-v0") == 0
    (command,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("To watch it")]
    assert run_enjoy(*shlex.split(command)[5:]) == 0  # names the package: a run folder alone imports nothing


@pytest.fixture
def own_parts(tmp_path, monkeypatch):
    """Hyperparameters that name the user's own classes."""
    (tmp_path / "own_parts.py").write_text(
        "import gymnasium as gym\nfrom stable_baselines3.common.torch_layers import FlattenExtractor\n"
        "class Wrapper(gym.Wrapper): pass\nclass Extractor(FlattenExtractor): pass\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    sys.modules.pop("own_parts", None)
    networks = "policy_kwargs:{net_arch: [8], n_quantiles: 5, features_extractor_class: own_parts.Extractor}"
    return ["-params", networks, *SMALL[2:], "env_wrapper:own_parts.Wrapper"]


def test_the_command_to_watch_consents_to_classes_of_the_user_s_own(tmp_path, own_parts, capsys):
    assert run_train(tmp_path, env="Pendulum-v1", n=120, small=own_parts) == 0
    command = capsys.readouterr().out.rpartition("To watch it: sb3-tdc enjoy ")[2]
    folder = tmp_path / "tdc" / "Pendulum-v1_1"
    assert shlex.split(command) == [str(folder), "--gym-packages", "own_parts", "--trust"]
    assert run_enjoy(*shlex.split(command)) == 0
    for trusting_less, refused in (
        ([folder], "asks for env_wrapper own_parts.Wrapper"),
        (
            [folder, "--gym-packages", "own_parts"],
            "the field policy_kwargs (if you know its origin, enjoy, evaluate and train open it with --trust): "
            "a reference to own_parts.Extractor",
        ),
    ):
        with pytest.raises(SystemExit):
            run_enjoy(*trusting_less)
        assert refused in capsys.readouterr().err


def test_the_command_to_go_on_consents_to_classes_of_the_user_s_own(tmp_path, own_parts, capsys, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(StopOnSignalCallback, "_on_step", stop_at_150)
        assert run_train(tmp_path, "--resume-freq", -1, env="Pendulum-v1", small=own_parts) == 130
    (command,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("  sb3-tdc train")]
    assert train.main(shlex.split(command)[2:]) == 0


def test_a_log_of_nothing(tmp_path):
    assert run_train(tmp_path, "--log-interval", 0) == 0


@pytest.mark.parametrize(
    ("learning_starts", "train_freq", "n_updates"),
    [(120, 1, 0), (119, 1, 1), (120, 50, 1), (150, 50, 0), (10, "[1, episode]", 1)],  # 120 steps end at 150
)
def test_a_run_that_learns_nothing_says_so(tmp_path, learning_starts, train_freq, n_updates, capsys):
    small = [*SMALL, f"learning_starts:{learning_starts}", f"train_freq:{train_freq}", "gradient_steps:1"]
    assert run_train(tmp_path, n=120, small=small) == 0
    updates = TDC.load(tmp_path / "tdc" / "Hopper-v4_1" / "Hopper-v4.zip")._n_updates
    assert bool(updates) == bool(n_updates)
    warned = f"Warning: nothing will be learned: learning_starts ({learning_starts}) is not below the run's"
    assert (warned in capsys.readouterr().err) == (n_updates == 0)


def test_enjoy_finds_models(tmp_path, capsys):
    run_train(tmp_path, "--save-freq", 100)
    folder = tmp_path / "tdc" / "Hopper-v4_1"
    by_name = ["--env", "Hopper-v4", "-f", tmp_path]
    for args, model in (
        ([folder], "Hopper-v4.zip"),
        (by_name, "Hopper-v4.zip"),
        ([*by_name, "--exp-id", 1, "--load-best"], "best_model.zip"),
        ([folder, "--load-checkpoint", 200], "rl_model_200_steps.zip"),
        ([folder, "--load-last-checkpoint"], "rl_model_300_steps.zip"),
        ([folder / "best_model.zip", "--env", "Hopper-v4"], "best_model.zip"),
    ):
        capsys.readouterr()
        assert run_enjoy(*args) == 0
        assert f"{folder / model}: tdc on Hopper-v4" in capsys.readouterr().out
    for args, message in (
        ([folder, "--load-checkpoint", 250], "no saved model of step 250; there are those of steps 100, 200, 300"),
        (["--env", "Hoper-v4", "-f", tmp_path], "no run of tdc on Hoper-v4"),
        ([*by_name, "--exp-id", 3], "no run 3 of tdc on Hopper-v4"),
        ([tmp_path], "is not the folder of a run"),
        ([folder / "evaluations.npz"], "evaluations.npz is not the zip of a saved model"),
    ):
        with pytest.raises(SystemExit) as exit_:
            run_enjoy(*args)
        assert exit_.value.code == 2
        assert message in capsys.readouterr().err


def test_returns_are_those_of_the_mean_action(tmp_path, capsys):
    run_train(tmp_path)
    capsys.readouterr()
    run_enjoy("--env", "Hopper-v4", "-f", tmp_path, "--seed", 5)
    shown = capsys.readouterr().out
    model = TDC.load(tmp_path / "tdc" / "Hopper-v4_1" / "Hopper-v4.zip")
    env, done, total = gym.make("Hopper-v4"), False, 0.0
    observation, _ = env.reset(seed=5)
    while not done:
        observation, reward, terminated, truncated, _ = env.step(model.predict(observation)[0])
        total, done = total + reward, terminated or truncated
    assert f"Episode   1: return {total:10.2f}" in shown


def test_recording_without_a_display(tmp_path, capsys, monkeypatch):
    imageio = pytest.importorskip("imageio.v2")
    pytest.importorskip("imageio_ffmpeg")
    run_train(tmp_path)
    environment = {k: v for k, v in os.environ.items() if k not in {"DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"}}
    video = tmp_path / "videos" / "hopper.mp4"
    command = [
        sys.executable,
        ROOT / "enjoy.py",
        tmp_path / "tdc" / "Hopper-v4_1",
        "--record",
        video,
        "--n-episodes",
        "1",
    ]
    done = subprocess.run(list(map(str, command)), env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "Rendering with MUJOCO_GL=" in done.stdout
    frames = list(imageio.get_reader(video).iter_data())
    steps = int(done.stdout.split("return")[1].split(",")[1].split()[0])
    assert len(frames) == steps
    assert frames[0].shape[2] == 3
    assert np.std(frames[0]) > 10  # not a black picture
    assert np.abs(frames[-1].astype(float) - frames[0]).mean() > 0.1  # it moves


@pytest.mark.parametrize(
    ("send", "vec_env"),
    [
        (signal.SIGINT, "subproc"),
        (signal.SIGTERM, "dummy"),
        pytest.param(signal.SIGINT, "dummy", marks=pytest.mark.slow),
        pytest.param(signal.SIGTERM, "subproc", marks=pytest.mark.slow),
    ],
)
def test_stopping_saves_and_says_how_to_go_on(tmp_path, send, vec_env):
    """A Ctrl-C reaches the whole process group, as in a terminal."""
    options = ["-f", tmp_path, "--eval-freq", "-1", "--vec-env", vec_env, *SMALL, "n_envs:2"]
    command = [sys.executable, ROOT / "train.py", "--env", "Hopper-v4", "-n", "1000000", *options]
    process = subprocess.Popen(
        list(map(str, command)), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    monitor = tmp_path / "tdc" / "Hopper-v4_1" / "progress.csv"
    deadline = time.monotonic() + 120
    while not (monitor.exists() and monitor.stat().st_size > 0) and time.monotonic() < deadline:
        time.sleep(0.2)
    if send == signal.SIGINT:
        os.killpg(process.pid, send)
    else:
        process.send_signal(send)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "Traceback" not in err
    model = tmp_path / "tdc" / "Hopper-v4_1" / "Hopper-v4.zip"
    steps = TDC.load(model).num_timesteps
    assert f"Stopped at step {steps:,} of 1,000,000. To continue from step {steps - 2:,}:" in out
    assert f"python {ROOT / 'train.py'} --resume {model.parent}" in out


def test_stopping_an_evaluation_that_would_never_end(tmp_path):
    """Pendulum without its time limit, evaluated at step 150: only the evaluation's environment reaches 200 steps."""
    code = f"""
import gymnasium as gym, pathlib
from gymnasium.envs.classic_control import PendulumEnv
from sb3_tdc.cli.train import main

class Endless(PendulumEnv):
    steps = 0

    def step(self, action):
        self.steps += 1
        if self.steps == 200:
            pathlib.Path("{tmp_path}/evaluating").touch()
        return super().step(action)

gym.register("Endless-v0", Endless)
main("--env Endless-v0 -n 1000 --eval-freq 150 -params learning_starts:990 -f {tmp_path}".split())
"""
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 120
    while not (tmp_path / "evaluating").exists() and time.monotonic() < deadline:
        time.sleep(0.2)
    process.terminate()
    out, err = process.communicate(timeout=30)
    assert "Stopped at step 150 of 1,000" in out, err
    assert (tmp_path / "tdc" / "Endless-v0_1" / "Endless-v0.zip").is_file()


def test_a_signal_stops_after_the_step_and_handlers_are_put_back():
    before = signal.getsignal(signal.SIGINT)
    with StopOnSignalCallback() as stop:
        assert stop._on_step()
        os.kill(os.getpid(), signal.SIGINT)
        assert not stop._on_step()
    assert signal.getsignal(signal.SIGINT) is before


def test_a_diverged_run_keeps_what_was_saved(tmp_path, capsys):
    assert run_train(tmp_path, "--save-freq", 100, "-params", *SMALL[1:], "learning_rate:1.0e+30", small=[]) == 1
    assert "Training has stopped" in capsys.readouterr().err
    folder = tmp_path / "tdc" / "Hopper-v4_1"
    assert (folder / "rl_model_100_steps.zip").is_file()
    assert not (folder / "Hopper-v4.zip").exists()


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--env", "Walker3d-v4"], "There is no environment 'Walker3d-v4'; did you mean Walker2d-v4"),
        (
            ["--algo", "tdd"],
            "unknown algorithm 'tdd'; did you mean 'tdc'?; known: tdc, meow, td3, sac, ddpg, "
            "advb_td3, advb_sac, advb_tdc",
        ),
        (["--evalfreq", "3"], "unknown argument '--evalfreq'; did you mean '--eval-freq'?"),
        (["-n", "many"], "argument -n/--n-timesteps: invalid int value: 'many'"),
        (["-params", "lam"], "must be key:value, got 'lam'"),
        (["-params", "lam:-1"], "lam must be a finite number of at least 0.0, got -1"),
        (["-params", "lamb:1"], "command line (-params): unknown key 'lamb'; did you mean 'lam'?"),
        (["-params", "lam:[1"], "the value of lam is not valid YAML: '[1'"),
        (["-conf", "nothing.yml"], "nothing.yml: No such file"),
        (["-i", "nothing.zip"], "-i must be the zip of a model, got nothing.zip"),
        (["-n", "0"], "-n must be at least 1 (or -1: as in the hyperparameters), got 0"),
        (["-params", "policy:os.path"], "policy: 'os.path' names no BasePolicy class"),
        (["-params", "env_wrapper:{gymnasium.wrappers.TimeLimit: 100}"], "env_wrapper must name a class, or map it"),
        (["--eval-episodes", "0"], "--eval-episodes must be at least 1, got 0"),
        (
            ["--gym-packages", "no_such_package"],
            "no module 'no_such_package': if it is a file of yours, put its folder on PYTHONPATH; otherwise pip "
            "install no_such_package",
        ),
        (["--gym-packages", "./logs"], "--gym-packages takes names of modules, got './logs'"),
        (["--env", "CartPole-v1"], "env must have a Box action space"),
        (["--env-kwargs", "colour:red"], "colour"),
        (["--device", "gpu"], "--device must be one of auto, cpu"),
        (
            ["-params", "policy:MultiInputPolicy"],
            "policy MultiInputPolicy is for Dict observations, got Box(-inf, inf, ",
        ),
        (["-params", f"buffer_size:{10**14}"], f"its replay buffer (buffer_size {10**14}): Unable to "),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_command_lines_get_one_sentence(tmp_path, capsys, args, message):
    with pytest.raises(SystemExit) as exit_:
        run_train(tmp_path / "my" / "logs", *args, small=[])
    assert exit_.value.code == 2
    out, error = capsys.readouterr()
    assert message in error
    assert error.startswith("sb3-tdc train: error: ")
    assert error.count("\n") == 1
    assert "Training" not in out
    assert not list(tmp_path.iterdir())  # no folder of a run that never began


@pytest.mark.parametrize("key", ["callback", "vec_env_wrapper"])
def test_what_the_user_has_written_is_named_with_its_place(tmp_path, key, monkeypatch, capsys):
    (tmp_path / "my_own.py").write_text("class Part:\n    def __init__(self, *args):\n        self.name.lower()\n")
    monkeypatch.syspath_prepend(tmp_path)
    sys.modules.pop("my_own", None)
    with pytest.raises(SystemExit) as exit_:
        run_train(tmp_path / "logs", "-params", *SMALL[1:], f"{key}:my_own.Part", small=[])
    assert exit_.value.code == 2
    reason = f"AttributeError: 'Part' object has no attribute 'name' ({tmp_path / 'my_own.py'}, line 3)"
    assert capsys.readouterr().err == f"sb3-tdc train: error: {reason}\n"
    assert not (tmp_path / "logs").exists()


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        ("from os import nothing", "ImportError: cannot import name 'nothing' from 'os' ("),
        ("\nmissing", "NameError: name 'missing' is not defined ({file}, line 2)\n"),
        ("def (", "SyntaxError: invalid syntax (broken.py, line 1)\n"),
        ("raise SystemExit(0)", "SystemExit: 0 ({file}, line 1)\n"),
    ],
    ids=lambda value: value.strip()[:9],
)
def test_a_module_that_fails_is_named_with_its_place(tmp_path, code, reason, monkeypatch, capsys):
    (tmp_path / "broken.py").write_text(code)
    (tmp_path / "model.zip").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    for call, place in (
        (lambda: run_train(tmp_path, "--gym-packages", "broken"), "--gym-packages broken: "),
        (lambda: run_enjoy(tmp_path / "model.zip", "--env", "broken:Broken-v0"), "--gym-packages broken: "),
        (lambda: run_train(tmp_path, "-params", "env_wrapper:broken.Wrapper"), "to its keyword arguments: "),
    ):
        assert f"{place}{reason.format(file=tmp_path / 'broken.py')}" in fails(call, capsys)


def test_a_missing_package_gets_its_command(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "tqdm", None)
    with pytest.raises(SystemExit):
        run_train(tmp_path, "--progress")
    assert 'pip install "sb3-tdc[progress]"' in capsys.readouterr().err


def test_the_bar_shows_steps_rate_and_evaluation(tmp_path, capsys):
    pytest.importorskip("tqdm")
    assert run_train(tmp_path, "--progress") == 0
    error = capsys.readouterr().err
    assert "300/300" in error
    assert "steps/s" in error
    assert "eval " in error


def test_runs_that_start_at_once_get_a_folder_each(tmp_path):
    folders = [RunFolder.create(tmp_path, "tdc", "ALE/Pong-v5") for _ in range(3)]
    assert [f.path.name for f in folders] == ["ALE-Pong-v5_1", "ALE-Pong-v5_2", "ALE-Pong-v5_3"]
    assert RunFolder.create(tmp_path, "tdc", "ALE/Pong-v5", unique=True).path.name.startswith("ALE-Pong-v5_4_")


def test_flags_cannot_be_abbreviated_by_accident():
    parser = Parser("")
    parser.add_argument("--eval-freq", type=int)
    with pytest.raises(SystemExit):
        parser.parse_args(["--eval", "3"])


@pytest.mark.parametrize(
    ("main", "flags", "sentence"),
    [
        (train.main, ["--track"], "--track is RL Zoo's: a run writes TensorBoard files into its folder"),
        (train.main, ["-optimize"], "-optimize is RL Zoo's: to search hyperparameters: sb3-tdc tune"),
        (train.main, ["--n-trials", "5"], "--n-trials is RL Zoo's: to search hyperparameters: sb3-tdc tune"),
        (enjoy.main, ["--deterministic"], "--deterministic is RL Zoo's: the mean action is the default here"),
        (enjoy.main, ["--n-envs", "4"], "--n-envs is RL Zoo's: one environment is played"),
        (enjoy.main, ["--norm-reward"], "--norm-reward is RL Zoo's: returns are those of the environment"),
    ],
)
def test_flags_of_rl_zoo_that_have_another_form_here(main, flags, sentence, capsys):
    with pytest.raises(SystemExit) as exit_:
        main(flags)
    assert exit_.value.code == 2
    assert sentence in capsys.readouterr().err


def test_every_flag_of_rl_zoo_is_known_or_answered():
    rl_zoo3 = pytest.importorskip("rl_zoo3")
    for name, module in (("train", train), ("enjoy", enjoy)):
        source = (Path(rl_zoo3.__file__).parent / f"{name}.py").read_text()
        flags = re.findall(r"""["'](--?[a-zA-Z][\w-]*)["']""", source)
        parser = module.make_parser()
        known = {flag for action in parser._actions for flag in action.option_strings} | set(parser.zoo_flags)
        assert len(flags) > 20
        assert set(flags) - known == set()


def test_a_second_flag_adds_to_the_first():
    flags = ["-params", "lam:0.5", "gamma:0.9", "-params", "gamma:0.8", "tau:1e-2"]
    args = train.make_parser().parse_args([*flags, "--gym-packages", "a", "b", "--gym-packages", "c"])
    assert args.hyperparams == {"lam": 0.5, "gamma": 0.8, "tau": 0.01}
    assert args.gym_packages == ["a", "b", "c"]
    assert train.make_parser().parse_given(flags)["hyperparams"] == args.hyperparams
    assert train.make_parser().parse_args([]).hyperparams == {}


def test_enjoy_finds_what_train_made_of_an_environment_with_its_package(tmp_path):
    package = "tests.envs.test_rendering"
    code = "gym.register('InPackage-v0', Undrawn) if 'InPackage-v0' not in gym.registry else None"
    (tmp_path / "in_package.py").write_text(f"import gymnasium as gym\nfrom {package} import Undrawn\n{code}\n")
    sys.path.insert(0, str(tmp_path))
    try:
        assert run_train(tmp_path, env="in_package:InPackage-v0", n=120) == 0
        assert run_enjoy("--env", "in_package:InPackage-v0", "-f", tmp_path) == 0
    finally:
        sys.path.remove(str(tmp_path))


@pytest.mark.parametrize("seed", [2**32 - 2**16 + 1, 4294967296, -2])
def test_a_seed_out_of_range_leaves_no_folder(tmp_path, seed, capsys):
    with pytest.raises(SystemExit):
        run_train(tmp_path, seed=seed)
    assert f"--seed must be 0 to 4294901760 (or -1: a random one), got {seed}" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def spaced(tmp_path_factory):
    """A run in a folder with a space in its name."""
    folder = tmp_path_factory.mktemp("with space") / "my [runs] here"
    assert run_train(folder, n=120) == 0
    return folder / "tdc" / "Hopper-v4_1"


def test_commands_that_are_printed_can_be_pasted(tmp_path, capsys):
    folder = tmp_path / "my runs"
    run_train(folder, n=120)
    command = capsys.readouterr().out.rpartition("To watch it: sb3-tdc enjoy ")[2]
    assert run_enjoy(*shlex.split(command)) == 0


@pytest.mark.parametrize(
    ("flags", "reason"),
    [
        (["--record", "{file}/a.mp4"], "--record {file}/a.mp4 cannot be written: "),
        (["--record", "{folder}/a.xyz"], "the name must end in one of .mp4, "),
        (["--record", "{folder}"], "the name must end in one of .mp4, "),
        (["--seed", "-1"], "--seed must be 0 to 4294901760, got -1"),
    ],
)
def test_what_cannot_be_written_is_said_before_anything_is_played(spaced, tmp_path, flags, reason, capsys):
    (tmp_path / "file").write_text("")
    places = {"file": tmp_path / "file", "folder": tmp_path}
    with pytest.raises(SystemExit) as exit_:
        enjoy.main([str(spaced), "--no-render", *(flag.format(**places) for flag in flags)])
    assert exit_.value.code == 2
    captured = capsys.readouterr()
    assert reason.format(**places) in captured.err
    assert "Episode" not in captured.out


def test_a_log_folder_that_is_a_file(tmp_path, capsys):
    (tmp_path / "logs").write_text("mine")
    with pytest.raises(SystemExit):
        run_train(tmp_path / "logs")
    assert f"No run folder can be made in {tmp_path / 'logs'}" in capsys.readouterr().err
    assert (tmp_path / "logs").read_text() == "mine"


def test_two_runs_never_share_a_tensorboard_folder(tmp_path):
    board = tmp_path / "my [board]"
    (board / "Hopper-v4" / "TDC_1").mkdir(parents=True)  # as if by a run that started at the same moment
    for number in (2, 3):
        assert run_train(tmp_path, "-tb", board, n=120) == 0
        assert len(list((board / "Hopper-v4" / f"TDC_{number}").iterdir())) == 1
    assert list((board / "Hopper-v4" / "TDC_1").iterdir()) == []


def test_an_explanation_is_named_after_its_model(spaced, tmp_path):
    model = spaced / "toy_v1.2.zip"
    model.write_bytes((spaced / "Hopper-v4.zip").read_bytes())
    assert enjoy.main([str(model), "--explain", "--n-episodes", "1"]) == 0
    assert (spaced / "toy_v1.2_critics.png").is_file()


def test_mujoco_says_a_warning_once_and_leaves_no_file(tmp_path):
    code = """
import gymnasium as gym, numpy as np
from sb3_tdc.envs.mujoco import print_warnings_once
print_warnings_once()
for _ in range(3):
    env = gym.make("HalfCheetah-v4")
    env.reset(seed=1)
    env.unwrapped.data.ctrl[:] = np.nan
    for _ in range(3):
        env.unwrapped.do_simulation(np.full(6, np.nan), 1)
"""
    options = {"cwd": tmp_path, "env": {**os.environ, "PYTHONPATH": str(ROOT)}}
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, **options)
    assert ended.returncode == 0, ended.stderr
    assert ended.stderr.count("The simulation is unstable") == 1
    assert "settotalmass" not in ended.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("make_parser", [train.make_parser, enjoy.make_parser])
def test_help_shows_defaults_that_are_values_alone(make_parser):
    text = make_parser().format_help()
    shown = {" ".join(default.split()) for default in re.findall(r"\(default:\s+(.*?)\)", text, re.DOTALL)}
    assert {"tdc", "logs", "HalfCheetah-v4"} <= shown
    assert not shown & {"None", "True", "False", "[]", "{}", "-1"}


def test_the_help_of_train_is_in_groups(capsys):
    with pytest.raises(SystemExit):
        train.main(["--help"])
    text = capsys.readouterr().out
    titles = ["run", "hyperparameters", "evaluation", "saving and resuming", "process and log"]
    assert re.findall(r"^([a-z ]+):$", text, re.MULTILINE) == ["options", *titles]


def test_a_ctrl_c_before_training_begins_ends_with_130_and_leaves_nothing(tmp_path, capsys):
    def interrupted():
        raise KeyboardInterrupt

    gym.register("Interrupted-v0", interrupted)
    assert run_train(tmp_path, env="Interrupted-v0", n=100) == 130
    assert "Interrupted before training began" in capsys.readouterr().err
    assert not list(tmp_path.rglob("args.yml"))
