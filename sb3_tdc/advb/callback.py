"""Test episodes that decide which actors are on a board."""

import copy

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_tdc.advb.policies import AdvisedPolicy


class BoardCallback(BaseCallback):
    """
    After every training episode, plays a deterministic test episode of the actor alone, and proposes it to the board.

    Test episodes cost steps that ``num_timesteps`` does not count: they are logged as ``board/test_steps``.

    :param eval_env: one separate environment, wrapped like the training environment; if it normalises, it uses the
        training environment's statistics and does not normalise rewards
    :param verbose: 1 prints every new member
    :raises ValueError: if ``eval_env`` has more than one environment; when training begins, if only one of the two
        is wrapped in ``VecNormalize``
    """

    def __init__(self, eval_env: VecEnv, verbose: int = 0):
        super().__init__(verbose)
        if eval_env.num_envs != 1:
            raise ValueError(f"eval_env must be one environment, got {eval_env.num_envs}")
        self.eval_env = eval_env
        self.test_steps = 0

    def _init_callback(self) -> None:
        training, self._normalization = self.model.get_vec_normalize_env(), unwrap_vec_normalize(self.eval_env)
        if (training is None) != (self._normalization is None):
            where = "eval_env" if training is None else "the training's environment"
            raise ValueError(f"eval_env must be wrapped as the training's environment, but only {where} is normalised")
        if self._normalization is not None:
            self._normalization.training = self._normalization.norm_reward = False

    def _on_step(self) -> bool:
        for _ in range(int(np.sum(self.locals["dones"]))):
            self._test_actor()
        return True

    def _test_actor(self) -> None:
        policy = self.model.policy
        assert isinstance(policy, AdvisedPolicy)
        self._synchronize_normalization()
        with policy.actor_alone():
            returns, lengths = evaluate_policy(
                self.model, self.eval_env, n_eval_episodes=1, return_episode_rewards=True, warn=False
            )
        assert isinstance(returns, list) and isinstance(lengths, list)  # noqa: PT018
        self.test_steps += lengths[0]
        seat = policy.board.propose(policy.actor, returns[0])  # type: ignore[arg-type]
        if self.verbose > 0 and seat is not None:
            print(f"The actor of step {self.num_timesteps:,} takes seat {seat + 1} with a return of {returns[0]:.1f}")
        self.logger.record("board/test_return", returns[0])
        self.logger.record("board/test_steps", self.test_steps)
        self.logger.record("board/members", len(policy.board))
        self.logger.record("board/best_return", float(policy.board.returns[0]))

    def _synchronize_normalization(self) -> None:
        training = self.model.get_vec_normalize_env()
        if training is not None:
            for name in {"obs_rms", "ret_rms"} & vars(training).keys():
                setattr(self._normalization, name, copy.deepcopy(getattr(training, name)))
