"""Rendering with and without a display: MuJoCo's OpenGL backend, the render mode, and video files."""

import inspect
import itertools
import os
import subprocess
import sys
from pathlib import Path
from types import TracebackType
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import load_env_creator
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_tdc.common.exceptions import describe_exception
from sb3_tdc.envs.checked import EnvironmentFaultError
from sb3_tdc.envs.registry import is_of_mujoco

VIDEO_SUFFIXES = (".mp4", ".gif", ".mkv", ".mov", ".avi")
_GL_BACKENDS = ("egl", "osmesa")
_TRY_DISPLAY = "import sys, glfw; sys.exit(not glfw.init())"
# GLFW creates a context even without a display; only MjrContext, which is for drawing, then fails
_TRY_BACKEND = """
import mujoco
context = mujoco.GLContext(16, 16)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), mujoco.mjtFontScale.mjFONTSCALE_100)
context.free()
"""


def render_modes(env_id: str) -> set[str]:
    """
    Return the render modes of an environment: none if its constructor takes no ``render_mode``.

    :raises ValueError: if its entry point cannot be imported
    """
    spec = gym.spec(env_id)
    entry_point: Any = spec.entry_point or spec.vector_entry_point
    try:
        creator = load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point
    except Exception as error:
        raise ValueError(f"{env_id} cannot be made: {describe_exception(error)}") from error
    parameters = inspect.signature(creator).parameters.values()
    if not any(each.name == "render_mode" or each.kind is each.VAR_KEYWORD for each in parameters):
        return set()
    metadata = getattr(creator, "metadata", None) or {}  # a function has no metadata: assume both modes
    return set(metadata.get("render_modes", ("human", "rgb_array"))) - {None}  # Isaac Lab lists None, too


def display_works() -> bool:
    """Return whether a window can be opened: ``DISPLAY`` may name a display that is gone (ssh -X, tmux)."""
    if sys.platform in ("darwin", "win32"):
        return True
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return False
    attempt = subprocess.run([sys.executable, "-c", _TRY_DISPLAY], capture_output=True)
    return attempt.returncode == 0


def choose_gl_backend(is_window: bool = False) -> str:
    """
    Set ``MUJOCO_GL`` to a backend that works without a display, unless it is set already or there is a display.

    Must be called before ``mujoco`` is imported, which reads the variable.

    :param is_window: whether a window is wanted; there must be a display
    :return: a sentence that names the backend
    :raises ValueError: if the given backend does not work; if none works, with the command that installs one
    """
    if named := os.environ.get("MUJOCO_GL"):
        if not is_window and not _backend_works(named):
            raise ValueError(
                f"MuJoCo cannot render with MUJOCO_GL={named} (from the environment): unset it, and what works is found"
            )
        return f"Rendering with MUJOCO_GL={named} (from the environment)"
    if is_window or display_works():
        return "Rendering with the display's OpenGL"
    for backend in _GL_BACKENDS:
        if _backend_works(backend):
            os.environ["MUJOCO_GL"] = backend
            return f"Rendering with MUJOCO_GL={backend} (no display)"
    raise ValueError(
        "MuJoCo cannot render: there is no display, and neither EGL nor OSMesa works. "
        "On Debian or Ubuntu: apt-get install libegl1 libegl-mesa0 (or libosmesa6)"
    )


def _backend_works(backend: str) -> bool:
    environment = {**os.environ, "MUJOCO_GL": backend}
    attempt = subprocess.run([sys.executable, "-c", _TRY_BACKEND], env=environment, capture_output=True)
    return attempt.returncode == 0


def follow_agent(env: gym.Env) -> None:
    """Make MuJoCo's camera follow the agent, unless the environment was given a camera (-v4 tasks lose the agent)."""
    renderer = getattr(env.unwrapped, "mujoco_renderer", None)
    if renderer is None or renderer.camera_id not in (None, -1):
        return
    import mujoco

    # Frames use a camera of the model; a window uses the camera that the configuration describes
    renderer.camera_id = mujoco.mj_name2id(renderer.model, mujoco.mjtObj.mjOBJ_CAMERA, "track")
    torso = mujoco.mj_name2id(renderer.model, mujoco.mjtObj.mjOBJ_BODY, "torso")
    if torso != -1:
        tracking = {"type": int(mujoco.mjtCamera.mjCAMERA_TRACKING), "trackbodyid": torso}
        renderer.default_cam_config = {**tracking, **(renderer.default_cam_config or {})}


def choose_render_mode(
    env_id: str, env_kwargs: dict[str, Any], record: bool = False, window: bool = True
) -> tuple[dict[str, Any], list[str]]:
    """
    Choose the render mode of an environment, and MuJoCo's OpenGL backend before MuJoCo is imported.

    :param env_kwargs: the environment's other keyword arguments; a ``render_mode`` among them is not changed
    :param record: whether frames for a video are wanted
    :param window: whether a window is wanted if no video is
    :return: the ``render_mode`` to add to the keyword arguments, if any; sentences for the user on what is drawn
    :raises ValueError: if the environment cannot be recorded
    """
    needed, modes = env_kwargs.get("render_mode"), render_modes(env_id)
    wanted = "rgb_array" if record else "human" if window else None
    said = []
    why = f"it is made with render_mode {needed}"
    possible = {needed} if needed is not None else modes | ({"human"} if "rgb_array" in modes else set())
    if needed is None:
        why = f"it draws {', '.join(sorted(modes)) or 'nothing'}"
    if wanted == "rgb_array" and wanted not in possible:
        raise ValueError(f"{env_id} cannot be recorded: {why}")
    if wanted == "human" and wanted not in possible:
        said.append(f"No window: {why}" + (". To see the agent: --record FILE.mp4" if "rgb_array" in possible else ""))
        wanted = None
    if wanted == "human" and not display_works():
        said.append("There is no display: no window. To see the agent: --record FILE.mp4")
        wanted = None
    drawn = needed or wanted
    if drawn is not None and is_of_mujoco(env_id):
        said.append(choose_gl_backend(drawn == "human"))
    return {} if needed is not None or drawn is None else {"render_mode": drawn}, said


class VideoWriter:
    """
    A context that writes frames to a video file.

    :param path: the file; its ending chooses the format (.mp4, .gif, ...)
    :param fps: frames per second
    :raises ImportError: if imageio or its ffmpeg is missing, with the command that installs them
    """

    def __init__(self, path: Path, fps: float):
        try:
            import imageio.v2 as imageio
            import imageio_ffmpeg  # noqa: F401
        except ImportError as error:
            raise ImportError('Recording needs imageio and ffmpeg: pip install "sb3-tdc[video]"') from error
        self.every = 1
        timing: Any = {"fps": fps}
        if path.suffix.lower() == ".gif":
            self.every, delay = _timing_of_gif(fps)
            timing = {"duration": 10 * delay}  # milliseconds
        self.writer: Any = imageio.get_writer(path, **timing)
        self.n_frames = 0

    def add(self, frame: np.ndarray) -> None:
        """
        Write a frame; a GIF leaves some out if there are too many per second for the format.

        :param frame: (height, width, 3), uint8
        """
        if self.n_frames % self.every == 0:
            self.writer.append_data(frame)
        self.n_frames += 1

    def __enter__(self) -> "VideoWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.writer.close()


class Filmed(VecEnvWrapper):
    """
    A wrapper that writes a frame to a video before every step.

    :param venv: one environment, made with ``render_mode="rgb_array"``
    :raises EnvironmentFaultError: if the environment does not know its ``render_mode``
    """

    def __init__(self, venv: VecEnv, video: VideoWriter):
        if venv.render_mode is None:
            raise EnvironmentFaultError("it draws nothing: its constructor must set self.render_mode")
        super().__init__(venv)
        self.video = video

    def reset(self) -> VecEnvObs:
        return self.venv.reset()

    def step_async(self, actions: np.ndarray) -> None:
        frame = self.venv.render()
        assert frame is not None
        self.video.add(frame)
        self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        return self.venv.step_wait()


def _timing_of_gif(fps: float) -> tuple[int, int]:
    """
    Return the n of "every n-th frame" and a frame's duration in hundredths of a second, to match the simulated time.

    A GIF stores durations in hundredths of a second, and players slow down frames of less than two hundredths.
    """
    delays = (100 * every / fps for every in itertools.count(1))
    every, delay = next((n, d) for n, d in enumerate(delays, 1) if d >= 2 and abs(round(d) - d) <= 0.1 * d)
    return every, round(delay)
