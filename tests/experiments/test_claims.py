"""Verdicts on the paper's claims, from folders made by hand."""

import numpy as np
import pytest
from scipy import stats

from sb3_tdc.experiments import claims, statistics, tables
from sb3_tdc.experiments.claims import Interval, examine
from sb3_tdc.experiments.groups import group_runs
from sb3_tdc.experiments.results import find_runs
from tests.helpers.run_folders import make_run


def examine_folder(folder):
    return examine(group_runs(find_runs(folder)[0]))


def number(n, folder):
    """Return the comparisons for claim ``n``."""
    return [claim for claim in examine_folder(folder) if claim.says.startswith(str(n))]


def compare(folder):
    """Return the comparisons of runs of one length on one task, by claim, quantity and sides."""
    return {(c.says[0], c.what.split()[0], *c.sides): c for c in examine_folder(folder)}


def make_runs(folder, finals, algo="tdc", env_id="Hopper-v4", log=None, **changed):
    """Make runs with the settings of ``hyperparams/`` except those given; only the last evaluation is a late one."""
    for seed, final in enumerate(finals, 1):
        make_run(folder, algo, env_id, seed=seed, returns=((0.0, 0.0), (final, final)), log=log, **changed)


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
        (Interval(101, 100.9, 101.1, 9), "held"),  # different, but by less than a tenth
        (Interval(150, 140, 160, 3), "not held"),  # at least 38 apart, and a tenth of 150 is 15
        (Interval(101, np.nan, np.nan, 1), "undecided: too few seeds"),
    ],
)
def test_what_is_the_same_lies_within_a_tenth(other, verdict):
    assert claims.judge_same(Interval(100, 98, 102, 3), other) == verdict
    assert claims.judge_same(other, Interval(100, 98, 102, 3)) == verdict


@pytest.mark.parametrize(
    ("ours", "verdict"),
    [
        (Interval(130, 120, 140, 3), "held"),  # more
        (Interval(100, 97, 103, 3), "held"),  # the margin is 10: 97 ≥ 102 − 10
        (Interval(95, 93, 97, 3), "held"),  # less, but by less than a tenth
        (Interval(100, 80, 120, 3), "undecided"),  # perhaps a fifth less
        (Interval(80, 75, 85, 3), "not held"),  # at least 13 less, and the margin is 10
        (Interval(93, 89, 97, 3), "undecided"),  # less, but perhaps by 1 only
        (Interval(500, np.nan, np.nan, 1), "undecided: too few seeds"),
    ],
)
def test_what_is_at_least_as_large_is_at_most_a_tenth_smaller(ours, verdict):
    assert claims.judge_at_least(ours, Interval(100, 98, 102, 3)) == verdict


def test_a_run_that_improves_does_not_scatter(tmp_path):
    # The last third of twelve evaluations has four. Their scatter is that about their own fitted line
    rising = [(0.0,)] * 8 + [(10.0,), (20.0,), (30.0,), (40.0,)]
    zigzag = [(0.0,)] * 8 + [(1.0,), (-1.0,), (1.0,), (-1.0,)]
    few = [(0.0,)] * 4 + [(10.0,), (20.0,)]
    for lam, returns in ((0.1, rising), (0.2, zigzag), (0.3, few)):
        make_run(tmp_path, lam=lam, returns=returns)
    found = {g.setting("lam"): claims.late_spread(g).value for g in group_runs(find_runs(tmp_path)[0])}
    assert found[0.1] == pytest.approx(0)
    # Slope Σxy/Σx² = (−1.5 + 0.5 + 0.5 − 1.5)/5 = −0.4; residuals 0.4, −1.2, 1.2, −0.4; √(3.2/2)
    assert found[0.2] == pytest.approx(1.6**0.5)
    assert np.isnan(found[0.3])  # two points are always on a line


def test_the_scatter_of_other_evaluations_is_not_compared(tmp_path):
    make_runs(tmp_path, (1, 2, 3))
    make_run(tmp_path, "td3", returns=((0.0,), (1.0,)), args={"eval_episodes": 1})
    assert {claim.what.split()[0] for claim in number(2, tmp_path)} == {"standard"}


def test_heads_are_judged_as_the_paper_says_of_the_task(tmp_path):
    for env_id in ("HalfCheetah-v4", "Ant-v4", "Walker2d-v4", "Humanoid-v4", "Reacher-v4"):
        make_runs(tmp_path, (99, 100, 101), env_id=env_id)
        make_runs(tmp_path, (199, 200, 201), env_id=env_id, stochastic_actor=True)
    found = {claim.group.env_id: claim for claim in number(4, tmp_path)}
    assert {env_id: claim.verdict for env_id, claim in found.items()} == {
        "HalfCheetah-v4": "not held",  # the paper: the same
        "Humanoid-v4": "not held",
        "Ant-v4": "not held",  # the paper: deterministic
        "Walker2d-v4": "held",  # the paper: stochastic
    }
    make_runs(tmp_path / "alike", (99, 100, 101))
    make_runs(tmp_path / "alike", (100, 101, 102), stochastic_actor=True)
    (found,) = number(4, tmp_path / "alike")
    assert (found.says, found.verdict) == ("4. The heads are interchangeable", "held")


def test_only_what_the_paper_compares_on_a_task_is_compared(tmp_path):
    for algo in ("tdc", "td3", "sac"):
        make_runs(tmp_path, range(10), algo, env_id="AntBulletEnv-v0")
    assert set(compare(tmp_path)) == {("1", "mean", "TDC", "SAC")}


def test_a_larger_lam_returns_more_on_humanoid(tmp_path):
    for env_id in ("Humanoid-v4", "HalfCheetah-v4"):
        for lam, finals in ((0.0, (1, 2, 3)), (0.25, (90, 91, 92)), (0.75, (11, 12, 13))):
            make_runs(tmp_path, finals, env_id=env_id, lam=lam)
    (found,) = (claim for claim in number(3, tmp_path) if "Humanoid" in claim.says)
    assert (found.group.env_id, found.verdict) == ("Humanoid-v4", "held")
    assert (found.ours.value, found.other.value) == (12, 2)


def test_ablations_of_other_hyperparameters_say_nothing_of_the_paper(tmp_path):
    for lam in (0.0, 1.0):
        make_runs(tmp_path, (1, 2, 3), env_id="HalfCheetah-v4", lam=lam, kappa=5.0)
    assert compare(tmp_path) == {}


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
    against = found["1", "mean", "TDC", "TD3"]
    assert (against.ours.low, against.other.high) == pytest.approx((101 - half, 51 + half))
    assert against.verdict == "held"
    assert found["1", "mean", "TDC", "SAC"].verdict == "undecided"
    assert found["1", "mean", "TDC", "MEOW"].verdict == "undecided: too few seeds"
    assert found["2", "scatter", "TDC", "SAC"].verdict == "undecided: too few values in the last third"
    spreads = [c for c in examine_folder(tmp_path) if "over seeds" in c.what]
    assert {c.verdict for c in spreads} == {"undecided: too few seeds"}  # 1 [0.5, 6.3] and 500 [260, 3142], of three


def test_ten_seeds_decide_about_a_spread(tmp_path):
    make_runs(tmp_path, range(100, 110))
    make_runs(tmp_path, range(0, 1000, 100), algo="sac")
    make_runs(tmp_path, range(50, 60), algo="td3")
    spreads = {c.sides[1]: c for c in examine_folder(tmp_path) if "over seeds" in c.what}
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
    """A label names only what differs within its folder: here not λ, although it differs from ``hyperparams/``."""
    make_runs(tmp_path, (50, 51), algo="td3")
    make_runs(tmp_path, (100, 101), lam=0.0)
    assert compare(tmp_path) == {}
    for steps in (1000, 400):
        of_that_length = {"n_timesteps": steps, "learning_starts": steps // 10, "steps": steps}
        make_runs(tmp_path / "as_shipped", (100, 101), **of_that_length)
        make_runs(tmp_path / "as_shipped", (50, 51), algo="td3", **of_that_length)
    assert len(number(1, tmp_path / "as_shipped")) == 2


def test_runs_of_another_length_are_not_compared(tmp_path):
    make_runs(tmp_path, (100, 101))
    make_runs(tmp_path, (50, 51), algo="td3", n_timesteps=500, steps=500)
    assert compare(tmp_path) == {}


def test_the_largest_lam_against_the_smallest(tmp_path):
    for lam, spread in ((0.0, 300.0), (0.5, 100.0), (0.9, 1.0)):
        make_runs(tmp_path, (*(500 - spread, 500 + spread) * 5, 500), env_id="HalfCheetah-v4", lam=lam)
    (found,) = number(3, tmp_path)
    assert (found.ours.value, found.other.value, found.verdict) == (pytest.approx(1), pytest.approx(300), "held")


def test_a_small_lam_is_not_the_paper_s_larger_one(tmp_path):
    for lam in (0.0, 0.5):
        make_runs(tmp_path, (1, 2, 3), env_id="HalfCheetah-v4", lam=lam)
    assert number(3, tmp_path) == []


def test_td_errors_late_in_training(tmp_path):
    variants = {0.0: (1e9, 1e9, 1e2, 1e2, 1e2), 1.0: (1e-9, 1e-9, 10, 10, 10), 3.0: (1e-9, 1e-9, 1e-5, 1e-5, 1e-5)}
    for lam, variances in variants.items():
        make_runs(tmp_path, (1.0, 1.0, 1.0), lam=lam, log={"train/td_error_var": variances})
    (found,) = number(5, tmp_path)
    assert (found.ours.value, found.other.value) == pytest.approx((1, 2))  # the first two thirds do not count
    assert found.sides == ("TDC, λ 1", "TDC, λ 0")
    assert found.verdict == "held"


def test_the_table(tmp_path):
    make_runs(tmp_path, (100,))
    make_runs(tmp_path, (50, 51, 52), algo="td3")
    table = tables.make_claims_table(group_runs(find_runs(tmp_path)[0]))
    row = table.to_dict("records")[0]
    assert row["Ours"] == "TDC: 100 (1 seed)"
    assert row["Other"] == "TD3: 51 [48.5, 53.5] (3 seeds)"
    assert row["Verdict"] == "undecided: too few seeds"
