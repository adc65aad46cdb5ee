"""
Storage of the replay buffer's rings in segments: every state writes the transitions added since the last state.

A segment holds consecutive slots of the rings. Reading all segments in the order in which they were written fills the
rings. A segment whose slots have all been overwritten since is no longer needed. Observations keep the buffer's dtype.
A next observation that equals the observation of the following slot, bit for bit, is not stored twice.
"""

import ast
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_tdc.resume.kinds.table import KINDS
from sb3_tdc.resume.walk import MISSING, Capture, Initial, Restore

# A slot of these is written once, when a transition is added. All other attributes of a buffer are captured whole
_RINGS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
_INFOS = "infos"  # HER's info dicts, which hold objects
_INFOS_PATH = f"replay_buffer.{_INFOS}"
# A slot's next observation may be the following slot's observation
_NEXT, _CURRENT = "next_observations", "observations"


@dataclass(frozen=True)
class Segment:
    """
    Consecutive slots of the replay buffer that are stored in one file.

    :param name: name of the file
    :param first: the first slot
    :param length: number of slots, at least 1 and at most the size of the ring
    """

    name: str
    first: int
    length: int


def rings(buffer: ReplayBuffer) -> dict[str, np.ndarray]:
    """Return the rings (slots, environments, ...) by name; those of ``Dict`` observations by ``name/key``."""
    found = {}
    for name in _RINGS:
        value = vars(buffer).get(name)
        parts = value.items() if isinstance(value, dict) else [("", value)]
        found.update({f"{name}/{key}" if key else name: part for key, part in parts if isinstance(part, np.ndarray)})
    return found


def other_attributes(buffer: ReplayBuffer) -> dict[str, Any]:
    """Return the attributes that are not in the segments, without the environment and the device."""
    return {name: value for name, value in vars(buffer).items() if name not in (*_RINGS, _INFOS, "env", "device")}


def new_segment(buffer: ReplayBuffer, name: str, first: int | None, added: int) -> Segment | None:
    """
    Return the slots that have been written since the last segment.

    :param first: the buffer's position at the end of the last segment; None if there is no segment
    :param added: number of slots written since then, according to the timesteps
    :return: the segment to write; all filled slots if there is no last segment or if the buffer's position contradicts
        ``added``; None if there are no slots to write
    """
    size = buffer.buffer_size
    if first is None or not 0 <= added <= size or (first + added) % size != buffer.pos:
        added = buffer.size()
    return Segment(name, (buffer.pos - added) % size, added) if added else None


def needed(segments: list[Segment], size: int) -> list[Segment]:
    """Return the segments whose slots have not all been overwritten by later segments."""
    kept: list[Segment] = []
    written = np.zeros(size, dtype=bool)
    for segment in reversed(segments):
        slots = np.arange(segment.first, segment.first + segment.length) % size
        if not written[slots].all():
            kept.insert(0, segment)
            written[slots] = True
    return kept


def find_non_finite(buffer: ReplayBuffer, segment: Segment) -> list[str]:
    """Return the names of the rings that hold a NaN or an infinite number among the slots of a segment."""
    slots = _slots(buffer, segment)
    floats = {name: ring for name, ring in rings(buffer).items() if ring.dtype.kind == "f"}
    return [f"replay_buffer.{name}" for name, ring in floats.items() if not np.isfinite(_take(ring, slots)).all()]


def capture_infos(buffer: ReplayBuffer, segment: Segment) -> tuple[np.ndarray, list[str]]:
    """
    Capture the info dicts that HER stores (``copy_info_dict``).

    Only values that can be restored from their content alone are captured, since no infos exist when a run is resumed.

    :return: JSON text and its arrays in one array of bytes; and a sentence for each value that is left out
    """
    slots, infos = _slots(buffer, segment), vars(buffer).get(_INFOS)
    if infos is None or not any(info for row in infos[slots] for info in row):
        return np.zeros(0, dtype=np.uint8), []
    rows: list[list[dict[Any, Any]]] = [list(row) for row in infos[slots]]
    left_out: list[str] = []
    context = _capture()
    content = context.capture_optional(rows, _INFOS_PATH)
    if content is MISSING:
        rows = [[_what_comes_back(info, left_out) for info in row] for row in rows]
        context = _capture()
        content = context.capture(rows, _INFOS_PATH)
    arrays = [[_text_of(array.dtype), list(array.shape), array.tobytes().hex()] for array in context.arrays]
    return np.frombuffer(json.dumps([content, arrays]).encode(), dtype=np.uint8), left_out


def _what_comes_back(info: dict[Any, Any], left_out: list[str]) -> dict[Any, Any]:
    kept = {}
    for key, value in info.items():
        context = _capture()
        if context.capture_optional([[{key: value}]], _INFOS_PATH) is MISSING:  # nested as deep as in the segment
            left_out += [why.replace("[0][0]", "", 1) for why in context.left_out]
        else:
            kept[key] = value
    return kept


def _capture() -> Capture:
    """Return a capture without initial objects, since the ring is empty when a run is resumed."""
    return Capture(KINDS, initial=Initial({}, {}, {}))


def write_segment(buffer: ReplayBuffer, segment: Segment, infos: np.ndarray) -> Callable[[Path], None]:
    """
    Return a function that writes the file of a segment.

    :param infos: the array of bytes from :func:`capture_infos`
    """

    def write(path: Path) -> None:
        slots = _slots(buffer, segment)
        arrays = {name: _take(ring, slots) for name, ring in rings(buffer).items()}
        for name in [name for name in arrays if name.startswith(_NEXT)]:
            current, following = arrays[name.replace(_NEXT, _CURRENT)], arrays.pop(name)
            differs = np.ones(following.shape[:2], dtype=bool)
            differs[:-1] = ~_same_bits(following[:-1], current[1:])
            arrays |= {f"{name}:differs": differs, name: following[differs]}
        with path.open("wb") as file:
            np.savez(file, infos=infos, **arrays)  # type: ignore[arg-type]

    return write


def read_segments(buffer: ReplayBuffer, files: Iterator[tuple[Segment, Path]]) -> None:
    """Fill the rings from the files of their segments; the slots of each segment are overwritten."""
    targets = rings(buffer)
    for segment, path in files:
        slots = _slots(buffer, segment)
        with np.load(path, allow_pickle=False) as stored:
            for name, ring in targets.items():
                values = stored[name]
                if f"{name}:differs" in stored:
                    differs, different = stored[f"{name}:differs"], values
                    values = np.roll(stored[name.replace(_NEXT, _CURRENT)], -1, axis=0)
                    values[differs] = different
                ring[slots] = values
            _restore_infos(buffer, slots, stored["infos"])


def _slots(buffer: ReplayBuffer, segment: Segment) -> np.ndarray:
    # With optimize_memory_usage, the slot after the last transition holds its next observation
    length = min(segment.length + int(buffer.optimize_memory_usage), buffer.buffer_size)
    return np.arange(segment.first, segment.first + length) % buffer.buffer_size


def _take(ring: np.ndarray, slots: np.ndarray) -> np.ndarray:
    """Return the slots of a ring, as a view if they do not wrap around its end."""
    return ring[slots[0] : slots[-1] + 1] if slots[0] <= slots[-1] else ring[slots]


def _same_bits(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return whether all bits of two rows are equal (−0 and 0 differ, NaN equals itself): (slots, environments)."""
    if a.size == 0:
        return np.zeros(a.shape[:2], dtype=bool)
    words = (x.view(f"u{x.itemsize}").reshape(*x.shape[:2], -1) for x in (a, b))
    return np.equal(*words).all(axis=-1)


def _restore_infos(buffer: ReplayBuffer, slots: np.ndarray, stored: np.ndarray) -> None:
    infos = vars(buffer).get(_INFOS)
    if infos is None or stored.size == 0:
        return
    content, arrays = json.loads(stored.tobytes())
    decoded = [np.frombuffer(bytes.fromhex(b), dtype=_dtype(text)).reshape(shape) for text, shape, b in arrays]
    context = Restore(KINDS, decoded)
    for slot, row in zip(slots, context.restore(content, None, _INFOS_PATH), strict=True):
        infos[slot] = row


def _text_of(dtype: np.dtype) -> str:
    """Return a dtype as the text in NumPy's files: ``dtype.str`` does not contain the names of fields."""
    return dtype.str if dtype.names is None else repr(np.lib.format.dtype_to_descr(dtype))


def _dtype(text: str) -> np.dtype:
    description: Any = ast.literal_eval(text) if text.startswith("[") else text
    return np.lib.format.descr_to_dtype(description)
