"""Pictures without a display."""

import gymnasium as gym
import pytest

from sb3_tdc import rendering


@pytest.mark.parametrize("env_id", ["HalfCheetah-v4", "Hopper-v4", "Walker2d-v4", "Ant-v4", "Humanoid-v4"])
def test_the_camera_follows_the_agent(env_id):
    env = gym.make(env_id, render_mode="rgb_array")
    rendering.follow_agent(env)
    renderer = env.unwrapped.mujoco_renderer
    assert renderer.model.camera(renderer.camera_id).name == "track"  # frames
    assert renderer.model.body(renderer.default_cam_config["trackbodyid"]).name != "world"  # a window


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
    assert "MUJOCO_GL=osmesa (from the environment)" in rendering.choose_gl_backend()
