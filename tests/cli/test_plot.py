"""Learning curves from the evaluations of runs."""

import itertools
from pathlib import Path

import numpy as np
import pytest

from sb3_tdc.cli import plot
from sb3_tdc.runs.folder import RunFolder

figure = pytest.importorskip("matplotlib.figure")


def make_run(folder, env_id="A-v0", seed=1, evaluated=True):
    run = RunFolder.create(folder, "tdc", env_id)
    run.write_config({}, {"algo": "tdc", "env": env_id, "seed": seed})
    if evaluated:
        np.savez(run.path / "evaluations.npz", timesteps=[10, 20], results=[[1.0, 3.0], [5.0, 9.0]])
    return run.path


def test_lines_are_means_and_dots_are_episodes(tmp_path):
    curve = plot.load_curve(RunFolder.open(make_run(tmp_path, seed=4)))
    assert curve.label == "tdc, seed 4"
    axes = figure.Figure().subplots()
    plot.draw_curves(axes, [curve])
    (line,) = axes.lines
    assert line.get_xydata().tolist() == [[10, 2], [20, 7]]
    (dots,) = axes.collections
    assert dots.get_offsets().tolist() == [[10, 1], [10, 3], [20, 5], [20, 9]]
    assert axes.get_ylabel() == "return of 2 mean-action episodes"


def test_a_curve_can_be_cut(tmp_path):
    run = RunFolder.open(make_run(tmp_path))
    assert plot.load_curve(run, until=19).timesteps.tolist() == [10]
    assert plot.load_curve(run, until=20).returns.tolist() == [[1, 3], [5, 9]]
    with pytest.raises(ValueError, match="no evaluation until step 9, the first is at step 10"):
        plot.load_curve(run, until=9)


def test_runs_of_one_algorithm_and_seed_are_told_apart_by_their_folders(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("low", "high"):
        make_run(Path(name))
    runs = [Path("low/tdc/A-v0_1"), tmp_path / "high" / "tdc" / "A-v0_1", make_run(Path("low"), seed=2)]
    labels = [curve.label for curve in plot.load_curves(runs)]
    assert labels == ["tdc, seed 1 (low/tdc/A-v0_1)", "tdc, seed 1 (high/tdc/A-v0_1)", "tdc, seed 2"]
    labels = [curve.label for curve in plot.load_curves([runs[0], make_run(Path("low"))])]
    assert labels == ["tdc, seed 1 (A-v0_1)", "tdc, seed 1 (A-v0_3)"]


def test_a_single_evaluation_can_be_seen():
    axes = figure.Figure().subplots()
    for n in (1, 2):
        plot.draw_curves(axes, [plot.Evaluated(f"tdc, seed {n}", "A-v0", np.arange(n), np.ones((n, 5)))])
    assert [line.get_marker() for line in axes.lines] == ["o", "None"]


def test_a_figure_of_several_runs(tmp_path, capsys):
    runs = [make_run(tmp_path, seed=seed) for seed in (1, 2)]
    file = tmp_path / "figures" / "curve.png"
    assert plot.main([*map(str, runs), "-o", str(file)]) == 0
    assert file.read_bytes().startswith(b"\x89PNG")
    assert str(file) in capsys.readouterr().out


def test_one_episode_is_one():
    axes = figure.Figure().subplots()
    plot.draw_curves(axes, [plot.Evaluated("tdc", "A-v0", np.array([1]), np.array([[2.0]]))])
    assert axes.get_ylabel() == "return of 1 mean-action episode"


@pytest.mark.parametrize("label", ["advb_tdc, seed 1", "tdc, seed 1 (steps_300000/lam=0.0/seed_1/tdc/A-v0_1)"])
@pytest.mark.parametrize("n_curves", [5, 8, 30])
def test_the_legend_of_many_curves_is_below_the_axes(n_curves, label):
    drawn = figure.Figure(figsize=plot.figure_size(n_curves), layout="constrained")
    axes = drawn.subplots()
    curve = plot.Evaluated(label, "A-v0", np.array([100_000, 300_000]), np.array([[2.0], [3.0]]))
    plot.draw_curves(axes, [curve] * n_curves)
    drawn.draw_without_rendering()
    (legend,) = (legend.get_window_extent() for legend in drawn.legends)
    assert legend.y1 <= axes.xaxis.label.get_window_extent().y0
    assert (legend.x0 >= drawn.bbox.x0, legend.x1 <= drawn.bbox.x1, legend.y0 >= drawn.bbox.y0) == (True, True, True)
    assert axes.get_window_extent().width > drawn.bbox.width * 0.8
    assert axes.get_window_extent().height > 0.3 * drawn.bbox.height
    ticks = [tick.get_window_extent() for tick in axes.get_xticklabels() if tick.get_text()]
    assert all(one.x1 < other.x0 for one, other in itertools.pairwise(ticks))


def test_what_cannot_be_drawn_is_said(tmp_path, capsys):
    a, b = make_run(tmp_path), make_run(tmp_path, "B-v0")
    none = make_run(tmp_path, evaluated=False)
    for runs, message in (
        ([a, b], "The runs must be of one environment"),
        ([none], "the run has not been evaluated yet"),
        ([tmp_path], "is not the folder of a run"),
        ([tmp_path / "nothing"], "nothing does not exist"),
    ):
        with pytest.raises(SystemExit):
            plot.main([*map(str, runs), "-o", str(tmp_path / "figures" / "x.png")])
        assert message in capsys.readouterr().err
    with pytest.raises(SystemExit):
        plot.main([str(a), "-o", str(tmp_path / "figures" / "x.doc")])
    assert "x.doc: the name must end in one of ." in capsys.readouterr().err
    assert not (tmp_path / "figures").exists()
