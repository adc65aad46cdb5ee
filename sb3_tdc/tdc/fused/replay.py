"""A replay buffer whose transitions lie in one place each."""

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples

_ARRAYS = ("observations", "actions", "next_observations", "rewards", "dones", "timeouts")


class PackedReplay:
    """
    The transitions of a ``ReplayBuffer`` as float32 rows [s | a | s' | r | d | t], so that a minibatch is one
    ``index_select``, not a walk through six arrays.

    The arrays of the buffer become views of the rows: what anyone adds, changes or saves there is what is drawn here.
    On CUDA the rows are copied to the device; those that the buffer has got since, when a minibatch is drawn. There,
    what is changed in the buffer afterwards is not seen.

    :param buffer: for which :meth:`applies`
    :param batch_size: B
    """

    def __init__(self, buffer: ReplayBuffer, batch_size: int):
        self.buffer = buffer
        obs_dim, action_dim = buffer.observations.shape[-1], buffer.action_dim
        widths = [obs_dim, action_dim, obs_dim, 1, 1, 1]
        slots = np.zeros((buffer.buffer_size, buffer.n_envs, sum(widths)), dtype=np.float32)
        columns = np.split(slots, np.cumsum(widths)[:-1], axis=-1)
        self.arrays = {name: self._move(name, part) for name, part in zip(_ARRAYS, columns, strict=True)}
        self.host_rows = th.from_numpy(slots.reshape(-1, sum(widths)))
        self.rows = self.host_rows.to(buffer.device)
        self.batch = self.rows.new_empty(batch_size, sum(widths))
        self.columns = self.batch.split(widths, dim=1)
        self.pos = 0
        self.steps: int | None = None  # when the rows were copied last

    def _move(self, name: str, part: np.ndarray) -> np.ndarray:
        """Let an array of the buffer be this part of the rows."""
        array = getattr(self.buffer, name)
        part = part if array.ndim == part.ndim else part[..., 0]
        filled = slice(0, self.buffer.size())
        part[filled] = array[filled]
        setattr(self.buffer, name, part)
        return part

    @staticmethod
    def applies(buffer: ReplayBuffer) -> bool:
        """:return: whether ``sample`` of this buffer is SB3's plain one, of flat observations of real numbers"""
        return (
            type(buffer) is ReplayBuffer
            and not buffer.optimize_memory_usage
            and buffer.observations.ndim == 3
            and buffer.observations.dtype.kind == buffer.actions.dtype.kind == "f"
        )

    def holds(self, buffer: ReplayBuffer) -> bool:
        """:return: whether this is the buffer, and its arrays are still parts of the rows"""
        return self.buffer is buffer and all(getattr(buffer, name) is array for name, array in self.arrays.items())

    def sample(self, steps: int) -> ReplayBufferSamples:
        """
        :param steps: count of steps of the environments, one for all of them
        :return: what ``buffer.sample`` would, from the same random numbers; overwritten by the next call
        """
        buffer = self.buffer
        if self.rows is not self.host_rows:
            self._copy_new_rows(steps)
        slots = np.random.randint(0, buffer.size(), size=len(self.batch))
        envs = np.random.randint(0, high=buffer.n_envs, size=(len(self.batch),))
        indices = th.from_numpy(slots * buffer.n_envs + envs)
        th.index_select(self.rows, 0, indices.to(self.rows.device, non_blocking=True), out=self.batch)
        observations, actions, next_observations, rewards, dones, timeouts = self.columns
        terminated = dones.addcmul_(dones, timeouts, value=-1)
        return ReplayBufferSamples(observations, actions, next_observations, terminated, rewards)

    def _copy_new_rows(self, steps: int) -> None:
        """To the device."""
        buffer, size = self.buffer, self.buffer.buffer_size
        if self.steps is None or steps - self.steps != (buffer.pos - self.pos) % size:  # or more than it holds
            self._copy_rows(0, buffer.size())
        elif buffer.pos < self.pos:
            self._copy_rows(self.pos, size)
            self._copy_rows(0, buffer.pos)
        else:
            self._copy_rows(self.pos, buffer.pos)
        self.pos, self.steps = buffer.pos, steps

    def _copy_rows(self, start: int, stop: int) -> None:
        rows = slice(start * self.buffer.n_envs, stop * self.buffer.n_envs)
        self.rows[rows] = self.host_rows[rows].to(self.rows.device)
