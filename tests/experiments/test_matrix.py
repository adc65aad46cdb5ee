"""The run matrix: what is run, for how long; then real matrices, killed and resumed."""

import concurrent.futures
import os
import signal
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import pytest

from sb3_tdc import TDC
from sb3_tdc.cli import matrix
from sb3_tdc.common.files import lock
from sb3_tdc.experiments import jobs as job_module
from sb3_tdc.experiments import matrix as running
from sb3_tdc.experiments import plan as planning
from sb3_tdc.experiments import rates
from sb3_tdc.experiments.jobs import Job, TrainedElsewhereError, eval_freq, stop
from sb3_tdc.experiments.results import find_runs
from sb3_tdc.experiments.suites import SUITES, Cell
from sb3_tdc.runs.folder import RunFolder
from sb3_tdc.runs.training import train
from tests.helpers.matrices import SMALL_TDC, finish, is_running, runs_of
from tests.helpers.matrices import start_matrix as start
from tests.helpers.run_folders import make_run


def plan(suite, seeds=(1,), scale=0.02, only=(), logs=Path("/logs")):
    return planning.make_plan(planning.select(SUITES[suite], only), seeds, scale, logs)


def test_jobs_of_the_paper():
    fig1 = plan("fig1", seeds=(1, 2))
    assert len(fig1.jobs) == 2 * 5 * 5  # seeds × algorithms × tasks
    assert [job.seed for job in fig1.jobs] == [1] * 25 + [2] * 25
    assert fig1.missing == []
    assert len(plan("fig2").jobs) == 10
    assert len(plan("fig3").jobs) == 10
    assert [job.settings for job in plan("figS1").jobs] == [{"lam": 0.0}, {"lam": 1.0}]


def test_cells_of_two_suites_may_be_one_job():
    cells = [Cell("tdc", "Humanoid-v4", {"stochastic_actor": False}), Cell("tdc", "Humanoid-v4", {"lam": 1.0})]
    jobs = planning.make_plan(cells, (1,), 1.0, Path("/logs")).jobs  # hyperparams/ has λ = 1 and the deterministic head
    assert [(job.settings, job.logs) for job in jobs] == [({}, Path("/logs/scale_1/seed_1"))]


def test_other_simulators_are_missing_with_a_hint(monkeypatch):
    for env_id in [env_id for env_id in gym.registry if "BulletEnv" in env_id]:
        monkeypatch.delitem(gym.registry, env_id)
    monkeypatch.setitem(sys.modules, "pybullet", None)  # as if it were not installed
    missing = plan("fig5").missing
    assert any(
        each.startswith("tdc on HopperBulletEnv-v0: ") and 'pip install "sb3-tdc[pybullet]"' in each for each in missing
    )
    assert any(
        each.startswith("sac on Isaac-Franka-Cabinet-Direct-v0: it has no evaluations, and a simulation of its own")
        for each in missing
    )


def test_scaled():
    # HalfCheetah: 0.02 × 1,500,000 steps; the 25,000 random steps are cut to a tenth of the run; 30 evaluations
    def cheetah(scale):
        (job,) = plan("fig1", scale=scale, only=["tdc", "HalfCheetah-v4"]).jobs
        return job

    assert (cheetah(0.02).n_timesteps, cheetah(0.02).config["learning_starts"]) == (30_000, 3000)
    assert (cheetah(1).n_timesteps, cheetah(1).config["learning_starts"]) == (1_500_000, 25_000)
    assert (eval_freq(30_000), eval_freq(1_500_000), eval_freq(7)) == (1000, 20_000, 1)
    assert "-params" not in cheetah(1).arguments  # nothing differs from hyperparams/


def test_a_warm_up_that_a_suite_varies_is_shortened_like_that_of_its_control():
    # Hopper-v4: the control's 5,000 random steps become 600, a tenth of 6,000; five times as many are 3,000
    jobs = plan("hopper", scale=0.02, only=["td3"]).jobs
    assert [(job.n_timesteps, job.config["learning_starts"]) for job in jobs] == [(6000, 3000)]
    assert [job.config["learning_starts"] for job in plan("hopper", scale=1, only=["td3"]).jobs] == [25_000]


def test_a_suite_of_a_length_of_its_own():
    jobs = plan("evidence", scale=1).jobs
    assert [(job.algo, job.env_id, job.settings) for job in jobs[:4]] == [
        ("tdc", "Hopper-v4", {}),
        ("td3", "Hopper-v4", {}),
        ("sac", "Hopper-v4", {}),
        ("tdc", "Hopper-v4", {"lam": 0.0}),
    ]
    assert len(jobs) == 12
    assert {job.n_timesteps for job in jobs} == {300_000}
    assert eval_freq(300_000) == 10_000
    assert jobs[0].logs == Path("/logs/steps_300000/seed_1")
    assert {job.n_timesteps for job in plan("evidence", scale=0.01).jobs} == {3000}


def test_selected():
    assert {(c.algo, c.env_id) for c in planning.select(SUITES["fig1"], ["sac", "Ant-v4"])} == {("sac", "Ant-v4")}
    assert len(planning.select(SUITES["fig1"], ["Ant-v4"])) == 5
    with pytest.raises(ValueError, match="did you mean 'Hopper-v4'"):
        planning.select(SUITES["fig1"], ["Hoper-v4"])


@pytest.mark.parametrize(
    ("seconds", "n_jobs", "expected"),
    [([], 2, 0), ([3, 3, 3], 1, 9), ([3, 3, 3], 2, 6), ([5, 1, 1, 1], 2, 5), ([1, 1, 5], 2, 6)],
)
def test_estimate(seconds, n_jobs, expected):
    assert planning.estimate_seconds(seconds, n_jobs) == expected


def test_rates_are_those_of_finished_runs(tmp_path):
    for seed, seconds, steps in ((1, 10, 1000), (2, 20, 1000), (3, 40, 1000), (4, 1, None)):
        folder = make_run(tmp_path, seed=seed, steps=steps)
        (folder.path / "progress.csv").write_text(f"time/total_timesteps,time/time_elapsed\n500,1\n1000,{seconds}\n")
    assert rates.read_rates(tmp_path) == {("tdc", "Hopper-v4"): 50}  # the median of 100, 50 and 25
    assert rates.read_rates(tmp_path / "nothing") == {}


def test_another_run_in_the_place_of_a_job_is_not_taken(tmp_path):
    job = Job("tdc", "Pendulum-v1", 1, 100, tmp_path, {"lam": 0.5})
    assert job.run_folder is None
    folder = RunFolder.create(tmp_path, "tdc", "Pendulum-v1")
    folder.write_config({**job.config, "lam": 0.7}, {"seed": 1, "eval_freq": 3})
    with pytest.raises(ValueError, match=r"another run \(lam 0.7 instead of 0.5\)"):
        _ = job.run_folder
    folder.write_config(job.config, {"seed": 1, "eval_freq": 3})
    assert (job.run_folder.path, job.steps_done) == (folder.path, 0)
    (folder.resume_folder / "step_000000000040").mkdir(parents=True)
    assert (job.steps_done, job.is_finished) == (40, False)
    folder.mark_finished(100)
    assert (job.steps_done, job.is_finished) == (100, True)


class RayOfThreads:
    """The part of Ray that ``run_jobs`` uses, with threads of this process."""

    exceptions = SimpleNamespace(RayError=RuntimeError)

    def __init__(self):
        self.pool = ThreadPoolExecutor()

    def remote(self, **options):
        return lambda function: SimpleNamespace(remote=lambda job: self.pool.submit(function, job))

    def wait(self, references, timeout):
        return [list(each) for each in concurrent.futures.wait(references, timeout, "FIRST_COMPLETED")]

    def get(self, reference):
        return reference.result()


def train_in_no_time(job):
    folder = RunFolder.create(job.logs, job.algo, job.env_id)
    args = {"algo": job.algo, "env": job.env_id, "seed": job.seed, "eval_freq": eval_freq(job.n_timesteps)}
    folder.write_config(job.config, args)
    folder.mark_finished(job.n_timesteps)
    return 0


@pytest.mark.parametrize("finishes", [True, False])
def test_a_run_that_another_process_trains_is_left_to_it(finishes, tmp_path, monkeypatch, capsys):
    """The others continue meanwhile; if the other process stops before the end, its run is taken over."""
    monkeypatch.setattr(running, "_SECONDS_UNTIL_ASKED_AGAIN", 0.1)
    trained = []
    monkeypatch.setattr(running, "run", lambda job: trained.append(job.seed) or train_in_no_time(job))
    jobs = [Job("tdc", "Pendulum-v1", seed, 100, tmp_path / f"{seed}") for seed in (1, 2, 3)]
    jobs[0].log.parent.mkdir(parents=True)
    with ThreadPoolExecutor() as pool:
        other_process = lock(jobs[0].log)
        outcome = pool.submit(running.run_jobs, RayOfThreads(), jobs, 1)
        deadline = time.monotonic() + 30
        while not jobs[2].is_finished:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        time.sleep(0.5)
        assert not outcome.done()
        assert trained == [2, 3]
        if finishes:
            train_in_no_time(jobs[0])
        other_process.close()
    assert outcome.result().failed == []
    assert trained == ([2, 3] if finishes else [2, 3, 1])
    assert capsys.readouterr().out.count("wait   tdc Pendulum-v1 seed 1: another process trains it") == 1


def test_a_run_has_one_process(tmp_path):
    job = Job("tdc", "Pendulum-v1", 1, 10_000, tmp_path, SMALL_TDC)
    assert not job.is_trained_elsewhere
    process = job.start()
    try:
        assert job.is_trained_elsewhere
        with pytest.raises(TrainedElsewhereError, match="seed 1: another process trains it"):
            job.start()
        assert job_module.run(job) is None
    finally:
        process.kill()
        stop([process])
    assert not job.is_trained_elsewhere


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["figg1"], "did you mean 'fig1'"),
        (["fig1", "--scale", "-1"], "--scale must be above 0"),
        (["fig1", "--seeds", "0"], "at least 1"),
        (["fig1", "--jobs", "0"], "--jobs must be at least 1"),
        (["fig1", "--only", "ppo"], "not in the suite"),
        (["figS1", "--address", "head"], "--address must be HOST:PORT, or auto for the cluster of this machine"),
        (["figS1", "--address", ":6379"], "--address must be HOST:PORT"),
        (["figS1", "--address", "localhost:65536"], "--address must be HOST:PORT"),
        (["figS1", "--address", "nowhere.invalid:6379"], "--address nowhere.invalid:6379: nothing answers there"),
    ],
)
def test_bad_arguments(arguments, sentence, tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        matrix.main([*arguments, "--logs", str(tmp_path)])
    assert stopped.value.code == 2
    assert sentence in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


def test_an_address_is_tried_before_ray_does(monkeypatch):
    monkeypatch.setattr(job_module, "import_ray", lambda: pytest.fail("Ray tries for minutes"))
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
        job_module.check_address(address)
        job_module.check_address(f"ray://{address}")
    with pytest.raises(ValueError, match=f"--address {address}: nothing answers there .Connection refused"):
        with job_module.cluster(address, None):
            pass


def test_logs_that_cannot_be_written(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(matrix, "cluster", lambda *args: pytest.fail("it was started"))
    (tmp_path / "file").write_text("mine")
    with pytest.raises(SystemExit):
        matrix.main(["figS1", "--logs", str(tmp_path / "file" / "logs")])
    assert f"--logs {tmp_path}/file/logs cannot be written: {tmp_path}/file is not a folder" in capsys.readouterr().err


def test_without_ray(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(SystemExit):
        matrix.main(["figS1", "--scale", "0.001", "--logs", str(tmp_path)])
    assert 'pip install "sb3-tdc[tune]"' in capsys.readouterr().err


def test_dry_run_measures(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(SUITES, "fig1", [Cell("tdc", "Pendulum-v1", SMALL_TDC), Cell("advb", "Pendulum-v1")])
    assert matrix.main(["fig1", "--seeds", "2", "--scale", "0.001", "--dry-run", "--logs", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "no ADVB" in out
    assert out.count("run    tdc Pendulum-v1") == 2
    assert out.count("steps/s") == 1
    assert "2 of 2 to run" in out
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("warm_up", [{}, {"learning_starts": 25_000}, {"learning_starts": 0}])
def test_a_rate_is_measured_with_updates_whatever_the_warm_up(warm_up, tmp_path, monkeypatch):
    outcomes = []

    def train_and_keep(run):
        outcomes.append(train(run))
        return outcomes[-1]

    monkeypatch.setattr(rates, "train", train_and_keep)
    assert rates.measure_rate(Job("tdc", "Pendulum-v1", 1, 300_000, tmp_path, {**SMALL_TDC, **warm_up})) > 0
    (outcome,) = outcomes
    assert outcome.model.num_timesteps == 300
    assert outcome.model._n_updates >= 200


# ---------------------------------------------------------------- real matrices


def fingerprint(run):
    state = TDC.load(run.folder.model, device="cpu").policy.state_dict()
    return {key: value.tolist() for key, value in state.items()}, run.evaluations.returns.tolist()


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_a_matrix_that_is_stopped_goes_on_to_the_same_end(tmp_path, how):
    scale = ["--scale", "0.003", "--jobs", "2"]  # 3,000 steps
    out, status = finish(start("fig1", tmp_path / "alone", *scale))
    assert status == 0, out

    process = start("fig1", tmp_path / "killed", *scale)
    deadline = time.monotonic() + 200
    while len(list((tmp_path / "killed").rglob("resume/step_000000000[1-9]*"))) < 2:
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.1)
    family = runs_of(process.pid)
    assert family
    os.kill(process.pid, how)
    out, status = finish(process)
    assert status == {signal.SIGKILL: -9, signal.SIGINT: 130}[how], out
    deadline = time.monotonic() + 30
    while any(is_running(pid) for pid in family):  # no run outlives the matrix
        assert time.monotonic() < deadline, [pid for pid in family if is_running(pid)]
        time.sleep(0.1)
    assert not all(r.is_finished for r in find_runs(tmp_path / "killed")[0])

    out, status = finish(start("fig1", tmp_path / "killed", *scale))
    assert status == 0, out
    assert "resume tdc" in out
    alone, killed = (find_runs(tmp_path / name)[0] for name in ("alone", "killed"))
    assert len(alone) == len(killed) == 2
    for one, other in zip(alone, killed, strict=True):
        assert fingerprint(one) == fingerprint(other)


@pytest.mark.slow
def test_two_matrices_share_the_runs(tmp_path):
    both = [start("fig1", tmp_path, "--scale", "0.003", "--jobs", "1") for _ in range(2)]
    for process in both:
        out, status = finish(process)
        assert status == 0, out
    runs = find_runs(tmp_path)[0]
    assert [run.is_finished for run in runs] == [True, True]
    assert {run.folder.path.name for run in runs} == {"Pendulum-v1_1"}


@pytest.mark.skipif(not Path("/proc/self/autogroup").exists(), reason="Linux without groups of sessions")
def test_a_run_keeps_the_niceness_of_the_matrix():
    """A run has its own session, which Linux would otherwise schedule with a niceness of 0."""
    code = "import os; os.nice(1); from sb3_tdc.cli import job; job.keep_niceness()"
    code += "; print(open('/proc/self/autogroup').read())"
    done = subprocess.run([sys.executable, "-c", code], start_new_session=True, capture_output=True, text=True)
    assert done.stdout.strip().endswith(f"nice {min(os.nice(0) + 1, 19)}")
