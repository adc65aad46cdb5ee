"""A cooperative advisory board: the best actors of a training so far propose actions, and a critic chooses."""

import math
from collections.abc import Callable, Sequence

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn


class Board(nn.Module):
    """
    Snapshots of an actor, the best first. The state dict holds the whole board.

    :param actors: one for every seat; no seat is taken at first
    """

    returns: th.Tensor
    n_taken: th.Tensor

    def __init__(self, actors: Sequence[BasePolicy]):
        super().__init__()
        self.members = nn.ModuleList(actors)
        self.members.requires_grad_(False)
        self.members.train(False)  # they act and never learn
        self.register_buffer("returns", th.zeros(len(actors), dtype=th.float64))
        self.register_buffer("n_taken", th.zeros((), dtype=th.int64))

    def __len__(self) -> int:
        return int(self.n_taken)

    def propose(self, actor: nn.Module, test_return: float) -> int | None:
        """
        Insert a copy of an actor before the first member with a smaller return; the last of a full board leaves.

        :param actor: the actor whose weights are copied
        :param test_return: its return in a test episode; an actor with a non-finite return is rejected
        :return: the seat of the copy, 0 for the best; None if the actor gets no seat
        """
        test_return = float(test_return)  # VecMonitor's returns are NumPy numbers
        if not math.isfinite(test_return):
            return None
        taken = self.returns[: len(self)].tolist()
        seat = next((i for i, other in enumerate(taken) if test_return > other), len(taken))
        if seat == len(self.members):
            return None
        *others, free = self.members
        free.load_state_dict(actor.state_dict())
        self.members = nn.ModuleList([*others[:seat], free, *others[seat:]]).train(False)
        self.returns[seat + 1 :] = self.returns[seat:-1].clone()
        self.returns[seat] = test_return
        self.n_taken.fill_(min(len(taken) + 1, len(self.members)))
        return seat

    def cooperative_actions(self, obs: PyTorchObs, score: Callable[[PyTorchObs, th.Tensor], th.Tensor]) -> th.Tensor:
        """
        Return, for every observation, the action of the member whose action a critic scores highest.

        :param obs: (B, ...)
        :param score: the critic: maps observations and actions, (B, A), to scores, (B,)
        :return: (B, A)
        :raises ValueError: if the board has no members yet
        """
        if len(self) == 0:
            raise ValueError("The board has no members yet: the first comes with the first test episode")
        advice = [member._predict(obs, deterministic=True) for member in self.members[: len(self)]]  # type: ignore[operator]
        scores = th.stack([score(obs, actions) for actions in advice])  # (members, B)
        actions = th.stack(advice)
        return actions[scores.argmax(dim=0), th.arange(actions.shape[1], device=actions.device)]
