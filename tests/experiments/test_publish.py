"""What is published of a run, that a report on it says the same, and that the matrix does not run it again."""

import shlex
import shutil
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

from sb3_tdc.cli import evaluate, matrix, publish, train
from sb3_tdc.common import plain_yaml
from sb3_tdc.experiments import final_episodes, plan
from sb3_tdc.experiments import publish as publishing
from sb3_tdc.experiments.results import Run, find_runs
from sb3_tdc.experiments.suites import SUITES, Cell
from tests.helpers.run_folders import make_run
from tests.safe_load.attacks.tools import with_fields


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """A real run in its place in a matrix, with test episodes."""
    folder = tmp_path_factory.mktemp("logs")
    (job,) = plan.make_plan([Cell("tdc", "Pendulum-v1", SMALL, 600)], [3], 1.0, folder).jobs
    assert train.main([*job.arguments, "--verbose", "0", "--log-interval", "1"]) == 0
    assert evaluate.main([str(folder), "--episodes", "4"]) == 0
    return folder


SMALL = {
    "learning_starts": 50,
    "batch_size": 8,
    "buffer_size": 1000,
    "policy_kwargs": {"net_arch": [8], "n_quantiles": 4},
}


def test_the_published_run_says_what_the_run_says(logs, tmp_path, monkeypatch):
    monkeypatch.setattr(publishing, "_ROWS", 2)
    assert publish.main([str(logs), "-o", str(tmp_path)]) == 0
    ((before,), _), ((after,), unreadable) = find_runs(logs), find_runs(tmp_path)
    assert unreadable == []
    assert after.settings == before.settings
    assert (after.seed, after.steps, after.n_timesteps, after.is_finished) == (3, 600, 600, True)
    assert after.system == before.system
    assert "mujoco" in after.system
    assert np.array_equal(after.evaluations.returns, before.evaluations.returns)
    assert np.array_equal(final_episodes.read_test_returns(after), final_episodes.read_test_returns(before))
    rows = before.progress("time/total_timesteps", "eval/mean_reward")
    assert len(rows) > 10
    assert after.progress("time/total_timesteps", "eval/mean_reward") == pytest.approx(rows, rel=1e-5)
    variances = after.progress("time/total_timesteps", "train/td_error_var")
    assert {tuple(row) for row in variances} <= {
        (step, float(f"{value:.6g}")) for step, value in before.progress("time/total_timesteps", "train/td_error_var")
    }


def test_no_path_of_the_machine_and_no_model_is_published(logs, tmp_path):
    publish.main([str(logs), "-o", str(tmp_path)])
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert not any(path.suffix in (".zip", ".pkl") for path in files)
    assert not any(str(logs).encode() in path.read_bytes() for path in files)
    assert sum(path.stat().st_size for path in files) < 40_000
    (args,) = tmp_path.rglob("args.yml")
    assert plain_yaml.load(args.read_text(), "")["log_folder"] == str(args.parents[3].relative_to(tmp_path))


def test_the_matrix_skips_what_is_published(logs, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(SUITES, "fig1", [Cell("tdc", "Pendulum-v1", SMALL, 600)])
    publish.main([str(logs), "-o", str(tmp_path / "results")])
    command = ["fig1", "--seeds", "3", "4", "--logs", str(tmp_path / "logs"), "--results", str(tmp_path / "results")]
    monkeypatch.setattr(plan, "measure_rate", lambda job: 100.0)
    assert matrix.main([*command, "--dry-run"]) == 0
    out = capsys.readouterr().out
    assert f"1 of 2 runs are in {tmp_path / 'results'}" in out
    assert "1 of 1 to run" in out
    assert "seed 4" in out
    assert matrix.main([*command, "--dry-run", "--retrain"]) == 0
    assert "2 of 2 to run" in capsys.readouterr().out
    monkeypatch.setattr(matrix, "cluster", lambda *args: nullcontext())
    monkeypatch.setattr(matrix, "run_jobs", lambda *args: SimpleNamespace(failed=[], stopped=False))
    assert matrix.main(command) == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("To look at them: ")]
    assert line.endswith(f" report {tmp_path / 'results'} {tmp_path / 'logs' / 'steps_600'}")


def test_unfinished_runs_are_not_published(logs, tmp_path, capsys):
    copy = tmp_path / "logs"
    shutil.copytree(logs, copy)
    next(copy.rglob("finished.yml")).unlink()
    assert publish.main([str(copy), "-o", str(tmp_path / "results")]) == 1
    assert f"Nothing to publish: {copy} has no run that is finished" in capsys.readouterr().err
    assert not (tmp_path / "results").exists()


def test_a_place_that_cannot_be_written_is_said_at_once(logs, tmp_path, capsys):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(SystemExit) as stopped:
        publish.main([str(logs), "-o", str(tmp_path / "file" / "results")])
    assert stopped.value.code == 2
    captured = capsys.readouterr()
    assert f"-o {tmp_path}/file/results cannot be written: {tmp_path}/file is not a folder" in captured.err
    assert captured.out == ""


def test_a_run_without_test_episodes_is_named(logs, tmp_path, capsys):
    copy = tmp_path / "logs"
    shutil.copytree(logs, copy)
    next(copy.rglob("test_returns.npz")).unlink()
    assert publish.main([str(copy), "-o", str(tmp_path / "results")]) == 1
    assert "Without test episodes" in capsys.readouterr().out


def test_the_command_that_plays_them_names_the_packages_of_the_runs(tmp_path, capsys):
    for seed, args in enumerate(({"gym_packages": ["one", "two"]}, {"gym_packages": ["one"]}, {}), 1):
        finish(make_run(tmp_path / "logs", seed=seed, args=args))
    publish.main([str(tmp_path / "logs"), "-o", str(tmp_path / "results")])
    assert f" evaluate {tmp_path}/logs --gym-packages one two)\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("command", "published"),
    [
        ("/home/me/.venv/bin/python train.py --env 'a b'", "python train.py --env 'a b'"),
        ("/home/me/.venv/bin/python /home/me/.venv/bin/sb3-tdc train -n 5", "sb3-tdc train -n 5"),
        ("/usr/bin/python3 -m sb3_tdc train", "python3 -m sb3_tdc train"),
        ("sb3-tdc train --algo tdc", "sb3-tdc train --algo tdc"),
    ],
)
def test_commands_name_no_folders_of_programs(command, published):
    assert publishing._without_programs(command) == published


@pytest.mark.parametrize(
    ("given", "published"),
    [
        *((f"{flag} .", [flag, "steps_5/seed 1"]) for flag in ("-f", "--folder", "--log-folder")),
        ("--folder=.", ["--folder=steps_5/seed 1"]),
        ("--log-folder=.", ["--log-folder=steps_5/seed 1"]),
        ("-f.", ["-fsteps_5/seed 1"]),
        ("", []),
    ],
)
def test_the_log_folder_of_a_command_is_replaced_and_nothing_else(given, published):
    command = f"python train.py {given} -n 500 -params lam:0.5 'env_wrapper:[a.B]'"
    words = shlex.split(publishing._with_log_folder(command, "steps_5/seed 1"))
    assert words == ["python", "train.py", *published, "-n", "500", "-params", "lam:0.5", "env_wrapper:[a.B]"]


def test_test_returns_of_another_model_do_not_stay(logs, tmp_path):
    copy, results = tmp_path / "logs", tmp_path / "results"
    shutil.copytree(logs, copy)
    publish.main([str(copy), "-o", str(results)])
    assert len(list(results.rglob("test_returns.npz"))) == 1
    with_fields(next(logs.rglob("Pendulum-v1.zip")), next(copy.rglob("Pendulum-v1.zip")), _n_updates=1_000_000)
    publish.main([str(copy), "-o", str(results)])
    assert list(results.rglob("test_returns.npz")) == []
    assert len(list(results.rglob("evaluations.npz"))) == 1


def test_a_run_of_rl_zoo_stays_finished(tmp_path):
    """It has no finished.yml: its model tells that it is finished, and models are not published."""
    run = Run.open(make_run(tmp_path / "logs", "sac", steps=1000).path)
    assert run.folder.steps_at_end is None
    copy = Run.open(publishing.publish(run, tmp_path / "logs", tmp_path / "results"))
    assert (copy.is_averaged, copy.steps) == (True, 1000)


def test_a_run_without_a_log_is_published(logs, tmp_path):
    copy = tmp_path / "logs"
    shutil.copytree(logs, copy)
    for content in (None, ""):
        log = next(path.parent for path in copy.rglob("evaluations.npz")) / "progress.csv"
        log.unlink() if content is None else log.write_text(content)
        assert publish.main([str(copy), "-o", str(tmp_path / "results")]) == 0
        (run,), unreadable = find_runs(tmp_path / "results")
        assert (unreadable, len(run.log)) == ([], 0)


def test_results_are_not_published_over_the_runs(logs, capsys):
    before = {path: path.read_bytes() for path in logs.rglob("*") if path.is_file()}
    for output in (logs / ".." / logs.name, logs / "results"):
        with pytest.raises(SystemExit):
            publish.main([str(logs), "-o", str(output)])
        assert "-o must not lie in the folder of the runs" in capsys.readouterr().err
    assert before == {path: path.read_bytes() for path in logs.rglob("*") if path.is_file()}


def finish(run, steps=1000):
    """Mark a run as finished, so that it is published without being trained."""
    run.mark_finished(steps)
    return run


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    ("changed", "what"), [({"seed": 2}, "seed 1 instead of 2"), ({"lam": 0.25}, "lam 1.0 instead of 0.25")]
)
def test_another_published_run_is_not_overwritten(tmp_path, capsys, changed, what):
    finish(make_run(tmp_path / "one", lam=1.0))
    finish(make_run(tmp_path / "other", **{"lam": 1.0, **changed}))
    finish(make_run(tmp_path / "other", algo="td3"))
    results = tmp_path / "results"
    publish.main([str(tmp_path / "one"), "-o", str(results)])
    before = contents(results)
    capsys.readouterr()
    assert publish.main([str(tmp_path / "other"), "-o", str(results)]) == 1
    place = "tdc/Hopper-v4_1"
    assert f"other/{place} is not published: {results}/{place} is another run ({what})" in capsys.readouterr().err
    after = contents(results)
    assert {path: after[path] for path in before} == before
    assert (results / "td3" / "Hopper-v4_1" / "evaluations.npz").is_file()


def test_a_run_is_published_again_with_what_it_has_by_now(tmp_path):
    run = finish(make_run(tmp_path / "logs"))
    assert publish.main([str(tmp_path / "logs"), "-o", str(tmp_path / "results")]) == 1  # without test episodes
    checksum = final_episodes.checksum(Run.open(run.path))
    np.savez(run.test_returns, checksum=checksum, returns=[5.0, 6.0])
    assert publish.main([str(tmp_path / "logs"), "-o", str(tmp_path / "results")]) == 0
    assert final_episodes.read_test_returns(find_runs(tmp_path / "results")[0][0]).tolist() == [5, 6]


def test_a_run_is_published_again_after_what_may_be_changed_of_it(tmp_path, capsys):
    logs, results = str(tmp_path / "logs"), tmp_path / "results"
    run = finish(make_run(tmp_path / "logs", lam=1.0, kappa=1.0))
    publish.main([logs, "-o", str(results)])
    config = {**run.config, "kappa": 2.0, "n_timesteps": 2000}
    run.record_change(500, config, ("kappa",))
    capsys.readouterr()
    publish.main([logs, "-o", str(results)])
    assert "is another run" not in capsys.readouterr().err
    (published,), _ = find_runs(results)
    assert (published.n_timesteps, published.folder.config["kappa"]) == (2000, 2.0)
    (published.folder.path / "evaluations.npz").write_bytes(b"damaged")
    assert publish.main([logs, "-o", str(results)]) == 1
    assert f"; remove {published.folder.path} to publish it again" in capsys.readouterr().err


@pytest.mark.parametrize("part", ["logs/tdc", "logs/tdc/Hopper-v4_1", "."])
def test_a_part_of_a_log_folder_is_published_in_its_place(tmp_path, monkeypatch, part):
    run = finish(make_run(tmp_path / "logs"))
    monkeypatch.chdir(run.path if part == "." else tmp_path)
    publish.main([part, "-o", str(tmp_path / "results")])
    (published,), unreadable = find_runs(tmp_path / "results")
    assert unreadable == []
    assert published.folder.path == tmp_path / "results" / "tdc" / "Hopper-v4_1"
    assert published.folder.args["log_folder"] == "."


def test_a_run_is_not_published_over_itself(tmp_path, capsys):
    run = finish(make_run(tmp_path / "logs", log={"train/lam": [1.0]}))
    (run.path / "Hopper-v4.zip").unlink()  # as if it were itself a published copy
    before = contents(tmp_path)
    assert publish.main([str(tmp_path / "logs" / "tdc"), "-o", str(tmp_path / "logs")]) == 1
    assert "logs/tdc/Hopper-v4_1 is itself a run" in capsys.readouterr().err
    assert contents(tmp_path) == before


def test_a_trained_run_is_not_overwritten_by_the_copy_of_its_repetition(tmp_path, capsys):
    for logs in ("logs", "others"):
        finish(make_run(tmp_path / logs))
    before = contents(tmp_path / "others")
    assert publish.main([str(tmp_path / "logs"), "-o", str(tmp_path / "others")]) == 1
    assert "others/tdc/Hopper-v4_1 is itself a run, not the copy of one" in capsys.readouterr().err
    assert contents(tmp_path / "others") == before
