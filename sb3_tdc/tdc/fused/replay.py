"""A replay buffer's transitions in one place."""

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples


class PackedReplay:
    """
    The transitions of a ``ReplayBuffer`` as float32 rows [s | a | s' | r | d] on the device, so that a minibatch is one
    ``index_select`` there. Rows that the buffer has got since are copied when a minibatch is drawn; what is changed in
    the buffer afterwards is not seen.

    :param buffer: for which :meth:`applies`
    :param batch_size: B
    """

    def __init__(self, buffer: ReplayBuffer, batch_size: int):
        self.buffer = buffer
        obs_dim, action_dim = buffer.observations.shape[-1], buffer.action_dim
        self.widths = [obs_dim, action_dim, obs_dim, 1, 1]
        device = buffer.device
        self.rows = th.empty(buffer.buffer_size * buffer.n_envs, sum(self.widths), device=device)
        self.batch = th.empty(batch_size, sum(self.widths), device=device)
        self.indices = th.empty(batch_size, dtype=th.long, device=device)
        observations, actions, next_observations, rewards, dones = self.batch.split(self.widths, dim=1)
        self.samples = ReplayBufferSamples(observations, actions, next_observations, dones, rewards)
        self.pos = 0
        self.steps: int | None = None  # when the rows were copied last

    @staticmethod
    def applies(buffer: ReplayBuffer) -> bool:
        """:return: whether ``sample`` of this buffer is SB3's plain one, of flat observations"""
        return type(buffer) is ReplayBuffer and not buffer.optimize_memory_usage and buffer.observations.ndim == 3

    def sample(self, steps: int) -> ReplayBufferSamples:
        """
        :param steps: count of steps of the environments, one for all of them
        :return: what ``buffer.sample`` would, from the same random numbers; overwritten by the next call
        """
        buffer = self.buffer
        self._copy_new_rows(steps)
        stop = buffer.buffer_size if buffer.full else buffer.pos
        slots = np.random.randint(0, stop, size=len(self.batch))
        envs = np.random.randint(0, high=buffer.n_envs, size=(len(self.batch),))
        self.indices.copy_(th.from_numpy(slots * buffer.n_envs + envs), non_blocking=True)
        th.index_select(self.rows, 0, self.indices, out=self.batch)
        return self.samples

    def _copy_new_rows(self, steps: int) -> None:
        buffer = self.buffer
        size = buffer.buffer_size
        if self.steps is None or steps - self.steps != (buffer.pos - self.pos) % size:  # or more than it holds
            self._copy_rows(slice(0, size if buffer.full else buffer.pos))
        elif buffer.pos < self.pos:
            self._copy_rows(slice(self.pos, size))
            self._copy_rows(slice(0, buffer.pos))
        else:
            self._copy_rows(slice(self.pos, buffer.pos))
        self.pos, self.steps = buffer.pos, steps

    def _copy_rows(self, slots: slice) -> None:
        buffer = self.buffer
        dones = buffer.dones[slots] * (1 - buffer.timeouts[slots])
        columns = (
            buffer.observations[slots],
            buffer.actions[slots],
            buffer.next_observations[slots],
            buffer.rewards[slots][..., None],
            dones[..., None],
        )
        packed = np.concatenate(columns, axis=-1, dtype=np.float32, casting="same_kind")
        rows = slice(slots.start * buffer.n_envs, slots.stop * buffer.n_envs)
        self.rows[rows] = th.from_numpy(packed.reshape(-1, packed.shape[-1])).to(self.rows.device)
