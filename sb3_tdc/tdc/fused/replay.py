"""A replay buffer that stores each transition in one contiguous row."""

import sys
from weakref import WeakKeyDictionary, ref

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer

_ARRAYS = ("observations", "actions", "next_observations", "rewards", "dones", "timeouts")
# Methods of SB3's buffer whose work PackedReplay does itself: it does not apply if a user has replaced one of them
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
    ``index_select`` instead of a walk through six arrays.

    The arrays of the buffer become views of the rows, so transitions that are added to, changed in or saved with the
    buffer are those drawn here. On CUDA the rows are copied to the device, and new ones follow when a minibatch is
    drawn. Later changes to rows that have been copied are not seen there.

    :param buffer: a buffer for which :meth:`applies` is true; only a weak reference to it is kept
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
        self.steps: int | None = None  # the count of steps when rows were last copied to the device

    @classmethod
    def of(cls, buffer: ReplayBuffer) -> "PackedReplay | None":
        """Return the rows of a buffer, shared by all models that use it, or None if it cannot be packed."""
        packed = _PACKED.get(buffer)
        if packed is None or not packed.holds(buffer):
            if not cls.applies(buffer):
                return None
            packed = _PACKED[buffer] = cls(buffer)
        return packed

    @staticmethod
    def applies(buffer: ReplayBuffer) -> bool:
        """
        Return whether a buffer can be packed.

        Its ``sample`` must be SB3's, and its observations flat. Observations and actions must be floats. The arrays
        must be used by nothing else: not be in a file or in shared memory, nor be views of other arrays.
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
        """Return whether these are the rows of the buffer, its ``sample`` is SB3's, and its arrays are still views."""
        return (
            self.buffer_ref() is buffer
            and all(getattr(buffer, name).base is self.slots for name in _ARRAYS)
            and _samples_plainly(buffer)
        )

    def draw(self, buffer: ReplayBuffer, n: int, steps: int) -> np.ndarray:
        """
        Draw the indices of the transitions that ``buffer.sample`` would draw, from the same random numbers.

        :param buffer: the buffer of these rows
        :param n: number of transitions
        :param steps: count of vectorised steps: one for a step of all environments
        :return: (n,), indices of ``rows``
        """
        if self.rows is not self.host_rows:
            self._copy_new_rows(buffer, steps)
        indices = np.random.randint(0, buffer.buffer_size if buffer.full else buffer.pos, size=n)
        if buffer.n_envs > 1:  # with one environment, SB3's draw uses no random number
            indices = indices * buffer.n_envs + np.random.randint(0, high=buffer.n_envs, size=(n,))
        return indices

    def _copy_new_rows(self, buffer: ReplayBuffer, steps: int) -> None:
        """Copy to the device the rows that have been written since the last copy."""
        size = buffer.buffer_size
        if self.steps is None or steps - self.steps != (buffer.pos - self.pos) % size:  # or a full round since
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
    """Move an array of the buffer into this part of the rows."""
    array = getattr(buffer, name)
    part = part if array.ndim == part.ndim else part[..., 0]
    filled = slice(0, buffer.size())
    part[filled] = array[filled]
    setattr(buffer, name, part)


# Weak keys: a buffer's rows are released with the buffer
_PACKED: "WeakKeyDictionary[ReplayBuffer, PackedReplay]" = WeakKeyDictionary()


def _samples_plainly(buffer: ReplayBuffer) -> bool:
    own = all(getattr(ReplayBuffer, name) is method for name, method in _METHODS.items())
    return own and _METHODS.keys().isdisjoint(vars(buffer))


def _is_private(buffer: ReplayBuffer, name: str) -> bool:
    """Return whether an array of the buffer owns its memory, and nothing else refers to the array."""
    array = vars(buffer)[name]
    # The memory of an unpickled array may be a bytes object, which nothing else can write to
    owns_memory = type(array) is np.ndarray and (array.base is None or isinstance(array.base, bytes))
    del array
    alone = {name: np.empty(0)}
    return owns_memory and sys.getrefcount(vars(buffer)[name]) <= sys.getrefcount(alone[name])
