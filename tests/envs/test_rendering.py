"""Pictures without a display."""

import os
import subprocess
import sys
from typing import ClassVar

import gymnasium as gym
import imageio.v2 as imageio
import numpy as np
import pytest
from PIL import Image, ImageSequence

from sb3_tdc.cli import enjoy, train
from sb3_tdc.envs import rendering
from tests.helpers.paths import ROOT


@pytest.mark.parametrize("env_id", ["HalfCheetah-v4", "Hopper-v4", "Walker2d-v4", "Ant-v4", "Humanoid-v4"])
def test_the_camera_follows_the_agent(env_id):
    env = gym.make(env_id, render_mode="rgb_array")
    rendering.follow_agent(env)
    renderer = env.unwrapped.mujoco_renderer
    assert renderer.model.camera(renderer.camera_id).name == "track"  # for recorded frames
    assert renderer.model.body(renderer.default_cam_config["trackbodyid"]).name != "world"  # for a window


def test_a_camera_that_was_asked_for_stays():
    env = gym.make("HalfCheetah-v5", render_mode="rgb_array", camera_id=0)
    rendering.follow_agent(env)
    assert env.unwrapped.mujoco_renderer.camera_id == 0
    rendering.follow_agent(gym.make("Pendulum-v1"))  # nothing to do


def test_no_backend_is_said_with_its_remedy(monkeypatch):
    for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(rendering, "_TRY_BACKEND", "raise SystemExit(1)")
    with pytest.raises(ValueError, match=r"neither EGL nor OSMesa works.*apt-get install"):
        rendering.choose_gl_backend()
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    with pytest.raises(ValueError, match=r"MuJoCo cannot render with MUJOCO_GL=osmesa \(from the environment\): unset"):
        rendering.choose_gl_backend()
    assert "MUJOCO_GL=osmesa (from the environment)" in rendering.choose_gl_backend(is_window=True)
    monkeypatch.setattr(rendering, "_TRY_BACKEND", "pass")
    assert "MUJOCO_GL=osmesa (from the environment)" in rendering.choose_gl_backend()


def test_glfw_without_a_display_is_said_to_be_none(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    with pytest.raises(ValueError, match="MuJoCo cannot render with MUJOCO_GL=glfw"):
        rendering.choose_gl_backend()


def train_without_opengl(env_id, folder, *options):
    """In a subprocess, since a process imports MuJoCo only once."""
    command = [sys.executable, "-m", "sb3_tdc", "train", "--env", env_id, "-f", folder, "-n", 50, "--eval-freq", -1]
    command += ["--verbose", 0, "--device", "cpu", *options]
    environment = {**os.environ, "MUJOCO_GL": "nothing", "PYTHONPATH": str(ROOT)}
    return subprocess.run(list(map(str, command)), env=environment, capture_output=True, text=True)


@pytest.mark.parametrize("options", [[], ["--vec-env", "gymnasium"], ["--vec-env", "subproc"]])
def test_an_opengl_that_cannot_be_imported_is_a_sentence(tmp_path, options):
    ended = train_without_opengl("Hopper-v4", tmp_path, *options)
    assert ended.returncode == 2
    assert "error: MuJoCo cannot be imported with MUJOCO_GL=nothing (from the environment): unset it" in ended.stderr
    assert "Traceback" not in ended.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "vec_env", ["subproc", *(pytest.param(x, marks=pytest.mark.slow) for x in ("dummy", "gymnasium"))]
)
def test_what_is_not_of_mujoco_needs_no_opengl(tmp_path, vec_env):
    assert train_without_opengl("Pendulum-v1", tmp_path, "--vec-env", vec_env).returncode == 0


# ---------------------------------------------------------------- environments of all kinds


class Undrawn(gym.Env):
    """Takes no ``render_mode``."""

    observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self):
        self.steps = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.steps += 1
        return np.zeros(1, np.float32), 1.0, False, self.steps == 10, {}


class Drawn(Undrawn):
    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, render_mode=None):
        super().__init__()
        self.render_mode = render_mode

    def render(self):
        return np.full((32, 32, 3), 10 * self.steps, np.uint8) if self.render_mode == "rgb_array" else None


class NeedsPictures(Drawn):
    """Observes its own pictures, as pixel wrappers do."""

    def reset(self, **kwargs):
        assert self.render_mode == "rgb_array"
        return super().reset(**kwargs)


class Fails(Undrawn):
    def __init__(self):
        if os.environ.get("NO_LICENCE"):
            raise RuntimeError("no licence")
        super().__init__()


class DrawnOrNot(Drawn):
    metadata: ClassVar = {"render_modes": [None, "rgb_array"]}


class Forgets(Drawn):
    def __init__(self, render_mode=None):
        super().__init__()


class DrawsNothing(Drawn):
    def render(self):
        return None


class DrawsBadly(Drawn):
    def render(self):
        raise RuntimeError("no paint")


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A run on each of the environments above, by the name of its class."""
    folder = tmp_path_factory.mktemp("runs")
    found = {}
    for kind in (Undrawn, Drawn, DrawnOrNot, NeedsPictures, Fails, Forgets, DrawsNothing, DrawsBadly):
        gym.register(f"{kind.__name__}-v0", kind)
        kwargs = ["--env-kwargs", "render_mode:rgb_array"] if kind is NeedsPictures else []
        argv = ["--env", f"{kind.__name__}-v0", "-n", "20", "-f", str(folder), "--eval-freq", "-1", *kwargs]
        assert train.main([*argv, "--verbose", "0", "-params", "policy_kwargs:{net_arch: [4]}"]) == 0
        found[kind.__name__] = folder / "tdc" / f"{kind.__name__}-v0_1"
    gym.register("DrawnTogether-v0", vector_entry_point=drawn_together)
    return found


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("Undrawn", "No window: it draws nothing\n"),
        ("Drawn", "There is no display: no window. To see the agent: --record FILE.mp4\n"),
        ("DrawnOrNot", "There is no display: no window. To see the agent: --record FILE.mp4\n"),
        ("NeedsPictures", "No window: it is made with render_mode rgb_array. To see the agent: --record FILE.mp4\n"),
    ],
)
def test_every_environment_can_be_played(runs, name, said, monkeypatch, capsys):
    monkeypatch.setattr(rendering, "display_works", lambda: False)
    assert enjoy.main([str(runs[name]), "--n-episodes", "2"]) == 0
    out = capsys.readouterr().out
    assert said in out
    assert "Return: 10.00 ± 0.00" in out


@pytest.mark.parametrize("name", ["Drawn", "NeedsPictures"])
def test_what_draws_can_be_recorded(runs, name, tmp_path):
    assert enjoy.main([str(runs[name]), "--n-episodes", "1", "--record", str(tmp_path / "video.mp4")]) == 0
    assert (tmp_path / "video.mp4").stat().st_size > 100


def drawn_together(num_envs=1, render_mode=None):
    return gym.vector.SyncVectorEnv([lambda: Drawn(render_mode)] * num_envs, autoreset_mode="SameStep")


@pytest.mark.parametrize(
    ("env_id", "options"),
    [
        ("Drawn-v0", []),
        ("Drawn-v0", ["-params", "normalize:true"]),
        ("Drawn-v0", ["-params", "frame_stack:2"]),
        ("DrawnTogether-v0", ["--vec-env", "gymnasium"]),
    ],
)
def test_a_video_runs_as_fast_as_the_environment(runs, tmp_path, env_id, options):
    argv = ["--env", env_id, "-n", "20", "-f", str(tmp_path), "--eval-freq", "-1", "--verbose", "0", *options]
    assert train.main([*argv, "-params", "policy_kwargs:{net_arch: [4]}"]) == 0
    video = tmp_path / "video.mp4"
    assert enjoy.main([str(tmp_path / "tdc" / f"{env_id}_1"), "--n-episodes", "1", "--record", str(video)]) == 0
    about = imageio.get_reader(video).get_meta_data()
    assert (about["fps"], about["duration"]) == (10, 1)  # 10 steps at render_fps 10


@pytest.mark.parametrize("suffix", rendering.VIDEO_SUFFIXES)
def test_a_format_that_is_offered_can_be_written(tmp_path, suffix):
    path = tmp_path / f"video{suffix}"
    with rendering.VideoWriter(path, fps=10) as video:
        for shade in range(0, 250, 50):
            video.add(np.full((32, 32, 3), shade, np.uint8))
    frames = list(imageio.get_reader(path).iter_data())
    assert len(frames) == 5
    assert frames[4].mean() == pytest.approx(200, abs=5)


@pytest.mark.parametrize("fps", [10, 20, 24, 30, 50, 60, 67, 100, 125, 240, 1000])
def test_a_gif_runs_as_fast_as_the_simulation(tmp_path, fps):
    path, seconds = tmp_path / "video.gif", 2
    with rendering.VideoWriter(path, fps) as video:
        for i in range(fps * seconds):
            video.add(np.full((8, 8, 3), i % 251, np.uint8))
    with Image.open(path) as gif:
        delays = [frame.info["duration"] for frame in ImageSequence.Iterator(gif)]
    assert min(delays) >= 20  # players slow down shorter delays
    assert sum(delays) / 1000 == pytest.approx(seconds, rel=0.11, abs=0.1)


def test_what_does_not_draw_cannot_be_recorded_and_says_so(runs, tmp_path, capsys):
    with pytest.raises(SystemExit):
        enjoy.main([str(runs["Undrawn"]), "--record", str(tmp_path / "video.mp4")])
    assert "Undrawn-v0 cannot be recorded: it draws nothing" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("Forgets", "it draws nothing: its constructor must set self.render_mode\n"),
        ("DrawsNothing", "render() must return an array (height, width, 3) in the mode rgb_array, got None\n"),
        ("DrawsBadly", "render() raised RuntimeError: no paint ("),
    ],
)
def test_a_picture_that_is_none_is_a_sentence(runs, tmp_path, name, sentence, capsys):
    assert enjoy.main([str(runs[name]), "--record", str(tmp_path / "video.mp4")]) == 1
    assert f"error: the environment failed: {sentence}" in capsys.readouterr().err


def test_an_environment_that_cannot_be_made_is_a_sentence(runs, monkeypatch, capsys):
    monkeypatch.setenv("NO_LICENCE", "1")
    with pytest.raises(SystemExit) as exit_:
        enjoy.main([str(runs["Fails"]), "--no-render"])
    assert exit_.value.code == 2
    assert "error: Fails-v0 cannot be made: RuntimeError: no licence (" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        enjoy.main([str(runs["Drawn"]), "--no-render", "--env-kwargs", "gravity:3"])
    assert "error: Drawn-v0 cannot be made: " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("env_id", "modes"),
    [("Hopper-v4", {"human", "rgb_array"}), ("Undrawn-v0", set()), ("Drawn-v0", {"rgb_array"})],
)
def test_modes(runs, env_id, modes):
    assert rendering.render_modes(env_id) & {"human", "rgb_array"} == modes


def test_what_cannot_be_imported_draws_nothing_and_is_named():
    gym.register("NotThere-v0", "no_such_package:Env")
    with pytest.raises(ValueError, match="NotThere-v0 cannot be made: ModuleNotFoundError: No module named 'no_such"):
        rendering.render_modes("NotThere-v0")


def test_a_display_that_is_gone_is_not_used(monkeypatch):
    """As after ``ssh -X`` or in an old tmux: the variable is set, but no server answers."""
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv("DISPLAY", ":987")
    assert not rendering.display_works()
    monkeypatch.setattr(rendering, "_TRY_BACKEND", "import os; raise SystemExit(os.environ['MUJOCO_GL'] != 'osmesa')")
    assert rendering.choose_gl_backend() == "Rendering with MUJOCO_GL=osmesa (no display)"
    assert os.environ.pop("MUJOCO_GL") == "osmesa"
    assert rendering.choose_render_mode("Hopper-v4", {})[0] == {}
