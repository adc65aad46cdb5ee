"""Run folders: made for a run, and removed with the parent folders that were made for it alone."""

import pytest

from sb3_tdc.runs.folder import RunFolder
from tests.helpers.run_folders import make_run


@pytest.mark.parametrize(
    ("there", "left"),
    [
        ([], []),
        (["logs"], ["logs"]),
        (["logs/tdc"], ["logs", "logs/tdc"]),
        (["logs/tdc/Hopper-v4_1"], ["logs", "logs/tdc", "logs/tdc/Hopper-v4_1"]),
    ],
)
def test_a_run_that_never_began_leaves_what_was_there(tmp_path, there, left):
    for name in there:
        (tmp_path / name).mkdir(parents=True)
    RunFolder.create(tmp_path / "logs", "tdc", "Hopper-v4").remove()
    assert sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")) == left


def test_a_folder_that_another_run_uses_by_now_stays(tmp_path):
    first, second = (RunFolder.create(tmp_path / "logs", "tdc", "Hopper-v4") for _ in range(2))
    first.remove()
    assert [path.name for path in (tmp_path / "logs" / "tdc").iterdir()] == ["Hopper-v4_2"]
    second.remove()  # its parent folder was made for the first run
    assert (tmp_path / "logs" / "tdc").is_dir()


def test_a_run_of_rl_zoo_that_starts_over_is_not_finished(tmp_path):
    """Its old model has all steps, until the new one takes its place."""
    run = make_run(tmp_path, steps=1000, n_timesteps=1000)  # without resume_freq in its arguments, as RL Zoo's
    assert run.is_finished
    (run.resume_folder / "replay").mkdir(parents=True)
    assert not run.is_finished
