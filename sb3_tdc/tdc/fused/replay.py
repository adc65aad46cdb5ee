"""A replay buffer whose transitions lie in one place each."""

import sys
from weakref import WeakKeyDictionary, ref

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer

_ARRAYS = ("observations", "actions", "next_observations", "rewards", "dones", "timeouts")
# The methods of SB3 whose work this does: if a user has replaced them, it does not apply
_METHODS = {
    name: getattr(ReplayBuffer, name)
    for name in ("sample", "_get_samples", "_normalize_obs", "_normalize_reward", "to_torch")
}


def row_widths(obs_dim: int, action_dim: int) -> list[int]:
    """Return how many columns of a row belong to s, a, s', r, d, t."""
    return [obs_dim, action_dim, obs_dim, 1, 1, 1]


class PackedReplay:
    """
    The transitions of a ``ReplayBuffer`` as float32 rows [s | a | s' | r | d | t], so that a minibatch is one
    ``index_select``, not a walk through six arrays.

    The arrays of the buffer become views of the rows: what is added, changed or saved there is what is drawn here.
    On CUDA the rows are copied to the device; those that the buffer has got since, when a minibatch is drawn. There,
    what is changed in the buffer afterwards is not seen.

    :param buffer: for which :meth:`applies`; it is not kept alive
    """

    def __init__(self, buffer: ReplayBuffer):
        self.buffer_ref = ref(buffer)
        widths = row_widths(buffer.observations.shape[-1], buffer.action_dim)
        self.slots = np.zeros((buffer.buffer_size, buffer.n_envs, sum(widths)), dtype=np.float32)
        columns = np.split(self.slots, np.cumsum(widths)[:-1], axis=-1)
        for name, part in zip(_ARRAYS, columns, strict=True):
            _move(buffer, name, part)
        self.host_rows = th.from_numpy(self.slots.reshape(-1, sum(widths)))
        self.rows = self.host_rows.to(buffer.device)
        self.pos = 0
        self.steps: int | None = None  # when the rows were copied last

    @classmethod
    def of(cls, buffer: ReplayBuffer) -> "PackedReplay | None":
        """Return the rows of a buffer, made once for all models that share it, or None where there can be none."""
        packed = _PACKED.get(buffer)
        if packed is None or not packed.holds(buffer):
            if not cls.applies(buffer):
                return None
            packed = _PACKED[buffer] = cls(buffer)
        return packed

    @staticmethod
    def applies(buffer: ReplayBuffer) -> bool:
        """
        Return whether ``sample`` of this buffer is SB3's plain one, of flat observations of real numbers in arrays that
        nobody else writes to or keeps: not in a file, in shared memory, or parts of other arrays.
        """
        return (
            type(buffer) is ReplayBuffer
            and _samples_plainly(buffer)
            and not buffer.optimize_memory_usage
            and buffer.observations.ndim == 3
            and buffer.observations.dtype.kind == buffer.actions.dtype.kind == "f"
            and all(_is_private(buffer, name) for name in _ARRAYS)
        )

    def holds(self, buffer: ReplayBuffer) -> bool:
        """Return whether this is the buffer, SB3 still samples it, and its arrays are still parts of the rows."""
        return (
            self.buffer_ref() is buffer
            and all(getattr(buffer, name).base is self.slots for name in _ARRAYS)
            and _samples_plainly(buffer)
        )

    def draw(self, buffer: ReplayBuffer, n: int, steps: int) -> np.ndarray:
        """
        Draw the rows of the minibatch that ``buffer.sample`` would draw, from the same random numbers.

        :param buffer: which these rows hold
        :param n: how many
        :param steps: count of steps of the environments, one for all of them
        :return: (n,), indices of ``rows``
        """
        if self.rows is not self.host_rows:
            self._copy_new_rows(buffer, steps)
        indices = np.random.randint(0, buffer.buffer_size if buffer.full else buffer.pos, size=n)
        if buffer.n_envs > 1:  # of one, SB3 draws nothing
            indices = indices * buffer.n_envs + np.random.randint(0, high=buffer.n_envs, size=(n,))
        return indices

    def _copy_new_rows(self, buffer: ReplayBuffer, steps: int) -> None:
        """Copy the rows to the device that have been written since the last copy."""
        size = buffer.buffer_size
        if self.steps is None or steps - self.steps != (buffer.pos - self.pos) % size:  # or more than it holds
            self._copy_rows(0, buffer.size(), buffer.n_envs)
        elif buffer.pos < self.pos:
            self._copy_rows(self.pos, size, buffer.n_envs)
            self._copy_rows(0, buffer.pos, buffer.n_envs)
        else:
            self._copy_rows(self.pos, buffer.pos, buffer.n_envs)
        self.pos, self.steps = buffer.pos, steps

    def _copy_rows(self, start: int, stop: int, n_envs: int) -> None:
        rows = slice(start * n_envs, stop * n_envs)
        self.rows[rows] = self.host_rows[rows].to(self.rows.device)


def _move(buffer: ReplayBuffer, name: str, part: np.ndarray) -> None:
    """Let an array of the buffer be this part of the rows."""
    array = getattr(buffer, name)
    part = part if array.ndim == part.ndim else part[..., 0]
    filled = slice(0, buffer.size())
    part[filled] = array[filled]
    setattr(buffer, name, part)


# Weak keys: a buffer's rows end with it
_PACKED: "WeakKeyDictionary[ReplayBuffer, PackedReplay]" = WeakKeyDictionary()


def _samples_plainly(buffer: ReplayBuffer) -> bool:
    own = all(getattr(ReplayBuffer, name) is method for name, method in _METHODS.items())
    return own and _METHODS.keys().isdisjoint(vars(buffer))


def _is_private(buffer: ReplayBuffer, name: str) -> bool:
    """Return whether an array of the buffer has memory of its own, and nothing else refers to it."""
    array = vars(buffer)[name]
    # An array that was unpickled may lie in bytes, which nobody can write to
    owns_memory = type(array) is np.ndarray and (array.base is None or isinstance(array.base, bytes))
    del array
    alone = {name: np.empty(0)}
    return owns_memory and sys.getrefcount(vars(buffer)[name]) <= sys.getrefcount(alone[name])
