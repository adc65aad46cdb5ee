"""Open every attack in this process, and print the time and the memory that each took, as JSON."""

import contextlib
import ctypes
import io
import json
import re
import sys
import tempfile
import time
import warnings
from pathlib import Path

from sb3_tdc import load_safely
from sb3_tdc.cli import enjoy
from sb3_tdc.safe_load import load_replay_buffer
from tests.safe_load.attacks import ATTACKS
from tests.safe_load.attacks.buffers import make_model


def open_file(path: Path) -> str:
    """:return: the refusal, or "opened" """
    if path.is_dir():
        errors = io.StringIO()
        try:
            with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
                enjoy.main([str(path), "--no-render", "--n-episodes", "1", "--device", "cpu"])
        except SystemExit as error:
            return errors.getvalue() if error.code == 2 else f"exit {error.code}"
        return "opened"
    try:
        if path.suffix == ".pkl":
            load_replay_buffer(path, make_model())
        else:
            load_safely(path, device="cpu")
    except ValueError as error:
        return str(error)
    return "opened"


def reset_peak() -> int:
    """Let the kernel measure the peak memory of this process from here on. :return: its present memory, in KiB"""
    # What is freed stays with the process, where the next allocation takes it unmeasured
    ctypes.CDLL(None).malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5")
    return peak()


def peak() -> int:
    """:return: the peak memory of this process since the last reset, in KiB"""
    (size,) = re.findall(r"^VmHWM:\s+(\d+) kB$", Path("/proc/self/status").read_text(), re.MULTILINE)
    return int(size)


def main(model: Path, names: list[str]) -> None:
    warnings.simplefilter("ignore")
    found = {}
    for name in names or ATTACKS:
        with tempfile.TemporaryDirectory() as folder:
            path = ATTACKS[name](Path(folder), model)
            before, start = reset_peak(), time.process_time()
            message = open_file(path)
            seconds = time.process_time() - start
            mebibytes = (peak() - before) / 1024
            left = [str(each) for each in Path.cwd().iterdir()]
        found[name] = {"message": message, "seconds": seconds, "mebibytes": mebibytes, "left": left}
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
