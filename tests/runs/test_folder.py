"""Run folders: made for a run, and removed with what was made for it alone."""

import pytest

from sb3_tdc.runs.folder import RunFolder


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
    second.remove()  # the folder of all runs was not made for it
    assert (tmp_path / "logs" / "tdc").is_dir()
