"""The λ search: its candidates and its ranking; then real searches, killed and resumed."""

import contextlib
import os
import signal
import sys
import time

import gymnasium as gym
import numpy as np
import pytest
import yaml

from sb3_tdc import TDC
from sb3_tdc.cli import train, tune
from sb3_tdc.experiments import ranking, search, trials
from sb3_tdc.experiments.jobs import Job
from sb3_tdc.experiments.search_space import LAMBDAS, Distribution, make_candidates, parse_space
from sb3_tdc.hyperparams import hyperparams_file, parse, read_entry
from sb3_tdc.runs.folder import RunFolder
from tests.helpers.matrices import is_running, runs_of
from tests.helpers.searches import arguments
from tests.helpers.searches import start_search as start


def test_space():
    assert LAMBDAS == [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0]
    space = parse_space(["lam:[0.5, 1]", "tau: loguniform(1e-4, 1e-2)", "policy_delay:randint(1,3)"])
    assert space == {
        "lam": [0.5, 1],
        "tau": Distribution("loguniform", 1e-4, 1e-2),
        "policy_delay": Distribution("randint", 1, 3),
    }
    candidates = make_candidates(space, 4)
    assert len(candidates) == 2 * 4
    assert [c["lam"] for c in candidates] == [0.5] * 4 + [1] * 4
    assert [c["tau"] for c in candidates[:4]] == [c["tau"] for c in candidates[4:]]  # the same draws for both λ
    assert all(1e-4 <= c["tau"] <= 1e-2 and c["policy_delay"] in (1, 2, 3) for c in candidates)
    assert make_candidates(space, 4) == candidates
    assert make_candidates({"lam": [0.5]}, 99) == [{"lam": 0.5}]
    few = make_candidates({"policy_delay": Distribution("randint", 1, 3)}, 30)
    assert sorted(c["policy_delay"] for c in few) == [1, 2, 3]


@pytest.mark.parametrize(
    "text",
    [
        "lam", "lam:", "lam:0.5", "lam:[]", "lam:[0.5", "lam:__import__('os').getcwd()", "lam:normal(0,1)",
        "lam:uniform(1,0)", "lam:loguniform(0,1)", "lam:uniform(a,b)", "lam:uniform(0,inf)", "lam:randint(0.5,2)",
    ],
)  # fmt: skip
def test_spaces_that_are_none(text):
    with pytest.raises(ValueError, match="--search"):
        parse_space([text])


def make_candidate(folder, lam, returns):
    """
    Make the runs of a candidate, one for each seed.

    :param returns: for each seed, the mean return of every evaluation
    """
    jobs = []
    for seed, values in enumerate(returns, start=1):
        job = Job("tdc", "Hopper-v4", seed, 1500, folder / f"{lam}" / f"{seed}", {"lam": lam})
        run = RunFolder.create(job.logs, "tdc", "Hopper-v4")
        run.write_config(job.config, {"algo": "tdc", "env": "Hopper-v4", "seed": seed, "eval_freq": 50})
        episodes = np.array(values)[:, None] + [-1, 1]
        np.savez(run.path / "evaluations.npz", timesteps=50 * np.arange(1, len(values) + 1), results=episodes)
        jobs.append(job)
    return jobs


def test_ranking_by_hand(tmp_path):
    candidates = [
        make_candidate(tmp_path, 0.1, [[1, 3], [3, 5]]),  # means 2 and 4
        make_candidate(tmp_path, 0.2, [[4, 6], [5, 7]]),  # 5 and 6
        make_candidate(tmp_path, 0.3, [[9, 1], [9]]),  # both seeds have one evaluation
    ]
    table = ranking.rank(candidates, ["lam"])
    assert table["lam"].tolist() == [0.2, 0.1, 0.3]
    assert table["mean"].tolist() == [5.5, 3, 9]
    assert table["steps"].tolist() == [100, 100, 50]
    assert table["std"].tolist() == pytest.approx([np.sqrt(0.5), np.sqrt(2), 0])
    ranking.write_results(tmp_path, candidates, ["lam"])
    best = yaml.safe_load((tmp_path / "best.yml").read_text())["Hopper-v4"]
    assert (best["lam"], best["n_timesteps"]) == (0.2, 1_500_000)
    assert (tmp_path / "lam.png").stat().st_size > 5_000


def test_finished_candidates_are_ranked_by_their_return_whenever_they_were_evaluated(tmp_path):
    """With several environments, evaluations come a little earlier, and there may be one more."""
    candidates = [make_candidate(tmp_path, lam, [[each] * 3]) for lam, each in ((0.1, 5), (0.2, 9), (0.3, 1))]
    more = np.array([[1.0, 1.0]] * 4)
    np.savez(candidates[2][0].run_folder.path / "evaluations.npz", timesteps=[48, 96, 144, 150], results=more)
    for jobs in candidates:
        jobs[0].run_folder.mark_finished(150)
    table = ranking.rank(candidates, ["lam"])
    assert table["lam"].tolist() == [0.2, 0.1, 0.3]
    assert table["steps"].tolist() == [150, 150, 150]
    assert trials.read_shared_evaluations(candidates[2])[0].tolist() == [48, 96, 144, 150]


def test_a_search_over_numbers_and_texts(tmp_path):
    candidates = [make_candidate(tmp_path, lam, [[2, each]]) for lam, each in ((0.1, 4), (0.2, 6), ("lin_0.3", 8))]
    candidates.append([Job("tdc", "Hopper-v4", 1, 1500, tmp_path / "failed", {"lam": 0.4})])  # never evaluated
    ranking.write_results(tmp_path, candidates, ["lam"])
    assert yaml.safe_load((tmp_path / "best.yml").read_text())["Hopper-v4"]["lam"] == "lin_0.3"
    assert (tmp_path / "lam.png").stat().st_size > 5_000


def test_a_search_over_the_noise_replaces_that_of_the_file(tmp_path):
    job = Job("tdc", "Hopper-v4", 1, 1500, tmp_path, {"action_noise": 0.2})
    assert "noise_type" in Job("tdc", "Hopper-v4", 1, 1500, tmp_path).config
    assert not {"noise_type", "noise_std"} & set(job.config)
    run = RunFolder.create(job.logs, "tdc", "Hopper-v4")
    entry, _ = read_entry(hyperparams_file("tdc"), "Hopper-v4")
    # As train writes it
    given = parse(entry, TDC, "file", {"action_noise": 0.2, "learning_starts": 150, "n_timesteps": 1500}, "flags")
    run.write_config(given.raw, {"algo": "tdc", "env": "Hopper-v4", "seed": 1, "eval_freq": 50})
    np.savez(run.path / "evaluations.npz", timesteps=[50], results=[[1.0, 2.0]])
    ranking.write_results(tmp_path, [[job]], ["action_noise"])
    best, _ = read_entry(tmp_path / "best.yml", "Hopper-v4")
    assert parse(best, TDC, "best.yml").model["action_noise"] == 0.2
    assert best["n_timesteps"] == entry["n_timesteps"]


def test_trials(tmp_path):
    candidates = [
        [Job("tdc", "Hopper-v4", seed, 10, tmp_path, {"tau": 0.1, "lam": lam}) for seed in (1, 2)] for lam in (0.0, 1.0)
    ]
    assert list(map(len, trials.make_trials(candidates, ["lam"], side_by_side=False).values())) == [1] * 4
    assert trials.make_trials(candidates, ["lam"], side_by_side=True) == {
        "lam 0.0, 2 seeds": candidates[0],
        "lam 1.0, 2 seeds": candidates[1],
    }
    assert list(trials.make_trials([candidates[0][:1]], ["lam"], side_by_side=True)) == ["lam 0.0, 1 seed"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--algo", "tcd"], "did you mean 'tdc'"),
        (["--env", "Hoper-v4"], "did you mean Hopper"),
        (["--algo", "sac"], "sac has no λ"),
        (["--search", "lamm:[1.0]"], "did you mean 'lam'"),
        (["--search", "lam:[high]"], "lam must be"),
        (["--search", "lam:[-1.0]"], "lam must be"),
        (["--gym-packages", "no_such_package"], "pip install no_such_package"),
        (["-n", "0"], "-n must be at least 1"),
        (["--seeds", "0"], "--seeds must be at least 1"),
        (["--asha", "--seeds", "3", "--jobs", "2"], "3 seeds need as many CPUs"),
    ],
)
def test_bad_arguments(arguments, sentence, tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        tune.main([*arguments, "--logs", str(tmp_path)])
    assert stopped.value.code == 2
    assert sentence in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


STORED = """
{algo: tdc, env: Pendulum-v1, gym_packages: [], hyperparams: {}, n_timesteps: 90, seeds: 1, search: ["lam:[0.5]"],
 samples: 10, asha: false, logs: logs, jobs: null, address: null, resume: null}
"""


@pytest.fixture
def stopped_search(tmp_path, monkeypatch):
    """The folder of a stopped search; no trial is run."""
    monkeypatch.setattr(tune, "cluster", lambda *args: contextlib.nullcontext())
    monkeypatch.setattr(tune, "run_trials", lambda *args: (False, []))
    (tmp_path / "search.yml").write_text(STORED)
    return tmp_path


def test_a_search_has_all_its_arguments_in_its_folder(stopped_search, capsys):
    assert tune.main(["--resume", str(stopped_search)]) == 130
    captured = capsys.readouterr()
    assert captured.out.startswith("1 candidate × 1 seed, 90 steps each, evaluated every 3 (5 episodes)")
    assert captured.err.endswith(f"tune --resume {stopped_search}\n")


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (STORED, "", "search.yml must be a mapping of arguments to values"),
        (STORED, "[1, 2]", "search.yml must be a mapping of arguments to values"),
        ("{algo", "{{algo", "search.yml is not YAML of plain values"),
        ("samples: 10, ", "", "search.yml: samples must be of type int, got None"),
        ("n_timesteps: 90", "n_timesteps: many", "search.yml: n_timesteps must be of type int, got 'many'"),
        ("algo: tdc", "algo: tcd", "search.yml: unknown algorithm 'tcd'; did you mean 'tdc'?"),
        ('["lam:[0.5]"]', "[5]", "search.yml: search must hold texts, got [5]"),
        ("hyperparams: {}", "hyperparams: {1: 2}", "search.yml: hyperparams must hold texts, got {1: 2}"),
    ],
)
def test_a_damaged_search(stopped_search, old, new, sentence, capsys):
    (stopped_search / "search.yml").write_text(STORED.replace(old, new))
    with pytest.raises(SystemExit) as stopped:
        tune.main(["--resume", str(stopped_search)])
    assert stopped.value.code == 2
    assert sentence in capsys.readouterr().err
    assert [path.name for path in stopped_search.iterdir()] == ["search.yml"]


def test_a_search_is_run_by_one_process(stopped_search, monkeypatch, capsys):
    def resume_again(*args):
        with pytest.raises(SystemExit):
            tune.main(["--resume", str(stopped_search)])
        return False, []

    monkeypatch.setattr(tune, "run_trials", resume_again)
    assert tune.main(["--resume", str(stopped_search)]) == 130
    assert f"Another process runs the search in {stopped_search}" in capsys.readouterr().err
    monkeypatch.setattr(tune, "run_trials", lambda *args: (True, []))
    assert tune.main(["--resume", str(stopped_search)]) == 0  # the lock was released


def test_a_closed_pipe_ends_no_search(stopped_search, monkeypatch, capsys):
    """As with ``tune ... | tee log`` and Ctrl-C, which ends ``tee`` first."""
    reader, writer = os.pipe()
    os.close(reader)
    monkeypatch.setattr(sys, "stdout", os.fdopen(writer, "w"))
    assert tune.main(["--resume", str(stopped_search)]) == 130
    assert "To continue:" in capsys.readouterr().err


def test_a_place_that_cannot_be_written_is_said_before_ray_is_started(tmp_path, capsys):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(SystemExit):
        tune.main(["--env", "Pendulum-v1", "--logs", str(tmp_path / "file")])
    assert f"cannot be written: {tmp_path}/file is not a folder" in capsys.readouterr().err


# ---------------------------------------------------------------- real searches


def finish(process):
    return process.communicate(timeout=300)[0], process.returncode


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_a_search_that_is_stopped_goes_on_to_the_same_end(tmp_path, how):
    options = ["--search", "lam:[0.0, 1.0]"]
    out, status = finish(start(*arguments(tmp_path / "alone", 2000), *options))
    assert status == 0, out
    alone, killed = (tmp_path / name / "search/tdc/Pendulum-v1_1" for name in ("alone", "killed"))

    process = start(*arguments(tmp_path / "killed", 2000), *options)
    deadline = time.monotonic() + 200
    finished = "candidate_*/seed_*/tdc/*/*/finished.yml"  # no rglob: states appear and disappear meanwhile
    while not list(killed.glob(finished)):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    family = runs_of(process.pid)
    assert family
    os.kill(process.pid, how)
    out, status = finish(process)
    assert status == {signal.SIGKILL: -9, signal.SIGINT: 130}[how], out
    assert not (killed / "best.yml").exists()
    assert how == signal.SIGKILL or f"tune.py --resume {killed}" in out
    deadline = time.monotonic() + 30
    while any(is_running(pid) for pid in family):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    assert len(list(killed.glob(finished))) < 4
    out, status = finish(start("--resume", killed))
    assert status == 0, out
    assert (killed / "ranking.csv").read_text() == (alone / "ranking.csv").read_text()
    best = yaml.safe_load((killed / "best.yml").read_text())["Pendulum-v1"]
    assert best["lam"] in (0.0, 1.0)
    command = ["--env", "Pendulum-v1", "-conf", str(killed / "best.yml"), "-n", "50", "-f", str(tmp_path / "best")]
    assert train.main([*command, "--eval-freq", "-1", "--num-threads", "1", "--device", "cpu"]) == 0
    assert RunFolder.find(tmp_path / "best", "tdc", "Pendulum-v1").config["lam"] == best["lam"]


@pytest.mark.slow
def test_asha_stops_whole_candidates(tmp_path):
    out, status = finish(start(*arguments(tmp_path), "--asha", "--search", "lam:[0.0, 0.3, 0.6, 1.0]"))
    assert status == 0, out
    folder = tmp_path / "search/tdc/Pendulum-v1_1"
    finished = [len(list(candidate.rglob("finished.yml"))) for candidate in folder.glob("candidate_*")]
    assert len(finished) == 4
    assert all(n in (0, 2) for n in finished)
    assert 2 in finished


class NeedsKwargs(gym.Env):
    """Cannot be made by its id alone, and its wrapper changes what is observed."""

    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, size):
        self.observation_space = gym.spaces.Box(-1, 1, (size,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}


def test_candidates_are_checked_on_the_environment_of_the_runs(monkeypatch):
    gym.register("NeedsKwargs-v0", NeedsKwargs)
    settings = {"env_kwargs": {"size": 3}, "env_wrapper": "gymnasium.wrappers.FlattenObservation"}
    search.check("tdc", "NeedsKwargs-v0", settings)
    with pytest.raises(ValueError, match=r"--search and -params: .*size"):
        search.check("tdc", "NeedsKwargs-v0", {})
    with pytest.raises(ValueError, match=r"--search and -params: .*policy_delay"):
        search.check("tdc", "NeedsKwargs-v0", {**settings, "policy_delay": 0})
