"""Verdicts on the paper's claims, from folders made by hand."""

import numpy as np
import pytest
from scipy import stats

from sb3_tdc.experiments import claims, statistics, tables
from sb3_tdc.experiments.claims import Interval, examine
from sb3_tdc.experiments.results import find_runs, group_runs
from sb3_tdc.hyperparams import hyperparams_file, read_entry
from tests.helpers.run_folders import make_run


def compare(folder):
    return {(c.says[0], c.what.split()[0], *c.sides): c for c in examine(group_runs(find_runs(folder)[0]))}


def make_runs(folder, finals, algo="tdc", **changed):
    """Runs with the hyperparameters of ``hyperparams/``, but for what is changed."""
    shipped, _ = read_entry(hyperparams_file(algo), "Hopper-v4")
    config = {**shipped, "n_timesteps": 1000, "learning_starts": 100, **changed}
    for seed, final in enumerate(finals, 1):
        make_run(folder, algo, seed=seed, returns=((0.0, 0.0), (final, final)), **config)


def test_intervals_that_do_not_overlap_decide():
    low, middle, high = Interval(1, 0, 2, 3), Interval(2, 1, 3, 3), Interval(9, 8, 10, 3)
    unknown = Interval(9, np.nan, np.nan, 1)
    assert claims.judge(high, low) == "held"
    assert claims.judge(low, high) == "not held"
    assert claims.judge(low, middle) == "undecided"
    assert claims.judge(unknown, low) == "undecided: too few seeds"
    assert claims.judge_smaller(low, high) == "held"


@pytest.mark.parametrize(
    ("other", "verdict"),
    [
        (Interval(101, 99, 103, 3), "held"),  # at most 103 − 98 = 5 apart, and a tenth of 101 is 10.1
        (Interval(105, 95, 115, 3), "undecided"),  # perhaps 17 apart
        (Interval(120, 110, 130, 3), "undecided"),  # perhaps 8 apart
        (Interval(101, 100.9, 101.1, 9), "held"),  # another number, but not by a tenth
        (Interval(150, 140, 160, 3), "not held"),  # at least 38 apart, and a tenth of 150 is 15
        (Interval(101, np.nan, np.nan, 1), "undecided: too few seeds"),
    ],
)
def test_what_is_the_same_lies_within_a_tenth(other, verdict):
    assert claims.judge_same(Interval(100, 98, 102, 3), other) == verdict
    assert claims.judge_same(other, Interval(100, 98, 102, 3)) == verdict


def test_the_interval_of_a_spread():
    # (n − 1)s²/χ²: of 1, 2, 3 with s = 1: √(2/7.3778) and √(2/0.050636)
    assert statistics.spread_interval(np.array([1.0, 2.0, 3.0])) == pytest.approx((0.5207, 6.2847), rel=1e-3)
    rng = np.random.default_rng(0)
    inside = [low < 2 < high for low, high in (statistics.spread_interval(rng.normal(0, 2, 5)) for _ in range(2000))]
    assert np.mean(inside) == pytest.approx(0.95, abs=0.02)


def test_final_returns_and_spreads(tmp_path):
    make_runs(tmp_path, (100, 101, 102))
    make_runs(tmp_path, (50, 51, 52), algo="td3")
    make_runs(tmp_path, (0, 500, 1000), algo="sac")
    make_runs(tmp_path, (10,), algo="meow")
    found = compare(tmp_path)
    half = stats.t.ppf(0.975, 2) / 3**0.5
    against = found["1", "final", "TDC", "TD3"]
    assert (against.ours.low, against.other.high) == pytest.approx((101 - half, 51 + half))
    assert against.verdict == "held"
    assert found["1", "final", "TDC", "SAC"].verdict == "undecided"
    assert found["1", "final", "TDC", "MEOW"].verdict == "undecided: too few seeds"
    assert found["2", "standard", "TDC", "SAC"].verdict != "held"  # the last quantity of that name: late in training
    spreads = [c for c in examine(group_runs(find_runs(tmp_path)[0])) if "over seeds" in c.what]
    assert {c.verdict for c in spreads} == {"undecided: too few seeds"}  # 1 [0.5, 6.3] and 500 [260, 3142], of three


def test_ten_seeds_decide_about_a_spread(tmp_path):
    make_runs(tmp_path, range(100, 110))
    make_runs(tmp_path, range(0, 1000, 100), algo="sac")
    make_runs(tmp_path, range(50, 60), algo="td3")
    spreads = {c.sides[1]: c for c in examine(group_runs(find_runs(tmp_path)[0])) if "over seeds" in c.what}
    assert spreads["SAC"].verdict == "held"
    assert spreads["TD3"].verdict == "undecided"
    assert spreads["SAC"].other.value == pytest.approx(302.77, abs=0.01)


def test_other_physics_are_not_compared(tmp_path):
    make_runs(tmp_path, (100, 101, 102))
    make_runs(tmp_path, (50, 51, 52), algo="td3")
    for path in (tmp_path / "td3").glob("*/*"):
        if path.is_dir():
            (path / "versions.yml").write_text("mujoco: 4.0.0\n")
    for path in (tmp_path / "tdc").glob("*/*"):
        if path.is_dir():
            (path / "versions.yml").write_text("mujoco: 3.4.0\n")
    assert compare(tmp_path) == {}


def test_what_hyperparams_say_is_what_is_judged(tmp_path):
    """In a folder of other runs, labels name what differs there, and not what differs from ``hyperparams/``."""
    make_runs(tmp_path, (50, 51), algo="td3")
    make_runs(tmp_path, (100, 101), lam=0.0)
    assert compare(tmp_path) == {}
    for steps in (1000, 400):  # the labels name the steps
        of_that_length = {"n_timesteps": steps, "learning_starts": steps // 10, "steps": steps}
        make_runs(tmp_path / "as_shipped", (100, 101), **of_that_length)
        make_runs(tmp_path / "as_shipped", (50, 51), algo="td3", **of_that_length)
    assert len([c for c in compare(tmp_path / "as_shipped").values() if c.says.startswith("1")]) == 2


def test_runs_of_another_length_are_not_compared(tmp_path):
    make_runs(tmp_path, (100, 101))
    make_runs(tmp_path, (50, 51), algo="td3", n_timesteps=500, steps=500)
    assert compare(tmp_path) == {}


def test_the_largest_lam_against_the_smallest(tmp_path):
    for lam, spread in ((0.0, 300.0), (0.5, 100.0), (0.9, 1.0)):
        make_runs(tmp_path, (*(500 - spread, 500 + spread) * 5, 500), lam=lam)
    (found,) = (c for c in compare(tmp_path).values() if c.says.startswith("3"))
    assert (found.ours.value, found.other.value, found.verdict) == (pytest.approx(1), pytest.approx(300), "held")


def test_td_errors_late_in_training(tmp_path):
    for lam, variances in ((0.0, (1e9, 1e9, 100.0, 100.0, 100.0)), (0.9, (1e-9, 1e-9, 10.0, 10.0, 10.0))):
        for seed in (1, 2, 3):
            log = {"train/td_error_var": np.array(variances) * 1.01**seed}
            make_run(tmp_path, seed=seed, lam=lam, returns=((1.0,),), log=log)
    (found,) = (c for c in compare(tmp_path).values() if c.says.startswith("5"))
    assert found.ours.value == pytest.approx(1 + 2 * np.log10(1.01))  # the first two thirds do not count
    assert found.other.value == pytest.approx(2 + 2 * np.log10(1.01))
    assert found.verdict == "held"


def test_the_table(tmp_path):
    make_runs(tmp_path, (100,))
    make_runs(tmp_path, (50, 51, 52), algo="td3")
    table = tables.make_claims_table(group_runs(find_runs(tmp_path)[0]))
    row = table.to_dict("records")[0]
    assert row["Ours"] == "TDC: 100 (1 seed)"
    assert row["Other"] == "TD3: 51 [48.5, 53.5] (3 seeds)"
    assert row["Verdict"] == "undecided: too few seeds"
