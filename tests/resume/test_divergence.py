"""Non-finite numbers are never learnt from or saved, and a run can go back to a state from before it diverged."""

import re

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import yaml
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_tdc import TDC, NonFiniteError
from sb3_tdc.cli import train
from sb3_tdc.resume import ResumeCallback, stored_steps
from tests.tools.runs import Stop, StopAt


class Breaks(gym.Env):
    """
    An environment with episodes of 10 steps that returns an extreme value at step 57.

    A terminal observation is extreme at step 60, where that episode ends; a reset, at the beginning or after that step.
    """

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, what="reward", value=np.nan):
        self.what, self.value, self.count = what, value, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        bad = self.what == "reset" or (self.what == "next reset" and self.count >= 57)
        return np.full(2, self.value if bad else 0.1), {}

    def step(self, action):
        self.count, self.steps = self.count + 1, self.steps + 1
        last = self.steps == 10
        due = (self.count == 57 and not last) or (self.count == 60)
        observation = self.np_random.normal(size=2)
        if due and self.what == ("terminal observation" if last else "observation"):
            observation[1] = self.value
        return observation, self.value if due and self.what == "reward" else 1.0, last, False, {}


gym.register("Breaks-v0", Breaks)
KINDS = [("reward", np.nan), ("reward", 1e300), ("observation", np.nan), ("observation", -np.inf)]
KINDS += [("observation", 1e300), ("terminal observation", 1e300), ("next reset", np.nan), ("reset", np.nan)]
SMALL = ["policy_kwargs:{net_arch: [8, 8]}", "learning_starts:20", "batch_size:8", "buffer_size:500"]


def run_train(folder, algo, *args):
    run = ["--algo", algo, "--env", "Breaks-v0", "-n", 150, "--seed", 1, "-f", folder, "--resume-freq", 20]
    fast = ["--eval-freq", 40, "--eval-episodes", 1, "--save-freq", 50, "--device", "cpu", "-tb", ""]
    return train.main([str(arg) for arg in (*run, *fast, *args, "-params", *SMALL)])


def numbers_of(folder):
    """Yield weights, optimizer states and transitions in resume states. Bounds and best returns may be infinite."""
    for path in folder.rglob("weights.pt"):
        for name, state in th.load(path, weights_only=True)["state_dicts"].items():
            for value in state["state"].values() if name.endswith("optimizer") else [state]:
                yield from value.values()
    for path in folder.rglob("replay/*.npz"):
        with np.load(path) as arrays:
            yield from (th.as_tensor(arrays[name]) for name in arrays.files)


@pytest.mark.parametrize("algo", ["td3", "sac", "ddpg", "tdc"])
def test_every_algorithm_ends_with_a_sentence_and_saves_nothing_that_is_not_finite(tmp_path, capsys, algo):
    for number, (what, value) in enumerate(KINDS, start=1):
        arguments = [f"what:{what}", f"value:{yaml.safe_dump(value).split()[0]}"]
        evaluation = ["--eval-env-kwargs", "what:nothing"]
        code = run_train(tmp_path, algo, *evaluation, "--env-kwargs", *arguments)
        printed = capsys.readouterr()
        assert code == 1, (what, value)
        step = {"terminal observation": 60, "next reset": 60}.get(what, 57)
        name = "observation" if "reset" in what else what
        where = "" if what == "reset" else f" at timestep {step} "
        assert re.search(rf"returned a non-finite {name} of .*{where}", printed.err), printed.err
        assert "Saved" not in printed.out
        assert "Traceback" not in printed.err
        folder = tmp_path / algo / f"Breaks-v0_{number}"
        assert not (folder / "Breaks-v0.zip").exists()
        assert all(value.isfinite().all() for value in numbers_of(folder))
        if what != "reset":
            assert f"--resume {folder} --from 0" in printed.err
            assert stored_steps(folder / "resume") == ([59, 39, 20, 0] if step == 60 else [39, 20, 0])


@pytest.mark.parametrize("algo", ["td3", "sac", "ddpg"])
def test_weights_that_diverge_are_not_saved(tmp_path, capsys, monkeypatch, algo):
    """In the last update: no step after it can notice."""
    algorithm = {"td3": TD3, "sac": SAC, "ddpg": TD3}[algo]
    learn = algorithm.train

    def diverge(self, *args, **kwargs):
        learn(self, *args, **kwargs)
        if self.num_timesteps == 150:
            with th.no_grad():
                next(self.critic.parameters())[0, 0] = np.inf

    monkeypatch.setattr(algorithm, "train", diverge)
    assert run_train(tmp_path, algo, "--env-kwargs", "what:nothing") == 1
    told = r"The model of step 150 was not saved: the weights critic.\S+ are not finite"
    assert re.search(told, capsys.readouterr().err)
    assert not list(tmp_path.rglob("Breaks-v0.zip"))


@pytest.mark.parametrize("algo", ["td3", "sac", "ddpg"])
def test_weights_that_diverge_in_training_are_named(tmp_path, capsys, monkeypatch, algo):
    """With such weights, SAC's distribution raises an error itself."""
    algorithm = SAC if algo == "sac" else TD3
    learn = algorithm.train

    def diverge(self, *args, **kwargs):
        learn(self, *args, **kwargs)
        if self.num_timesteps == 77:
            weight(self)

    monkeypatch.setattr(algorithm, "train", diverge)
    assert run_train(tmp_path, algo, "--env-kwargs", "what:nothing") == 1
    printed = capsys.readouterr()
    assert re.search(r"(The weights actor.*|chose an action of .*nan.*) at timestep 7[78]", printed.err), printed.err
    assert "Saved" not in printed.out
    assert all(value.isfinite().all() for value in numbers_of(tmp_path))


def make_model(algorithm=SAC, env=None, **kwargs):
    env = DummyVecEnv([lambda: Breaks("nothing")]) if env is None else env
    small = {"learning_starts": 20, "batch_size": 8, "buffer_size": 500, "policy_kwargs": {"net_arch": [8, 8]}}
    return algorithm("MlpPolicy", env, seed=1, device="cpu", **{**small, **kwargs})


class Poison(BaseCallback):
    is_captured = False

    def __init__(self, poison):
        super().__init__()
        self.poison = poison

    def _on_step(self):
        if self.num_timesteps == 79:
            with th.no_grad():
                self.poison(self.model)
        return True


@th.no_grad()
def weight(model):
    next(model.actor.parameters())[0, 0] = np.nan


def moment(model):
    optimizer = model.critic.optimizer
    next(iter(optimizer.state.values()))["exp_avg_sq"][0, 0] = np.inf


def temperature(model):
    model.log_ent_coef[0] = np.inf


def transition(model):
    model.replay_buffer.rewards[65] = np.nan


def statistics(model):
    model.env.obs_rms.var[0] = np.inf


@pytest.mark.parametrize(
    ("poison", "named"),
    [
        (weight, "actor.mu"), (moment, r"critic\.optimizer\[0\]\.exp_avg_sq"), (temperature, "log_ent_coef"),
        (transition, "replay_buffer.rewards"), (statistics, "VecNormalize.obs_rms.var"),
    ],
)  # fmt: skip
def test_no_state_is_written_of_what_is_not_finite(tmp_path, poison, named):
    algorithm = TD3 if poison is weight else SAC
    model = make_model(algorithm, VecNormalize(DummyVecEnv([lambda: Breaks("nothing")])), learning_starts=65)
    model.train = _no_updates_after(model, 78)
    states = ResumeCallback(tmp_path, freq=20, verbose=0)
    with pytest.raises(NonFiniteError, match=rf"state of step 80 was not written: .*{named}.* not finite"):
        model.learn(200, callback=[states, Poison(poison)])
    assert states.store.steps() == [60, 40, 20, 0]
    assert all(value.isfinite().all() for value in numbers_of(tmp_path))
    states.store.close()


def _no_updates_after(model, step):
    learn = model.train
    return lambda *args, **kwargs: None if model.num_timesteps > step else learn(*args, **kwargs)


# ---------------------------------------------------------------- going back


def rates(folder, step):
    state = th.load(folder / "resume" / f"step_{step:012d}" / "weights.pt", weights_only=True)["state_dicts"]
    return {state[f"{network}.optimizer"]["param_groups"][0]["lr"] for network in ("actor", "critic")}


def test_a_run_goes_back_with_other_hyperparameters_and_the_change_is_recorded(tmp_path, capsys, monkeypatch):
    assert run_train(tmp_path, "td3", "--env-kwargs", "what:reward") == 1
    folder = tmp_path / "td3" / "Breaks-v0_1"
    monkeypatch.setattr(Breaks, "step", _finite_step)

    def resume(*args):
        return train.main(["--resume", str(folder), *args])

    stop = _stop_at(monkeypatch, 65)
    assert resume("--from", "20", "-params", "learning_rate:0.00123", "gamma:0.9") == 1
    assert "Continuing from step 20" in capsys.readouterr().out
    config = yaml.safe_load((folder / "Breaks-v0" / "config.yml").read_text())
    assert (config["learning_rate"], config["gamma"]) == (0.00123, 0.9)
    changes = yaml.safe_load((folder / "Breaks-v0" / "changes.yml").read_text())
    assert changes == {"changes": [{"step": 20, "hyperparams": {"learning_rate": 0.00123, "gamma": 0.9}}]}
    assert rates(folder, 59) == {0.00123}
    assert rates(folder, 0) != {0.00123}

    # From a state written before the change, by a command that does not repeat the change
    stop[0] = 45
    assert resume("--from", "20") == 1
    assert rates(folder, 39) == {0.00123}
    stop[0] = 1000
    assert resume() == 0
    assert TD3.load(folder / "Breaks-v0.zip").gamma == 0.9


def _finite_step(self, action):
    self.steps += 1
    return self.np_random.normal(size=2), 1.0, self.steps == 10, False, {}


def _stop_at(monkeypatch, step):
    """Stop as suddenly as a kill. :return: the step, in a list so that a test can change it"""
    stop = [step]
    on_step = ResumeCallback._on_step

    def on_step_or_stop(self):
        if self.num_timesteps >= stop[0]:
            raise Stop
        return on_step(self)

    monkeypatch.setattr(ResumeCallback, "_on_step", on_step_or_stop)
    return stop


def test_a_schedule_may_be_changed_too(tmp_path):
    def learn(model, step=None, changed=(), stop_at=None):
        states = ResumeCallback(tmp_path, freq=20, verbose=0)
        try:
            states.select(model, step, changed)
            model.learn(120, callback=[states, StopAt(stop_at)])
        except Stop:
            pass
        finally:
            states.store.close()

    old = make_model(TDC, learning_rate=lambda left: 1e-3 * left, lam=lambda left: 0.1, gamma=0.9)
    learn(old, stop_at=70)
    new = make_model(TDC, learning_rate=lambda left: 1e-5 * left, lam=0.7, gamma=0.99)
    learn(new, 40, ["learning_rate", "lam"])
    assert new.num_timesteps == 120
    assert new.lr_schedule(1.0) == 1e-5
    assert (new.lam, new.gamma) == (0.7, 0.9)
    assert new.actor.optimizer.param_groups[0]["lr"] < 1e-5
