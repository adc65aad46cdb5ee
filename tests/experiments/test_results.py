"""Settings and arrays, read from run folders."""

import inspect
import shutil

import numpy as np
import pytest
from stable_baselines3 import SAC, TD3

from sb3_tdc import TDC
from sb3_tdc.experiments import provenance
from sb3_tdc.experiments.groups import group_runs
from sb3_tdc.experiments.results import Run, default_settings, find_runs
from tests.helpers.run_folders import make_run
from tests.safe_load.attacks.tools import rewrite


def test_folders_that_cannot_be_read_do_not_stop_the_others(tmp_path):
    make_run(tmp_path)
    broken = make_run(tmp_path, seed=2)
    (broken.path / "Hopper-v4" / "args.yml").write_text("algo: [")
    runs, unreadable = find_runs(tmp_path)
    assert [run.seed for run in runs] == [1]
    assert len(unreadable) == 1
    assert str(broken.path) in unreadable[0]
    with pytest.raises(ValueError, match="There are no runs in"):
        find_runs(tmp_path / "nothing")


@pytest.mark.parametrize("name", ["evaluations.npz", "Hopper-v4.zip"])
@pytest.mark.parametrize(
    "damage", [lambda data: data[: len(data) // 2], lambda data: b"", lambda data: b"x" * len(data)]
)
def test_a_damaged_file_is_listed_and_the_others_are_read(tmp_path, name, damage):
    broken = make_run(tmp_path, seed=1, returns=np.ones((50, 5)))
    make_run(tmp_path, seed=2)
    (broken.path / name).write_bytes(damage((broken.path / name).read_bytes()))
    runs, unreadable = find_runs(tmp_path)
    assert [run.seed for run in runs] == [2]
    assert len(unreadable) == 1
    assert str(broken.path) in unreadable[0]


@pytest.mark.parametrize("row", ["1,2,3,4,5,6\n", '"\n', "\udcff\n"])
def test_a_damaged_log_is_listed(tmp_path, row):
    broken = make_run(tmp_path, seed=1, log={"train/lam": [1.0, 2.0]})
    make_run(tmp_path, seed=2)
    with (broken.path / "progress.csv").open("a", errors="surrogateescape") as log:
        log.write(row)
    runs, (unreadable,) = find_runs(tmp_path)
    assert [run.seed for run in runs] == [2]
    assert str(broken.path) in unreadable


@pytest.mark.parametrize(
    ("timesteps", "results"),
    [
        ([10, 20, 30], [[1.0], [2.0]]),
        ([10, 20], [1.0, 2.0]),
        ([[10, 20]], [[1.0]]),
        ([], np.empty((0, 5))),
        ([10], np.empty((1, 0))),
        ([10], [["a"]]),
        (["a"], [[1.0]]),
    ],
)
def test_evaluations_without_sense_are_listed(tmp_path, timesteps, results):
    broken = make_run(tmp_path, seed=1)
    make_run(tmp_path, seed=2)
    np.savez(broken.path / "evaluations.npz", timesteps=timesteps, results=results)
    runs, (unreadable,) = find_runs(tmp_path)
    assert [run.seed for run in runs] == [2]
    assert str(broken.path) in unreadable
    assert "evaluations.npz" in unreadable


@pytest.mark.parametrize("seed", ["one", None, 1.5, [1], True])
def test_a_seed_that_is_no_number_is_listed(tmp_path, seed):
    make_run(tmp_path, seed=seed)
    make_run(tmp_path, seed=2)
    runs, (unreadable,) = find_runs(tmp_path)
    assert [run.seed for run in runs] == [2]
    assert "seed" in unreadable


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_run_with_a_return_that_is_not_finite_is_not_averaged_anywhere(tmp_path, value):
    make_run(tmp_path, seed=1, returns=((1.0, 3.0), (2.0, 4.0)))
    make_run(tmp_path, seed=2, returns=((1.0, 3.0), (2.0, value)))
    runs, _ = find_runs(tmp_path)
    (group,) = group_runs(runs)
    assert group.seeds == "1 (1)"
    assert group.final_returns.tolist() == [3.0]
    (why,) = provenance.list_unfinished(runs, [])["Why"]
    assert why == "an evaluation has a return that is not finite"


@pytest.mark.parametrize(
    ("entries", "reason"),
    [
        ({"data": "[" * 10**5}, "recursion"),
        ({"data": " " * 10**7 + "{}"}, "'data' is compressed more than 100-fold"),
        ({"data": '{"num_timesteps": 1e999}'}, "num_timesteps must be an integer"),
        ({"data": '{"a": 1}'}, "num_timesteps must be an integer"),
        ({"system_info.txt": "x" * 10**7}, "'system_info.txt' is compressed more than 100-fold"),
        ({"system_info.txt": None}, "it has no system_info.txt"),
        ({"evil.pth": b""}, "'evil.pth' is unknown or repeated"),
    ],
)
def test_a_model_is_read_within_bounds(tmp_path, entries, reason):
    run = make_run(tmp_path)
    (run.path / "Hopper-v4" / "versions.yml").unlink()  # as RL Zoo's runs, whose system is read from the zip
    assert Run.open(run.path).system == "OS: of the test · Python: 3"
    deflate = any(len(content or "") > 10**6 for content in entries.values())
    rewrite(shutil.copy(run.model, tmp_path / "model.zip"), run.model, deflate, **entries)
    with pytest.raises(ValueError, match=f"has a file that cannot be read .*Hopper-v4.zip.*{reason}"):
        Run.open(run.path)


def test_a_run_of_rl_zoo_with_other_steps_on_its_command_line(tmp_path):
    make_run(tmp_path, algo="sac", steps=300, args={"n_timesteps": 300})  # its config.yml says 1,000
    make_run(tmp_path, algo="sac", seed=2, steps=300, args={"n_timesteps": -1})
    runs, _ = find_runs(tmp_path)
    assert [(run.n_timesteps, run.is_finished) for run in runs] == [(300, True), (1000, False)]
    assert len(group_runs(runs)) == 2  # another number of steps is another experiment


def test_the_steps_in_force_are_those_of_the_edited_config(tmp_path):
    """A run started with ``-n 1000`` was shortened to 600 steps before it was resumed, and has taken all of them."""
    args = {"n_timesteps": 1000, "resume_freq": None}
    run = make_run(tmp_path, steps=600, n_timesteps=600, args=args, returns=((1.0,), (3.0,)))  # at 300 and 600
    run.mark_finished(600)
    (found,), _ = find_runs(tmp_path)
    assert (found.n_timesteps, found.settings["n_timesteps"], found.is_complete) == (600, 600, True)
    assert found.late_evaluations().tolist() == [3]
    assert len(provenance.list_unfinished([found], [])) == 0


def test_runs_behind_links_are_found_once(tmp_path):
    logs, disk = tmp_path / "logs", tmp_path / "disk"
    make_run(logs, seed=1)
    make_run(disk, seed=2)
    make_run(disk, seed=3, algo="sac")
    (logs / "tdc" / "Hopper-v4_2").symlink_to(disk / "tdc" / "Hopper-v4_1")
    (logs / "sac").symlink_to(disk / "sac")
    (logs / "a_second_time").symlink_to(logs / "tdc" / "Hopper-v4_1")
    (logs / "tdc" / "loop").symlink_to(logs)
    (disk / "sac" / "loop").symlink_to(tmp_path / "logs")
    (logs / "nowhere").symlink_to(tmp_path / "nowhere")
    runs, unreadable = find_runs(logs)
    assert unreadable == []
    assert [(str(run.folder.path.relative_to(logs)), run.seed) for run in runs] == [
        ("sac/Hopper-v4_1", 3),
        ("tdc/Hopper-v4_1", 1),
        ("tdc/Hopper-v4_2", 2),
    ]
    again, _ = find_runs(logs / "tdc", logs)
    assert [run.seed for run in again] == [1, 2, 3]


def test_of_several_folders_the_last_counts(tmp_path):
    make_run(tmp_path / "results", seed=1, returns=((1.0,),))
    make_run(tmp_path / "logs", seed=1, returns=((2.0,),))
    make_run(tmp_path / "logs", seed=2, returns=((3.0,),))
    (group,) = group_runs(find_runs(tmp_path / "results", tmp_path / "logs")[0])
    assert group.final_returns.tolist() == [2, 3]
    with pytest.raises(ValueError, match=r"There are no runs in .*nothing"):
        find_runs(tmp_path / "results", tmp_path / "nothing")


@pytest.mark.parametrize(("algo", "base"), [("advb_td3", TD3), ("advb_sac", SAC), ("tdc", TDC)])
def test_defaults_are_known_that_a_constructor_passes_on(algo, base):
    defaults = default_settings(algo)
    for name in ("learning_rate", "batch_size", "tau"):
        assert defaults[name] == inspect.signature(base).parameters[name].default, name
    assert defaults.get("formation_period") == (10_000 if "advb" in algo else None)
