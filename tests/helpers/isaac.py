"""
Stand-ins for Isaac Lab: its modules, a task on tensors whose episodes are reset inside ``step``, its wrapper for SB3.

The wrapper has each of the three interfaces in circulation, which differ in how they treat actions without bounds and
the last observation of an episode.
"""

import sys
import types
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_tdc.envs import isaac

TASK = "Isaac-Reach-Stand-In-v0"
INTERFACES = ("fast_variant", "action_low, action_high", "action_bounds")
LIMIT = 5


class Config:
    """
    The configuration of the task.

    :param has_final_obs: whether this version knows ``compute_final_obs``
    """

    def __init__(self, num_envs, device, has_final_obs):
        self.num_envs, self.device, self.seed = num_envs, device, None
        self.sim = types.SimpleNamespace(dt=0.1)
        if has_final_obs:
            self.compute_final_obs = False


class ReachTask(gym.Env):
    """Points that have to reach 0 in steps of ``dt``; beyond a distance of 3 they have failed."""

    metadata: dict = {"render_modes": [None, "human", "rgb_array"]}  # noqa: RUF012  # as in gymnasium

    def __init__(self, cfg, render_mode=None):
        self.cfg, self.render_mode = cfg, render_mode
        self.num_envs, self.device = cfg.num_envs, cfg.device
        self.single_observation_space = spaces.Dict({"policy": spaces.Box(-np.inf, np.inf, (2,), np.float32)})
        self.single_action_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.observation_space, self.action_space = self.single_observation_space, self.single_action_space
        self.generator = th.Generator().manual_seed(cfg.seed)
        self.largest_action = 0.0

    def seed(self, seed=-1):
        self.generator.manual_seed(seed)
        return seed

    def _draw(self, n):
        return 4 * th.rand((n, 2), generator=self.generator) - 2

    def reset(self, *, seed=None, options=None):
        self.position, self.steps = self._draw(self.num_envs), th.zeros(self.num_envs, dtype=th.int64)
        return {"policy": self.position.clone()}, {}

    def step(self, action):
        self.largest_action = max(self.largest_action, float(action.abs().max()))
        self.position = self.position + self.cfg.sim.dt * action
        self.steps += 1
        distance = self.position.norm(dim=1)
        terminated, truncated = distance > 3, self.steps >= LIMIT
        extras = (
            {"final_obs": {"policy": self.position.clone()}} if getattr(self.cfg, "compute_final_obs", False) else {}
        )
        ended = (terminated | truncated).nonzero().flatten()
        self.position[ended] = self._draw(len(ended))
        self.steps[ended] = 0
        return {"policy": self.position.clone()}, -distance, terminated, truncated, extras

    def render(self):
        return np.zeros((8, 8, 3), np.uint8)


class _Wrapper(VecEnv):
    """The part that all interfaces share."""

    knows_final_obs = True

    def _begin(self, env, action_space):
        self.env = env
        self.num_envs = env.unwrapped.num_envs
        super().__init__(self.num_envs, env.unwrapped.single_observation_space["policy"], action_space)

    @property
    def unwrapped(self):
        return self.env.unwrapped

    def seed(self, seed=None):
        return [self.unwrapped.seed(seed)] * self.num_envs

    def reset(self):
        return self.env.reset()[0]["policy"].numpy()

    def step_async(self, actions):
        self.actions = th.as_tensor(np.asarray(actions), dtype=th.float32)

    def step_wait(self):
        observations, rewards, terminated, truncated, extras = self.env.step(self.actions)
        observations, dones = observations["policy"].numpy(), (terminated | truncated).numpy()
        last = extras["final_obs"]["policy"].numpy() if self.knows_final_obs and "final_obs" in extras else observations
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in dones.nonzero()[0]:
            infos[i] = {
                "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                "terminal_observation": last[i],
            }
        return observations, rewards.numpy(), dones, infos

    def close(self):
        self.env.close()

    def get_attr(self, attr_name, indices=None):
        return [getattr(self.env, attr_name)] * (self.num_envs if indices is None else len(indices))

    def set_attr(self, attr_name, value, indices=None):
        raise NotImplementedError("Setting attributes is not supported.")

    def env_method(self, method_name, *args, indices=None, **kwargs):
        return self.env.render() if method_name == "render" else getattr(self.env, method_name)(*args, **kwargs)

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False]


def _bounded(env, low, high):
    return spaces.Box(low, high, env.unwrapped.single_action_space.shape, np.float32)


class _Oldest(_Wrapper):
    knows_final_obs = False

    def __init__(self, env, fast_variant=True):
        self._begin(env, _bounded(env, -100, 100))


class _Middle(_Wrapper):
    def __init__(self, env, fast_variant=True, action_low=None, action_high=None):
        low, high = (-100, 100) if action_low is None else (action_low, action_high)
        self._begin(env, _bounded(env, low, high))


class _Newest(_Wrapper):
    def __init__(self, env, fast_variant=True, action_bounds=(-1.0, 1.0)):
        self._begin(env, _bounded(env, *action_bounds))


for _wrapper in (_Oldest, _Middle, _Newest):
    _wrapper.__module__ = "isaaclab_rl.sb3"
WRAPPERS = dict(zip(INTERFACES, (_Oldest, _Middle, _Newest), strict=True))


def install(monkeypatch, interface):
    """
    Make a stand-in for a version of Isaac Lab importable; its task is registered when the application is launched.

    :return: for each application that is launched, its keyword arguments and ``sys.argv`` as it saw it
    """
    launched = []
    isaac.start.cache_clear()

    class AppLauncher:
        def __init__(self, launcher_args=None, **kwargs):
            launched.append((kwargs, list(sys.argv)))
            tasks = types.ModuleType("isaaclab_tasks")
            gym.register(TASK, entry_point=ReachTask, disable_env_checker=True, order_enforce=False)
            utils: Any = types.ModuleType("isaaclab_tasks.utils")
            utils.parse_env_cfg = lambda task, device="cuda:0", num_envs=None, use_fabric=None: Config(
                num_envs, device, interface != "fast_variant"
            )
            monkeypatch.setitem(sys.modules, "isaaclab_tasks", tasks)
            monkeypatch.setitem(sys.modules, "isaaclab_tasks.utils", utils)

    modules: dict[str, dict[str, Any]] = {
        "isaaclab": {},
        "isaaclab.app": {"AppLauncher": AppLauncher},
        "isaaclab_rl": {},
        "isaaclab_rl.sb3": {"Sb3VecEnvWrapper": WRAPPERS[interface]},
    }
    for name, contents in modules.items():
        module = types.ModuleType(name)
        vars(module).update(contents)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(gym.registry, TASK, raising=False)
    monkeypatch.setattr("sb3_tdc.envs.isaac._is_installed", lambda: True)
    return launched
