"""Curves that others have published, next to ours."""

import numpy as np
import pytest

from sb3_tdc.experiments import figures, tables
from sb3_tdc.experiments.groups import group_runs
from sb3_tdc.experiments.published_curves import PublishedCurve, published_curves
from sb3_tdc.experiments.results import find_runs
from tests.helpers.run_folders import make_run


def test_known_numbers():
    """SAC on Hopper after 100,000 steps: 1103 ± 388 over 10 seeds, as its source says."""
    (sac,) = (curve for curve in published_curves("Hopper-v4") if curve.algorithm == "SAC")
    mean, low, high = sac.at(100_000)
    assert mean == pytest.approx(1103, abs=1)
    assert high - mean == pytest.approx(2.262 * 388 / 10**0.5, rel=0.01)  # t of 9 degrees of freedom
    assert mean - low == pytest.approx(high - mean)
    assert published_curves("Pendulum-v1") == []


def test_the_seeds_of_a_curve_are_those_of_its_training():
    """CrossQ on Humanoid has one seed at step 0, and ten from then on."""
    (crossq,) = (curve for curve in published_curves("Humanoid-v4") if curve.algorithm == "CrossQ")
    assert (crossq.seeds, int(crossq.steps[0])) == (10, 18_000)
    _, low, high = crossq.at(18_000)
    assert (high - low) / 2 == pytest.approx(2.262 * 121.9 / 10**0.5, rel=1e-3)


def test_between_points_and_beyond_the_last():
    steps = np.array([100.0, 300.0])
    curve = PublishedCurve("somewhere", "SAC", 4, steps, np.array([10.0, 20.0]), np.array([2.0, 4.0]))
    half = 3.182 * 3 / 2  # t of 3 degrees of freedom, σ = 3 in the middle, √4
    np.testing.assert_allclose(curve.at(200), (15, 15 - half, 15 + half), rtol=1e-3)
    assert np.isnan(curve.at(301)).all()
    assert np.isnan(curve.at(99)).all()


def test_the_table_compares_at_our_number_of_steps(tmp_path):
    for seed, last in ((1, 2000.0), (2, 2200.0)):
        make_run(
            tmp_path,
            algo="sac",
            env_id="Hopper-v4",
            seed=seed,
            steps=100_000,
            returns=((last, last),),
            n_timesteps=100_000,
        )
    make_run(tmp_path, algo="sac", env_id="Pendulum-v1", steps=1000)  # nothing is published for it
    table = tables.make_published_curves_table(group_runs(find_runs(tmp_path)[0]))
    assert {name.split(",")[0] for name in table["Environment"]} == {"Hopper-v4"}
    assert set(table["Steps"]) == {"100,000"}
    rows = {row["Algorithm"]: row for row in table.to_dict("records")}
    # 2100 ± 12.706·√(20000)/√2 of two seeds
    assert rows["SAC: this report"]["Return"] == "2,100 [829, 3,371]"
    assert rows["SAC: published"]["Return"].startswith("1,10")
    assert rows["SAC: published"]["Seeds"] == "10"


def test_a_published_curve_is_drawn_as_far_as_ours_go():
    pytest.importorskip("matplotlib")
    from matplotlib.figure import Figure

    ours = figures.Curve("TDC", "red", np.array([100.0, 200.0]), np.array([[1.0, 2.0]]))
    steps = np.array([50.0, 150.0, 250.0])
    theirs = PublishedCurve("somewhere", "SAC", 3, steps, np.array([5.0, 6.0, 7.0]), np.ones(3))
    axes = Figure().subplots()
    figures.draw_curves(axes, [ours], "title", "return", published=[theirs])
    (dashed,) = (line for line in axes.lines if line.get_linestyle() == "--")
    assert dashed.get_xdata().tolist() == [50, 150]
    assert dashed.get_label() == "SAC, published · 3 seeds"
