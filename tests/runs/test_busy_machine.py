"""What a run says when its threads wait for each other on a busy machine; on clocks that the tests set."""

import itertools
from types import SimpleNamespace

import pytest
import torch as th

from sb3_tdc import TDC
from sb3_tdc.cli import train
from sb3_tdc.resume import ResumeCallback
from sb3_tdc.runs.callbacks import busy_machine
from sb3_tdc.runs.callbacks.busy_machine import BusyMachineCallback
from tests.helpers.command_line import SMALL

# Milliseconds and processor milliseconds of single updates on two threads, measured on two cores
QUIET = [(2.9, 5.8), (4.4, 8.7)]
BUSY = [(3.6, 7.2), (9.7, 9.7), (14.0, 14.0), (102.0, 100.0)]


class Machine:
    """Clocks, threads and a model that a :class:`BusyMachineCallback` sees in place of the real ones."""

    def __init__(self, monkeypatch, threads=2, device="cpu"):
        self.seconds, self.processor_seconds, self.messages = 0.0, 0.0, []
        clocks = SimpleNamespace(perf_counter=lambda: self.seconds, process_time=lambda: self.processor_seconds)
        monkeypatch.setattr(busy_machine, "time", clocks)
        monkeypatch.setattr(busy_machine, "th", SimpleNamespace(get_num_threads=lambda: threads))
        self.callback = BusyMachineCallback(self.messages.append, "REMEDY")
        self.model = SimpleNamespace(_n_updates=0, device=th.device(device))
        self.callback.model = self.model

    def collect(self, seconds=0.001):
        """Pass the time of a rollout, with everything else that happens in it."""
        self.callback.on_rollout_start()
        self.seconds += seconds
        self.processor_seconds += seconds
        self.callback.on_rollout_end()

    def train(self, milliseconds, processor_milliseconds, updates=1):
        self.collect()
        self.seconds += milliseconds / 1e3
        self.processor_seconds += processor_milliseconds / 1e3
        self.model._n_updates += updates

    def run(self, updates, seconds):
        """Repeat these updates until ``seconds`` have passed."""
        end = self.seconds + seconds
        for milliseconds, processor_milliseconds in itertools.cycle(updates):
            if self.seconds >= end:
                return
            self.train(milliseconds, processor_milliseconds)


@pytest.fixture
def machine(monkeypatch):
    return Machine(monkeypatch)


def test_a_run_that_becomes_slow_says_so_once_with_both_times_and_the_remedy(machine):
    machine.run(QUIET, 600)
    assert machine.messages == []
    machine.run(BUSY, 60)
    machine.run(QUIET, 60)
    machine.run(BUSY, 600)
    (message,) = machine.messages
    mean = (3.6 + 9.7 + 14.0 + 102.0) / 4
    assert f"takes {mean:.1f} ms, the fastest took 2.9:" in message
    assert "the 2 threads" in message
    assert message.endswith("REMEDY")


def test_it_is_said_after_half_a_minute_of_training_however_much_time_goes_elsewhere(machine):
    machine.run(BUSY, 29)
    machine.collect(seconds=1000)
    assert machine.messages == []
    machine.run(BUSY, 5)
    assert len(machine.messages) == 1


def test_a_machine_that_is_busy_from_the_start_is_noticed_too(machine):
    machine.train(3000, 3000)  # the first update compiles
    machine.run(BUSY, 60)
    assert "the fastest took 3.6:" in machine.messages[0]


def test_calls_of_many_updates_are_compared_update_by_update(machine):
    machine.train(290, 580, updates=100)
    for _ in range(20):
        machine.train(2000, 2000, updates=20)
    assert "takes 100.0 ms, the fastest took 2.9:" in machine.messages[0]


@pytest.mark.parametrize(("threads", "device"), [(1, "cpu"), (2, "cuda")])
def test_one_thread_and_gpus_are_left_alone(monkeypatch, threads, device):
    machine = Machine(monkeypatch, threads, device)
    machine.run([(5.0, 5.0)], 60)
    machine.run([(50.0, 35.0)], 600)
    assert machine.messages == []


@pytest.mark.parametrize(
    ("updates", "why"),
    [
        (QUIET, "nothing happened"),
        ([(2.9 * 16, 5.8 * 16)], "a larger batch: both threads compute"),
        ([(8.4, 8.4 * 1.49)], "the same work at 0.75 of the cores: less than 3 times as slow"),
        ([(29.0, 5.8)], "as slow, but waiting: for a disk, or passively for each other"),
        ([(14.5, 2.9)], "networks too small for two threads, next to many processes: one thread would not help"),
    ],
)
def test_updates_that_are_slow_for_another_reason_are_not_reported(machine, updates, why):
    machine.run(QUIET, 60)
    machine.run(updates, 600)
    assert machine.messages == [], why


def test_pauses_outside_of_updates_do_not_count(machine):
    """Evaluations and the writing of resume states keep one core busy for a while."""
    for _ in range(100):
        machine.run(QUIET, 1)
        machine.collect(seconds=20)
    assert machine.messages == []


def test_a_laptop_that_sleeps_again_and_again_is_not_slow(machine):
    for _ in range(20):
        machine.run(QUIET, 5)
        machine.train(3_600_000, 6)
    assert machine.messages == []


def test_bursts_of_load_are_not_worth_a_word(machine):
    for _ in range(20):
        machine.run(QUIET, 60)
        machine.run(BUSY, 20)
    assert machine.messages == []


def test_the_number_of_gradient_steps_may_change(machine):
    """Calls without an update, with one and with a thousand."""
    machine.run(QUIET, 60)
    for _ in range(30):
        machine.train(0.01, 0.01, updates=0)
        machine.train(4.0, 8.0)
        machine.train(4000, 8000, updates=1000)
    assert machine.messages == []


@pytest.fixture
def busy(monkeypatch):
    """Clocks for real runs, by which updates take 1 s and 100 s in turn."""
    readings, passed = itertools.count(), 0.0

    def read():
        nonlocal passed
        passed += (0, 1, 0, 100)[next(readings) % 4]
        return passed

    monkeypatch.setattr(busy_machine, "time", SimpleNamespace(perf_counter=read, process_time=lambda: passed))
    monkeypatch.setattr(busy_machine, "th", SimpleNamespace(get_num_threads=lambda: 2))


def run_train(folder, *args):
    common = ["--env", "Pendulum-v1", "-n", "200", "--seed", "1", "-f", str(folder), "--eval-freq", "-1"]
    return train.main([*common, "--device", "cpu", *SMALL, *args])


@pytest.mark.parametrize("bar", ["--progress", "--no-progress"])
def test_train_prints_the_command_that_helps(tmp_path, capsys, busy, bar):
    if bar == "--progress":
        pytest.importorskip("tqdm")
    assert run_train(tmp_path / "my logs", bar) == 0
    lines = capsys.readouterr().out.splitlines()
    (said,) = [i for i, line in enumerate(lines) if line.startswith("An update takes ")]
    assert lines[said].endswith("press Ctrl-C, then")
    folder = tmp_path / "my logs" / "tdc" / "Pendulum-v1_1"
    assert lines[said + 1] == f"  sb3-tdc train --resume '{folder}' --num-threads 1"


def test_states_of_a_real_run_do_not_count(tmp_path, capsys, monkeypatch):
    """The clocks advance by 100 s while a resume state is written, and by 1 s in an update."""
    passed = 0.0

    def pass_time(seconds):
        nonlocal passed
        passed += seconds

    update, write = TDC.train, ResumeCallback._save
    monkeypatch.setattr(TDC, "train", lambda *args, **kwargs: (pass_time(1), update(*args, **kwargs)))
    monkeypatch.setattr(ResumeCallback, "_save", lambda *args: (write(*args), pass_time(100)))
    clocks = SimpleNamespace(perf_counter=lambda: passed, process_time=lambda: passed)
    monkeypatch.setattr(busy_machine, "time", clocks)
    monkeypatch.setattr(busy_machine, "th", SimpleNamespace(get_num_threads=lambda: 2))
    assert run_train(tmp_path, "--resume-freq", "2", "--no-progress") == 0
    assert passed > 100 * 100
    assert "An update takes" not in capsys.readouterr().out


def test_without_states_there_is_another_command(tmp_path, capsys, busy):
    assert run_train(tmp_path, "--resume-freq", "-1", "--no-progress") == 0
    assert "add --num-threads 1 to the command that is printed then." in capsys.readouterr().out


def test_a_silent_run_stays_silent(tmp_path, capsys, busy):
    assert run_train(tmp_path, "--verbose", "0") == 0
    assert capsys.readouterr().out == ""
