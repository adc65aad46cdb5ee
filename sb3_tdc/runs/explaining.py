"""Explanation of a trained model: the returns that its critics predict, compared with those that follow."""

from pathlib import Path
from typing import Any

import gymnasium as gym
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_tdc.critics.episodes import record_episodes
from sb3_tdc.critics.figures import write_explanation
from sb3_tdc.critics.returns import steps_until_negligible
from sb3_tdc.runs.trained import TrainedModel
from sb3_tdc.tdc import TDC


def extend_time_limit(trained: TrainedModel, env_kwargs: dict[str, Any]) -> tuple[int | None, dict[str, Any]]:
    """
    Extend the time limit of episodes until the discount has faded: critics predict returns as if there were no limit.

    :return: the original time limit (None for none), and the environment's arguments with the extended one
    """
    own = gym.spec(trained.env_id).max_episode_steps
    limit = {**trained.hyperparams.env_kwargs, **env_kwargs}.get("max_episode_steps", own)
    gamma = trained.hyperparams.model.get("gamma", 0.99)
    if limit is None or gamma >= 1:
        return limit, env_kwargs
    return limit, {**env_kwargs, "max_episode_steps": limit + steps_until_negligible(gamma)}


def explain(model: TDC, env: VecEnv, trained: TrainedModel, n_episodes: int, limit: int | None) -> None:
    """Play episodes, and write a figure of the critics' predictions into the folder of the model."""
    normalization = unwrap_vec_normalize(env)
    if normalization is not None:  # the critics predict returns of training's rewards
        normalization.norm_reward = (trained.hyperparams.normalize or {}).get("norm_reward", True)
    episodes = record_episodes(model, env, n_episodes, limit)
    unit = "normalised rewards, " if normalization is not None and normalization.norm_reward else ""
    title = (
        f"{type(model).__name__} on {trained.env_id}, {model.num_timesteps:,} steps of training ({trained.path.name}), "
        f"{unit}λ = {model.scheduled('lam'):g}, γ = {model.gamma:g}"
    )
    write_explanation(model, episodes, explanation_path(trained), title)


def explanation_path(trained: TrainedModel) -> Path:
    """Return the path of the files that :func:`explain` writes, without their suffixes."""
    return trained.path.with_name(f"{trained.path.stem}_critics")
