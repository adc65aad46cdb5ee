"""Callback that writes the resume states of a run, and restores one of them."""

import io
import json
import os
import re
import shutil
import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import TrainFrequencyUnit

from sb3_tdc.common.files import write_atomically
from sb3_tdc.common.finite import refuse_non_finite
from sb3_tdc.common.words import count
from sb3_tdc.resume import replay_file, run_state
from sb3_tdc.resume.locations import Locations
from sb3_tdc.resume.store import Store, Stored
from sb3_tdc.resume.walk import Initial, NotRestoredError

DEFAULT_FREQ = 10_000
# The beginning of a sentence about one of several environments
_ENVIRONMENT = re.compile(r".*?, environment \d+(?=: )")
# The older state that stays is between ``_OLDER * freq`` and twice as many steps older than the newest
_OLDER = 10


class ResumeCallback(BaseCallback):
    """
    Callback that writes states from which a run continues as if it had never been stopped. It must come first::

        states = ResumeCallback("my_run/resume")
        states.select(model)  # nothing happens if there are none yet
        model.learn(1_000_000, callback=[states, ...])

    A state is written before the first step, then every ``freq`` steps and before every evaluation. It is written when
    a rollout starts: at no other moment do the objects hold the whole state.

    :param folder: folder of the states; every run needs its own
    :param freq: minimum number of environment steps between regular states
    :param keep: number of the newest states that stay on disk. One older state also stays, for going back before a
        divergence, together with the state that will replace it
    :param files: files that callbacks rewrite and that belong to the state, in addition to those of an ``EvalCallback``
    :param hyperparams: plain values that the run was built from; a resumed run with another value is refused
    :param verbose: 0 for warnings only
    :raises ValueError: if ``freq`` or ``keep`` is below 1, or another process writes to the folder
    """

    is_captured = False

    def __init__(
        self,
        folder: str | Path,
        freq: int = DEFAULT_FREQ,
        keep: int = 2,
        files: Iterable[str | Path] = (),
        hyperparams: Mapping[str, Any] | None = None,
        verbose: int = 1,
    ):
        super().__init__(verbose)
        for name, value in (("freq", freq), ("keep", keep)):
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        self.freq, self.files = freq, [Path(file) for file in files]
        self.store = Store(Path(folder), keep, span=_OLDER * freq)
        self.is_wanted: Callable[[], bool] = lambda: False
        self.hyperparams = json.loads(json.dumps(dict(hyperparams or {}), default=str))
        self.last_step: int | None = None  # timestep of the newest state
        self.last_try: int | None = None  # the same, or timestep of a later state that could not be written
        self.seconds = 0.0  # time for which training has waited for states
        self._to_restore: Stored | None = None
        self._parts: dict[str, Any] = {}
        self._changed: tuple[str, ...] = ()
        self.root: BaseCallback = self  # root of all callbacks during training
        self._initial: Initial | None = None  # what was captured when training began
        self._told: set[str] = set()
        self._segments: list[replay_file.Segment] = []
        self._digests: dict[str, str] = {}
        self._before: tuple[int, int] | None = None  # position in the replay buffer and timestep of the last segment
        self._kept: dict[Path, tuple[os.stat_result, Path]] = {}

    # ---------------------------------------------------------------- restoring

    def select(self, model: OffPolicyAlgorithm, step: int | None = None, changed: Sequence[str] = ()) -> int | None:
        """
        Choose the newest intact state; the next ``model.learn`` continues from it.

        :param model: the model, built as for the first run, with its environments
        :param step: go back to the state of this step; later states are removed when training begins
        :param changed: hyperparameters that keep the model's new value, not the state's, for instance ``learning_rate``
        :return: the timestep from which training will continue; None if there is no state yet
        :raises ValueError: if the state is of another algorithm or environment, if a hyperparameter differs or cannot
            be changed, if there are states but none is intact, or if there is no state of ``step``
        """
        for name in changed:
            if name not in (allowed := run_state.changeable(model)):
                raise ValueError(f"{name} cannot be changed when a run is resumed; {', '.join(allowed)} can be")
        stored = self.store.newest() if step is None else self.store.at(step)
        if stored is None:
            return None
        parts = json.loads((stored.path / "state.json").read_text())
        for name, now in run_state.describe_run(model).items():
            if parts["run"][name] != now:
                difference = "is another" if name == "network" else f"was {parts['run'][name]}, and is {now}"
                raise ValueError(f"{stored.path} is of another run: the {name} {difference}")
        self._refuse_other_hyperparams(stored, parts["hyperparams"], changed)
        self._to_restore, self._parts, self._changed = stored, parts, tuple(changed)
        return stored.step

    def _refuse_other_hyperparams(self, stored: Stored, then: dict[str, Any], changed: Sequence[str]) -> None:
        now = self.hyperparams
        for name in sorted({*then, *now} - {*changed, "n_timesteps"}):
            if then.get(name) != now.get(name):
                raise ValueError(
                    f"{name} was {then.get(name, 'not given')} when {stored.path} was written, and is "
                    f"{now.get(name, 'not given')} now: put it back, or change it by -params {name}:…"
                )

    def _on_training_start(self) -> None:
        self.root = self.locals["callback"]
        self.store.open_again()  # refuses a folder locked by another, before any file is removed or restored
        if self._to_restore is None:
            newest = max(self.store.steps(), default=None)
            if newest is None:
                self.last_step = self.last_try = None
                self._forget_files()
            # After an earlier ``learn`` with this callback, the run continues, unless it counts from step 0 again
            elif newest != self.last_step or self.locals["reset_num_timesteps"]:
                raise ValueError(
                    f"{self.store.folder} has states of a run already: call select(model) to resume from one, "
                    "or choose another folder"
                )
            return
        self.model.num_timesteps = self._to_restore.step  # the callbacks after this one need it
        if self._to_restore.step >= self.locals["total_timesteps"]:
            self._verify()
            self._restore()  # now, since there will be no rollout

    def _restore(self) -> None:
        stored, parts = self._to_restore, self._parts
        assert stored is not None
        model: Any = self.model
        self._segments = [replay_file.Segment(**segment) for segment in parts["segments"]]
        replay_file.read_segments(model.replay_buffer, ((s, stored.shared_file(s.name)) for s in self._segments))
        weights = th.load(stored.path / "weights.pt", map_location=model.device, weights_only=True)
        run_state.restore_weights(model, weights)
        with np.load(stored.path / "arrays.npz", allow_pickle=False) as arrays:
            numbered = [arrays[str(i)] for i in range(len(arrays.files))]
        locations = Locations.restore(parts["locations"], self.store.folder.parent)
        context = run_state.restoring(model, numbered, stored.step, locations)
        run_state.restore_state(model, self.root, parts["state"], context, self._changed)
        restarted = [why for why in context.restarted if why.startswith("env")]
        others = [why for why in (*context.not_restored, *context.restarted) if why not in restarted]
        for why in _without_repetition(why for why in others if why not in self._told):
            warnings.warn(f"Not restored: {why}", RuntimeWarning, stacklevel=2)
        self._put_files_back(stored, parts["files"])
        self.store.remove_after(stored.step)
        self._digests, self.last_step, self.last_try = dict(stored.shared), stored.step, stored.step
        self._before = model.replay_buffer.pos, stored.step
        if restarted:  # the last slot now ends its episodes, and must be written again
            self._before = (model.replay_buffer.pos - 1) % model.replay_buffer.buffer_size, stored.step - model.n_envs
        self._to_restore = None
        self._tell_what_differs(parts["platform"], restarted)

    def _tell_what_differs(self, platform: dict[str, str], restarted: list[str]) -> None:
        now = run_state.describe_platform(self.model)  # type: ignore[arg-type]
        differences = [
            f"{name} was {platform[name]}, is {now[name]}" for name in now if platform.get(name) != now[name]
        ]
        if differences:
            warnings.warn(
                f"Exact continuation needs the same platform: {'; '.join(differences)}", RuntimeWarning, stacklevel=2
            )
        if restarted:
            warnings.warn(
                f"Continuing with new episodes, since not all of an environment could be restored: {restarted[0]}",
                RuntimeWarning,
                stacklevel=2,
            )
        if self.verbose > 0:
            print(f"Continuing from step {self.last_step:,}", flush=True)

    # ---------------------------------------------------------------- saving

    def verify(self, model: OffPolicyAlgorithm) -> list[str]:
        """
        Find the values that a resumed run would not have.

        Everything but weights and transitions is captured, restored into the same objects, captured again and compared.
        Training begins with the same check, and issues its sentences as warnings.

        :param model: the model, with its environments; before ``learn``, callbacks are not checked
        :return: a sentence for each value that a resumed run would not have, beginning with its path
        """
        return run_state.verify(model, self.root)[0]

    def _verify(self) -> None:
        """Warn of the values that a resumed run would not have, at the start of training in every process."""
        names, self._initial = run_state.verify(self.model, self.root)  # type: ignore[arg-type]
        self._tell(names)

    def _tell(self, names: list[str]) -> None:
        for name in _without_repetition(name for name in names if name not in self._told):
            warnings.warn(f"Not in the resume states: {name}", RuntimeWarning, stacklevel=2)
        self._told.update(names)

    def _on_rollout_start(self) -> None:
        if self._initial is None:
            self._verify()
        if self._to_restore is not None:
            self._restore()
            return
        step = self.model.num_timesteps
        due = self.last_try is None or step - self.last_try >= self.freq
        if step != self.last_try and (due or self.is_wanted() or self._evaluation_is_next()):
            start = time.perf_counter()
            self.last_try = step
            self._save(step)
            self.seconds += time.perf_counter() - start

    def _evaluation_is_next(self) -> bool:
        """Return whether the rollout that starts contains an evaluation; False if rollouts are measured in episodes."""
        train_freq: Any = self.model.train_freq  # type: ignore[attr-defined]
        if train_freq.unit != TrainFrequencyUnit.STEP:
            return False
        evaluations = [each for each in run_state.evaluations_of(self.root) if each.eval_freq > 0]
        return any(each.n_calls % each.eval_freq + train_freq.frequency >= each.eval_freq for each in evaluations)

    def _save(self, step: int) -> None:
        first = self.last_step is None
        try:
            self._write(step)
        except OSError as error:
            warnings.warn(
                f"The state of step {step:,} could not be written ({error}). Training continues; "
                + ("there is none yet" if first else f"that of step {self.last_step:,} stays")
                + f". The next is due in {self.freq:,} steps.",
                RuntimeWarning,
                stacklevel=2,
            )

    def _write(self, step: int) -> None:
        model: Any = self.model
        assert self._initial is not None
        refusal = f"The state of step {step:,} was not written:"
        refuse_non_finite(refusal, run_state.find_non_finite(model))
        parts, context = run_state.capture_state(model, self.root, self._initial)
        self._tell(context.left_out)
        if not self.store.open_again(self._digests):
            self._forget_files()
        segments, digests = self._write_segment(step, refusal)
        files = [*self.files, *run_state.files_of_evaluations(self.root)]
        content = {
            "run": run_state.describe_run(model),
            "hyperparams": self.hyperparams,
            "locations": Locations.capture(self.store.folder.parent, self._initial.texts),
            "platform": run_state.describe_platform(model),
            "state": parts,
            "segments": [asdict(segment) for segment in segments],
            "files": [str(i) if file.exists() else None for i, file in enumerate(files)],
        }
        weights = run_state.capture_weights(model)
        arrays = {str(i): array for i, array in enumerate(context.arrays)}
        writers: dict[str, Any] = {
            "state.json": lambda path: path.write_text(json.dumps(content)),
            "arrays.npz": lambda path: np.savez(path, **arrays),  # type: ignore[arg-type]
            "weights.pt": lambda path: _save_weights(weights, path),
        }
        stats = {file: file.stat() for file in files if file.exists()}
        writers |= {f"file_{i}": self._copier(file) for i, file in enumerate(files) if file in stats}
        stored = self.store.write(step, writers, digests)
        self._segments, self._digests, self.last_step = segments, digests, step
        self._before = model.replay_buffer.pos, step
        self._kept = {file: (stats[file], stored.path / f"file_{i}") for i, file in enumerate(files) if file in stats}
        self.store.remove_old()

    def _forget_files(self) -> None:
        """Forget the files of earlier states, so that the next state does not need them."""
        self._segments, self._digests, self._before, self._kept = [], {}, None, {}

    def _write_segment(self, step: int, refusal: str) -> tuple[list[replay_file.Segment], dict[str, str]]:
        model: Any = self.model
        buffer = model.replay_buffer
        segments = self._segments
        first, last_step = self._before or (None, step)
        new = replay_file.new_segment(buffer, f"step_{step:012d}.npz", first, (step - last_step) // model.n_envs)
        if new is None:
            return segments, self._digests
        refuse_non_finite(refusal, replay_file.find_non_finite(buffer, new))
        infos, left_out = replay_file.capture_infos(buffer, new)
        self._tell(left_out)
        digest = self.store.write_shared(new.name, replay_file.write_segment(buffer, new, infos))
        segments = replay_file.needed([*segments, new], buffer.buffer_size)
        digests = {**self._digests, new.name: digest}
        return segments, {segment.name: digests[segment.name] for segment in segments}

    def _copier(self, file: Path) -> Callable[[Path], None]:
        """Return a function that copies a file, or links to the last state's copy if the file has not changed since."""

        def copy(path: Path) -> None:
            now = file.stat()
            if file in self._kept and _identity(self._kept[file][0]) == _identity(now):
                try:
                    os.link(self._kept[file][1], path)
                    return
                except OSError:
                    pass  # a file system without hard links
            shutil.copyfile(file, path)

        return copy

    def _put_files_back(self, stored: Stored, saved: list[str | None]) -> None:
        files = [*self.files, *run_state.files_of_evaluations(self.root)]
        if len(files) != len(saved):
            of_callbacks = f"{count(len(saved), 'file')} of callbacks"
            raise NotRestoredError(f"{stored.path} has {of_callbacks}, this run has {len(files)}")
        for file, number in zip(files, saved, strict=True):
            if number is None:
                file.unlink(missing_ok=True)
            else:
                write_atomically(partial(shutil.copyfile, stored.path / f"file_{number}"), file)

    def _on_step(self) -> bool:
        return True


def _without_repetition(sentences: Iterable[str]) -> list[str]:
    """Return the sentences without repetition: those that differ only in their environment become one."""
    places: dict[str, list[str]] = {}
    for sentence in dict.fromkeys(sentences):
        environment = _ENVIRONMENT.match(sentence)
        place = environment[0] if environment else ""
        places.setdefault(sentence.removeprefix(place), []).append(place)
    return [
        f"{place} (and {count(len(others), 'other')}){what}" if others else f"{place}{what}"
        for what, (place, *others) in places.items()
    ]


def _save_weights(weights: dict[str, Any], path: Path) -> None:
    content = io.BytesIO()  # PyTorch's own writer hides disk errors in a RuntimeError
    th.save(weights, content)
    path.write_bytes(content.getbuffer())


def _identity(stat: os.stat_result) -> tuple[int, ...]:
    return stat.st_ino, stat.st_size, stat.st_mtime_ns
