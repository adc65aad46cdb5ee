"""The states of ``ResumeCallback`` on disk: each is there whole or not at all, and damaged ones are passed over."""

import errno
import fcntl
import os
import signal
import stat
import subprocess
import sys
import time
import warnings

import pytest

from sb3_tdc.common.files import write_atomically
from sb3_tdc.experiments.jobs import Job
from sb3_tdc.resume.store import BrokenStateError, LockedError, Store
from tests.helpers.paths import ROOT


@pytest.fixture
def store(tmp_path):
    store = Store(tmp_path / "resume", keep=2, span=0)
    yield store
    store.close()


def write(store, step, content=b"content", shared=None):
    shared = dict(shared or {})
    shared[f"ring_{step}"] = store.write_shared(f"ring_{step}", lambda path: path.write_bytes(b"ring" * step))
    store.write(step, {"a": lambda path: path.write_bytes(content), "b": lambda path: path.write_bytes(b"b")}, shared)
    store.remove_old()
    return shared


def names(folder):
    return sorted(path.name for path in folder.rglob("*") if path.is_file())


def test_the_newest_are_kept_with_what_they_need(store):
    assert store.newest() is None
    shared = write(store, 1)
    shared = write(store, 2, shared=shared)
    write(store, 3, shared={"ring_2": shared["ring_2"]})
    assert store.steps() == [3, 2]
    assert store.newest().step == 3
    # Step 2 still needs ring_1
    assert names(store.folder / "replay") == ["ring_1", "ring_2", "ring_3"]
    write(store, 4)
    assert names(store.folder / "replay") == ["ring_2", "ring_3", "ring_4"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        newest = store.newest()
    assert (newest.step, (newest.path / "a").read_bytes()) == (4, b"content")
    assert newest.shared_file("ring_4").read_bytes() == b"ring" * 4


def damage(path, how):
    content = path.read_bytes()
    if how == "truncated":
        path.write_bytes(content[: len(content) // 2])
    elif how == "flipped":
        path.write_bytes(bytes([content[0] ^ 1]) + content[1:])
    elif how == "empty":
        path.write_bytes(b"")
    else:
        path.unlink()


@pytest.mark.parametrize("how", ["truncated", "flipped", "empty", "missing"])
@pytest.mark.parametrize("name", ["step_000000000002/a", "step_000000000002/manifest", "replay/ring_2"])
def test_damage_goes_back_to_the_one_before_and_says_so(store, how, name):
    write(store, 1)
    write(store, 2)
    damage(store.folder / name, how)
    with pytest.warns(RuntimeWarning, match=r"(damaged|missing|cannot be read).*going back to the state of step 1"):
        assert store.newest().step == 1
    damage(store.folder / "step_000000000001" / "b", how)
    with pytest.raises(BrokenStateError, match=r"No state in .* is intact"):
        store.newest()


def test_any_flipped_bit_of_a_manifest_is_noticed(store):
    write(store, 1)
    manifest = store.folder / "step_000000000001" / "manifest"
    content = manifest.read_bytes()
    for i in range(0, len(content) - 1, 7):
        manifest.write_bytes(content[:i] + bytes([content[i] ^ 2]) + content[i + 1 :])
        with pytest.raises(BrokenStateError):
            store.newest()


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_an_interruption_at_any_instant_leaves_the_one_before(store, monkeypatch, call):
    """The process could be killed at every sync and at every rename."""
    write(store, 1)
    original = getattr(os, call)
    for instant in range(20):
        calls = 0

        def interrupted(*args, at=instant, **kwargs):
            nonlocal calls
            calls += 1
            if calls > at:
                raise KeyboardInterrupt
            return original(*args, **kwargs)

        monkeypatch.setattr(os, call, interrupted)
        try:
            write(store, 2)
        except KeyboardInterrupt:
            pass
        else:
            break
        finally:
            monkeypatch.undo()
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert store.newest().step in (1, 2)
        store.remove_after(1)
    assert instant > 1
    store.remove_old()
    assert not list(store.folder.glob(".*"))


def test_a_full_disk_leaves_no_trace(store, monkeypatch):
    write(store, 1)
    before = names(store.folder)

    def full(*args):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="No space left"):
            write(store, 2)
    assert names(store.folder) == before
    assert store.newest().step == 1


@pytest.mark.parametrize("number", [None, errno.EINVAL])
def test_a_file_is_on_disk_before_it_gets_its_name_and_its_name_before_the_call_returns(tmp_path, monkeypatch, number):
    """Also where the file system cannot sync folders; after a run's last file, its states are removed."""
    calls, fsync, replace = [], os.fsync, os.replace

    def record(descriptor):
        found = os.fstat(descriptor)
        calls.append(found.st_ino)
        if number is not None and stat.S_ISDIR(found.st_mode):
            raise OSError(number, os.strerror(number))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", record)
    monkeypatch.setattr(os, "replace", lambda *paths: calls.append("replace") or replace(*paths))
    path = tmp_path / "model.zip"
    write_atomically(lambda part: part.write_bytes(b"weights"), path)
    assert calls == [path.stat().st_ino, "replace", tmp_path.stat().st_ino]
    assert list(tmp_path.iterdir()) == [path]


def test_one_process_at_a_time(store):
    code = f"from pathlib import Path; from sb3_tdc.resume.store import Store; Store(Path({str(store.folder)!r}), 2, 0)"

    def open_elsewhere():
        return subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)

    sentence = f"Another process, or a newer ResumeCallback in this process, writes to {store.folder.parent}"
    assert sentence in open_elsewhere().stderr
    store.close()
    assert open_elsewhere().returncode == 0


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP])
def test_a_file_system_without_locks_is_named_and_can_be_written_to(tmp_path, monkeypatch, number):
    def flock(*args):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", flock)
    with pytest.warns(RuntimeWarning, match=rf"cannot lock files \({os.strerror(number)}\): train each run in one"):
        store = Store(tmp_path / "resume", keep=2, span=0)
    write(store, 1)
    assert store.newest().step == 1
    store.remove_all()
    job = Job("tdc", "Pendulum-v1", 1, 100, tmp_path)
    job.log.parent.mkdir()
    job.log.touch()
    with pytest.warns(RuntimeWarning, match="cannot lock files"):
        assert not job.is_trained_elsewhere


def test_in_one_process_the_newest_has_the_folder(store):
    """As when a cell of a notebook is run again: nothing has closed the first store."""
    write(store, 1)
    second = Store(store.folder, 2, 0)
    write(second, 2)
    with pytest.raises(LockedError, match="a newer ResumeCallback in this process"):
        store.open_again()
    with pytest.raises(LockedError):
        store.remove_all()
    assert second.steps() == [2, 1]
    second.close()
    assert store.open_again(["ring_2"])  # the first may write again as soon as the second is closed
    assert store.newest().step == 2
    third = Store(store.folder, 2, 0)  # takes the folder from the first, which had it last
    with pytest.raises(LockedError):
        store.open_again()
    third.close()


def test_a_forked_process_does_not_keep_the_lock(store):
    child = os.fork()
    if not child:
        time.sleep(30)
        os._exit(0)
    try:
        Store(store.folder, 2, 0).close()
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def test_there_is_always_an_older_one_to_go_back_to(tmp_path):
    store = Store(tmp_path / "resume", keep=2, span=50)
    for step in range(0, 400, 7):
        write(store, step)
        steps = store.steps()
        assert steps[:2] == [s for s in (step, step - 7) if s >= 0]
        assert len(steps) <= 4
        if step >= 50:
            assert any(50 <= step - s <= 100 + 7 for s in steps)
        assert all(store.at(s).step == s for s in steps)  # with the shared files that they need
    with pytest.raises(ValueError, match=r"no state of step 1; there are: 399, 392, \d+, \d+$"):
        store.at(1)
    store.close()
