"""Kinds for random number generators, and for text files to which rows are added."""

import io
import os
import random
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_tdc.resume.walk import MISSING, NotRestoredError, Restore, existing_as

_BIT_GENERATORS = {"PCG64", "PCG64DXSM", "MT19937", "Philox", "SFC64"}
GENERATORS = (np.random.Generator, np.random.RandomState, random.Random, th.Generator)


def capture_generator(value: np.random.Generator) -> dict[str, Any]:
    """Return the state of a generator, and the number of generators that it has spawned."""
    spawned = getattr(value.bit_generator.seed_seq, "n_children_spawned", 0)
    return {"state": value.bit_generator.state, "spawned": spawned}


def restore_generator(existing: Any, state: dict[str, Any]) -> np.random.Generator:
    """Restore the existing generator if its bit generator is of the same kind, else a new one."""
    name = state["state"]["bit_generator"]
    if name not in _BIT_GENERATORS:
        raise NotRestoredError(f"There is no bit generator {name}")
    if type(existing) is not np.random.Generator or type(existing.bit_generator).__name__ != name:
        existing = np.random.Generator(getattr(np.random, name)())
    existing.bit_generator.state = state["state"]
    seeds = existing.bit_generator.seed_seq
    if (missing := state["spawned"] - getattr(seeds, "n_children_spawned", 0)) > 0:
        seeds.spawn(missing)
    return existing


def restore_random_state(existing: Any, state: dict[str, Any]) -> np.random.RandomState:
    """Restore the existing generator, or a new one."""
    existing = existing if type(existing) is np.random.RandomState else np.random.RandomState()
    existing.set_state(state["state"])
    return existing


def capture_python_random(value: random.Random) -> dict[str, Any]:
    """Return the state of a generator."""
    version, words, gauss = value.getstate()
    return {"state": (version, list(words), gauss)}


def restore_python_random(existing: Any, state: dict[str, Any]) -> random.Random:
    """Restore the existing generator, or a new one."""
    existing = existing if type(existing) is random.Random else random.Random()
    version, words, gauss = state["state"]
    existing.setstate((version, tuple(words), gauss))
    return existing


def restore_torch_generator(existing: Any, state: dict[str, Any]) -> th.Generator:
    """Restore the existing generator, or a new one."""
    existing = existing if isinstance(existing, th.Generator) else th.Generator()
    existing.set_state(th.from_numpy(state["state"]))
    return existing


# ---------------------------------------------------------------- files


def is_written_file(value: Any) -> bool:
    """Return whether a value is a text file that is open for writing."""
    is_open = type(value) is io.TextIOWrapper and not value.closed and value.writable()
    return is_open and isinstance(value.name, str) and Path(value.name).is_file()


def capture_text_file(context: Any, file: Any, path: str) -> Any:
    """Return the content of a file."""
    file.flush()
    os.fsync(file.fileno())
    return context.add_array(np.frombuffer(Path(file.name).read_bytes(), dtype=np.uint8))


def restore_text_file(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Rewrite an open file with its captured content."""
    file = existing_as(io.TextIOWrapper, None if existing is MISSING else existing, path)
    if context.with_files:
        file.flush()
        file.seek(0)
        file.truncate()
        file.write(context.array(content).tobytes().decode(file.encoding))
        file.flush()
    return file
