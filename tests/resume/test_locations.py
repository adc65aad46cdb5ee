"""A run that was moved, copied, or resumed from another working directory writes into its own folder, nowhere else."""

import os
import shutil
import signal
from pathlib import Path

import gymnasium as gym
import pandas as pd
import pytest
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure

from sb3_tdc.resume import ResumeCallback
from sb3_tdc.resume.locations import Locations
from sb3_tdc.runs.callbacks.progress import ProgressCallback
from tests.helpers.training import SMALL, fails, outcome, resume, run_train
from tests.tools.runs import CASES, Stop, StopAt, run

CASE = CASES["TD3"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return run(CASE, tmp_path_factory.mktemp("whole"))


@pytest.fixture
def place(tmp_path, monkeypatch):
    """The folder above a stopped run, which was given by a relative path; the working directory has changed since."""
    (tmp_path / "there").mkdir()
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "there")
    run(CASE, Path("mine"), stop_at=190)
    monkeypatch.chdir(tmp_path / "elsewhere")
    return tmp_path


def snapshot(folder):
    """:return: every file below a folder, with its bytes and its time"""
    return {
        path.relative_to(folder): (path.read_bytes(), path.stat().st_mtime_ns)
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_resumed_from_another_working_directory(place, whole):
    assert run(CASE, place / "there" / "mine") == whole
    assert snapshot(place / "elsewhere") == {}


def test_resumed_by_a_relative_path_from_another_working_directory(place, whole):
    assert run(CASE, Path("../there/mine")) == whole
    assert snapshot(place / "elsewhere") == {}


def test_moved(place, whole):
    shutil.move(place / "there" / "mine", place / "yours")
    assert run(CASE, place / "yours") == whole
    assert snapshot(place / "there") == snapshot(place / "elsewhere") == {}


def test_moved_and_another_run_has_taken_its_place(place, whole):
    shutil.move(place / "there" / "mine", place / "yours")
    run(CASE, place / "there" / "mine", stop_at=150)
    other = snapshot(place / "there")
    assert run(CASE, place / "yours") == whole
    assert snapshot(place / "there") == other


def test_copied(place, whole):
    shutil.copytree(place / "there" / "mine", place / "copy")
    original = snapshot(place / "there")
    assert run(CASE, place / "copy") == whole
    assert snapshot(place / "there") == original
    assert run(CASE, place / "there" / "mine") == whole


def test_a_folder_reached_by_a_link(tmp_path, monkeypatch, whole):
    (tmp_path / "disk").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "disk")
    run(CASE, tmp_path / "link" / "mine", stop_at=190)
    shutil.move(tmp_path / "disk" / "mine", tmp_path / "moved")
    assert run(CASE, tmp_path / "moved") == whole
    assert snapshot(tmp_path / "disk") == {}


@pytest.mark.parametrize("relative", [False, True])
def test_a_copy_of_a_run_with_a_tensorboard_folder_outside_leaves_that_of_the_original_alone(
    tmp_path, monkeypatch, relative
):
    monkeypatch.chdir(tmp_path)
    board = Path("board") if relative else tmp_path / "board"
    with monkeypatch.context() as patch:
        stop_with_sigterm(patch, 290)
        assert run_train(tmp_path, "-tb", board) == 130
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    mine = tmp_path / "tdc" / "Hopper-v4_1"
    shutil.copytree(mine, tmp_path / "copy")
    before = snapshot(tmp_path / "board")
    assert resume(tmp_path / "copy") == 0
    after = snapshot(tmp_path / "board")
    assert {path: after[path] for path in before} == before
    new = {path.parent for path in after} - {path.parent for path in before}
    assert new == {Path("Hopper-v4/TDC_2")}
    assert resume(mine) == 0
    boards = tmp_path / "board" / "Hopper-v4"
    assert events_in(boards / "TDC_1") == events_in(boards / "TDC_2")
    assert outcome_without_events(tmp_path / "copy") == outcome_without_events(mine)
    assert snapshot(tmp_path / "elsewhere") == {}


def learn_with_board(run_folder, board, steps=80, stop_at=None, **kwargs):
    """Train with SB3's ``tensorboard_log``, which opens the latest folder if ``reset_num_timesteps`` is False."""
    small = {"policy_kwargs": {"net_arch": [4]}, "buffer_size": 200, "learning_starts": 500, "device": "cpu"}
    model = TD3("MlpPolicy", "Pendulum-v1", seed=1, tensorboard_log=str(board), **small)
    states = ResumeCallback(run_folder / "resume", freq=20, verbose=0)
    states.select(model)
    try:
        model.learn(steps, callback=[states, StopAt(stop_at)], **kwargs)
    except Stop:
        pass
    finally:
        states.store.close()
        model.logger.close()


@pytest.mark.parametrize(
    ("change", "resumed", "continued"),
    [
        ("nothing", "mine", "TD3_1"),
        ("copy", "copy", "TD3_3"),
        ("copy, latest", "copy", "TD3_2"),
        ("lost", "mine", "TD3_3"),
    ],
)
def test_events_of_another_run_stay_whichever_folder_is_opened(tmp_path, change, resumed, continued):
    board = tmp_path / "board"
    learn_with_board(tmp_path / "mine", board, stop_at=50)
    if change != "copy, latest":
        learn_with_board(tmp_path / "other", board)
    if change.startswith("copy"):
        shutil.copytree(tmp_path / "mine", tmp_path / "copy")
    elif change == "lost":
        shutil.rmtree(board / "TD3_1")
    before = snapshot(board)
    learn_with_board(tmp_path / resumed, board, reset_num_timesteps=False)
    others = {path: file for path, file in before.items() if path.parent.name != continued}
    assert others
    assert others.items() <= snapshot(board).items()
    kept = [] if change == "lost" else [path.name for path in before if path.parent.name == "TD3_1"]
    names = [path.name for path in sorted((board / continued).iterdir())]
    assert (names[:-1], len(names)) == (kept, len(kept) + 1)
    assert len(list(board.iterdir())) == len({path.parent for path in before} | {Path(continued)})


def stop_with_sigterm(patch, step):
    original = ProgressCallback._on_step

    def on_step(self):
        if self.num_timesteps == step:
            os.kill(os.getpid(), signal.SIGTERM)
        return original(self)

    patch.setattr(ProgressCallback, "_on_step", on_step)


def events_in(folder):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder), size_guidance={"scalars": 0}).Reload()
    tags = set(events.Tags()["scalars"]) - {"time/fps", "time/critics_elapsed", "time/time_elapsed"}
    return {tag: [(event.step, event.value) for event in events.Scalars(tag)] for tag in tags}


def outcome_without_events(folder):
    return {name: value for name, value in outcome(folder).items() if not name.startswith("TensorBoard")}


# ---------------------------------------------------------------- the Python interface


class Notes(BaseCallback):
    """A user's callback that keeps locations, and texts that are not locations."""

    def __init__(self, folder):
        super().__init__()
        self.folder, self.path, self.label = str(folder), Path(folder), "a/b"
        self.newest = {"file": "", "files": [str(folder / "start.txt")]}
        self.first = Path("none")

        def name(step, folder=self.folder, *, path=self.path):
            return f"{folder} {path} {step}"

        self.name = name

    def _on_step(self):
        if self.num_timesteps == 1:
            self.first = self.path / "first.txt"
        self.newest["file"] = os.path.join(self.folder, f"{self.num_timesteps}.txt")
        self.newest["files"].append(self.newest["file"])
        self.label = f"step/{self.num_timesteps}"
        return True


def learn(folder, outside, stop_at=None):
    env = make_vec_env("Pendulum-v1", seed=1)
    small = {"policy_kwargs": {"net_arch": [4]}, "buffer_size": 200, "learning_starts": 500, "device": "cpu"}
    model = SAC("MlpPolicy", env, seed=1, **small)
    states = ResumeCallback(folder / "resume", freq=20, verbose=0)
    inside, notes = Notes(folder), Notes(outside)
    evaluation = EvalCallback(make_vec_env("Pendulum-v1"), eval_freq=30, log_path=str(outside / "eval"), verbose=0)
    saving = CheckpointCallback(25, str(outside / "models"))
    states.select(model)
    try:
        model.learn(100, callback=[states, inside, notes, evaluation, saving, StopAt(stop_at)])
    except Stop:
        pass
    finally:
        states.store.close()
    return inside, notes


def test_what_was_built_with_another_location_stays_as_it_is_built_now(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    learn(Path("run"), Path("outside"), stop_at=50)
    shutil.move("run", "moved")
    before = snapshot(tmp_path / "outside")
    inside, notes = learn(tmp_path / "moved", tmp_path / "new")
    assert snapshot(tmp_path / "outside") == before
    assert {path.name for path in (tmp_path / "new").rglob("*.*")} == {
        "evaluations.npz",
        "rl_model_50_steps.zip",
        "rl_model_75_steps.zip",
        "rl_model_100_steps.zip",
    }
    # A location in the run's folder moves with it, even if it changed during the run; any other that changed stays
    assert (inside.folder, inside.path) == (str(tmp_path / "moved"), tmp_path / "moved")
    names = ["start.txt", *(f"{step}.txt" for step in range(1, 101))]
    assert inside.newest["files"] == [str(tmp_path / "moved" / name) for name in names]
    assert (notes.folder, notes.path) == (str(tmp_path / "new"), tmp_path / "new")
    assert notes.newest["files"][:2] == [str(tmp_path / "new" / "start.txt"), "outside/1.txt"]
    assert notes.newest["files"][-1] == str(tmp_path / "new" / "100.txt")
    assert (inside.first, notes.first) == (tmp_path / "moved" / "first.txt", Path("outside/first.txt"))
    assert notes.name(1) == f"{tmp_path / 'new'} {tmp_path / 'new'} 1"
    assert inside.label == notes.label == "step/100"


def test_a_run_that_was_moved_into_its_former_folder(tmp_path):
    learn(tmp_path / "run", tmp_path / "outside", stop_at=50)
    shutil.move(tmp_path / "run", tmp_path / "moved")
    shutil.move(tmp_path / "moved", tmp_path / "run" / "copy")
    folder = tmp_path / "run" / "copy"
    inside, _ = learn(folder, tmp_path / "outside")
    assert (inside.folder, inside.path, inside.first) == (str(folder), folder, folder / "first.txt")
    assert inside.newest["files"][1] == str(folder / "1.txt")
    assert inside.name(1) == f"{folder} {folder} 1"


@pytest.mark.parametrize(
    ("text", "existing", "expected"),
    [
        ("runs/a/x.npz", "runs/a/x.npz", "/new/a/x.npz"),
        ("runs/a", None, "/new/a"),
        ("./runs//a/x", None, "/new/a/x"),
        ("/home/runs/a/x", None, "/new/a/x"),
        ("/home/runs/b/x", None, "/home/runs/b/x"),
        ("/home/runs/ab/x", None, "/home/runs/ab/x"),
        ("runs/a/../b/x", None, "runs/a/../b/x"),
        ("built/there", "built/here", "built/here"),
        ("built/there", None, "built/there"),
        ("name", "other", "name"),
        ("", "other/x", ""),
    ],
)
def test_where_a_text_of_then_leads_to_now(text, existing, expected):
    locations = Locations("/home", ("/home/runs/a",), "/new/a", {"x.path": "built/there", "x.name": "name"}, "runs/a")
    path = "x.name" if text == "name" else "x.path"
    assert locations.find(text, existing, path) == expected


@pytest.mark.parametrize(
    ("directory", "folder"), [(".", "/base/train"), ("train", "."), ("train/sub", ".."), ("train/sub", "/base/train")]
)
@pytest.mark.parametrize("text", ["train/loss", "train", "sub/loss", "rollout/reward", "../train/loss"])
def test_a_relative_text_is_no_location_where_the_folder_was_not_given_so(
    tmp_path, monkeypatch, directory, folder, text
):
    (tmp_path / "train" / "sub").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / directory)
    captured = Locations.capture(Path(folder.replace("/base", str(tmp_path))), {})
    locations = Locations.restore(captured, Path("/new/a"))
    assert locations.find(text, None, "x") == text
    assert locations.find(str(tmp_path / "train" / "loss"), None, "x") == "/new/a/loss"
    as_path = os.path.relpath(tmp_path / "train" / "notes.txt")
    assert locations.find(as_path, None, "x", is_path=True) == "/new/a/notes.txt"


def test_a_relative_text_that_begins_as_the_folder_was_given_is_a_location(tmp_path, monkeypatch):
    (tmp_path / "beside").mkdir()
    monkeypatch.chdir(tmp_path / "beside")
    locations = Locations.restore(Locations.capture(Path("../train/"), {}), Path("/new/a"))
    assert locations.find("../train/loss", None, "x") == "/new/a/loss"
    assert locations.find("train/loss", None, "x") == "train/loss"


def test_a_run_folder_that_is_the_working_directory_does_not_take_every_text_with_a_slash():
    locations = Locations("/home/a", ("/home/a",), "/new/a")
    assert locations.find("rollout/reward", None, "x") == "rollout/reward"
    assert locations.find("/home/a/rollout/reward", None, "x") == "/new/a/rollout/reward"
    assert locations.find("notes.txt", None, "x", is_path=True) == "/new/a/notes.txt"


class Means(BaseCallback):
    """A user's callback that keeps numbers by name, and by file."""

    def __init__(self, folder):
        super().__init__()
        self.folder = folder
        self.means = dict.fromkeys(["train", "train/reward", ("train/reward", 1), Path(folder, "a"), f"{folder}/b"], 0)

    def _on_step(self):
        self.means = dict.fromkeys(self.means, self.num_timesteps)
        return True


def learn_with_columns(folder, stop_at=None):
    """:return: the columns of ``progress.csv``, by name and without the times, and the names of the means"""
    small = {"policy_kwargs": {"net_arch": [4]}, "buffer_size": 200, "learning_starts": 5, "batch_size": 4}
    model = SAC("MlpPolicy", gym.make("Pendulum-v1", max_episode_steps=20), seed=1, device="cpu", **small)
    model.set_logger(configure(str(folder), ["csv"]))
    states, means = ResumeCallback(folder / "resume", freq=20, verbose=0), Means(folder)
    states.select(model)
    try:
        model.learn(90, callback=[states, means, StopAt(stop_at)], log_interval=1)
    except Stop:
        return {}
    finally:
        states.store.close()
        model.logger.close()
    columns = pd.read_csv(folder / "progress.csv")
    return {name: list(columns[name]) for name in sorted(columns) if name not in _TIMES}, list(means.means)


_TIMES = ("time/fps", "time/time_elapsed")


@pytest.mark.parametrize(
    ("folder", "directory", "moved"),
    [
        ("{base}/train", ".", "{base}/train"),
        ("{base}/train", "train/sub", "{base}/train"),
        ("train", ".", "yours"),
        ("..", "train/sub", "{base}/yours"),
    ],
)
def test_names_that_look_like_files_of_the_run_stay_names(tmp_path, monkeypatch, folder, directory, moved):
    folder, moved = Path(folder.format(base=tmp_path)), Path(moved.format(base=tmp_path))
    monkeypatch.chdir(tmp_path)
    whole, _ = learn_with_columns(tmp_path / "whole")
    Path("train/sub").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / directory)
    learn_with_columns(folder, stop_at=70)
    monkeypatch.chdir(tmp_path)
    if moved.name == "yours":
        shutil.move("train", "yours")
    columns, names = learn_with_columns(moved)
    assert columns == whole
    assert names[:3] == ["train", "train/reward", ("train/reward", 1)]
    assert names[3:] == [moved / "a", str(moved / "b") if folder.is_absolute() else f"{folder}/b"]


# ---------------------------------------------------------------- a model that the run started from


@pytest.mark.parametrize("place", ["moved", "gone", "another"])
def test_a_run_that_started_from_a_model_continues_wherever_that_model_is_now(tmp_path, place):
    others = ["-params", "learning_starts:50", "batch_size:16"]
    wide = [*others, "policy_kwargs:{net_arch: [24], n_quantiles: 5}"]
    assert run_train(tmp_path / "first", "--save-replay-buffer", n=120, small=wide) == 0
    first = tmp_path / "first" / "tdc" / "Hopper-v4_1"
    further = ["-i", first / "Hopper-v4.zip"]
    assert run_train(tmp_path / "whole", *further, n=300, small=others) == 0  # its networks are those of the zip
    with pytest.MonkeyPatch.context() as patch:
        stop_with_sigterm(patch, 190)
        assert run_train(tmp_path / "mine", *further, n=300, small=others) == 130
    if place == "another":
        assert run_train(tmp_path / "other", n=60) == 0
        shutil.rmtree(first)
        shutil.move(tmp_path / "other" / "tdc" / "Hopper-v4_1", first)
    elif place == "gone":
        shutil.rmtree(first)
    else:
        shutil.move(first, tmp_path / "elsewhere")
    mine = tmp_path / "mine" / "tdc" / "Hopper-v4_1"
    assert resume(mine) == 0
    assert outcome(mine) == outcome(tmp_path / "whole" / "tdc" / "Hopper-v4_1")


@pytest.mark.parametrize("place", ["gone", "another"])
def test_a_run_that_started_from_a_model_starts_over_from_the_same(tmp_path, place):
    normalized = [*SMALL, "normalize:true"]
    assert run_train(tmp_path / "first", n=120, small=normalized) == 0
    first, mine = tmp_path / "first" / "tdc" / "Hopper-v4_1", tmp_path / "mine" / "tdc" / "Hopper-v4_1"
    assert run_train(tmp_path / "mine", "-i", first / "Hopper-v4.zip", n=160, small=normalized) == 0
    before = outcome(mine)
    shutil.rmtree(first)
    if place == "another":
        assert run_train(tmp_path / "first", n=110, small=normalized) == 0
    assert resume(mine, "--start-over") == 0
    assert outcome(mine) == before


def test_a_run_does_not_start_over_without_the_replay_buffer_that_it_began_with(tmp_path, capsys):
    assert run_train(tmp_path / "first", "--save-replay-buffer", n=120) == 0
    first, mine = tmp_path / "first" / "tdc" / "Hopper-v4_1", tmp_path / "mine" / "tdc" / "Hopper-v4_1"
    assert run_train(tmp_path / "mine", "-i", first / "Hopper-v4.zip", n=160) == 0
    before = outcome(mine)
    shutil.move(first, tmp_path / "moved")
    missing = f"{first / 'replay_buffer.pkl'}, the replay buffer that the run started from, is missing or has changed"
    assert missing in fails(lambda: resume(mine, "--start-over"), capsys)
    first.mkdir()
    (first / "replay_buffer.pkl").write_bytes((tmp_path / "moved" / "replay_buffer.pkl").read_bytes())
    assert missing in fails(lambda: resume(mine, "--start-over"), capsys)
    shutil.move(tmp_path / "moved" / "replay_buffer.pkl", first / "replay_buffer.pkl")
    assert resume(mine, "--start-over") == 0
    assert outcome(mine) == before
