"""Variants of TDC against their controls, from folders made by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from sb3_tdc.experiments import figures, sections, statistics, tables
from sb3_tdc.experiments.groups import group_runs
from sb3_tdc.experiments.results import find_runs
from sb3_tdc.experiments.suites import LAMBDA
from sb3_tdc.experiments.variants import compare_settings, compare_variants
from tests.helpers.run_folders import make_run


def make_runs(folder, late, algo="tdc", **config):
    """
    Make one run for each seed.

    :param late: for each seed, both evaluations in the last third; the earlier ones, −999, do not count
    """
    for seed, (one, other) in enumerate(late, 1):
        make_run(folder, algo, seed=seed, returns=((-999.0,), (-999.0,), (one,), (other,)), **config)


def compare(folder):
    found = compare_variants(group_runs(find_runs(folder)[0]))
    return {(c.variant.label, c.control.label): c for c in found}


def test_holm_by_hand():
    # Sorted: 0.01·3, 0.02·2 and 0.04·1, none below the one before it
    found = statistics.holm(np.array([0.04, 0.01, np.nan, 0.02]))
    np.testing.assert_allclose(found, [0.04, 0.03, np.nan, 0.04])
    assert statistics.holm(np.array([0.9, 0.8])).tolist() == [1, 1]


@given(st.lists(st.floats(0, 1), min_size=1, max_size=10))
def test_holm_s_rejections_are_those_of_its_definition(p_values):
    corrected = statistics.holm(np.array(p_values))
    rejected = 0
    for k, p in enumerate(sorted(p_values)):
        if p * (len(p_values) - k) >= 0.05:
            break
        rejected += 1
    assert (corrected < 0.05).sum() == rejected


def test_each_variant_has_a_control_that_differs_in_one_thing(tmp_path):
    for lam in (0.0, 0.5, "lin_1.0"):
        make_runs(tmp_path, [(1.0, 2.0), (2.0, 3.0)], lam=lam)
    for algo in ("tdc-shift", "tdc-auto", "tdc-pessimism"):
        make_runs(tmp_path, [(1.0, 2.0), (2.0, 3.0)], algo=algo, lam=0.5)
    make_runs(tmp_path, [(1.0, 2.0), (2.0, 3.0)], algo="tdc-kappa", lam=0.5, tau=0.3)  # no control with this τ
    make_runs(tmp_path, [(1.0, 2.0), (2.0, 3.0)], algo="td3")
    found = compare_variants(group_runs(find_runs(tmp_path)[0]))
    pairs = {tuple((group.algo, group.setting("lam")) for group in (c.variant, c.control)) for c in found}
    assert pairs == {
        (("tdc", 0.5), ("tdc", 0.0)),
        (("tdc", "lin_1.0"), ("tdc", 0.0)),
        (("tdc-shift", 0.5), ("tdc", 0.5)),
        (("tdc-auto", 0.5), ("tdc", 0.0)),
        (("tdc-pessimism", 0.5), ("tdc-auto", 0.5)),
    }


def test_the_suite_has_a_control_for_each_of_its_variants(tmp_path):
    for cell in LAMBDA["lambda"]:
        for seed in (1, 2):
            make_run(tmp_path, cell.algo, cell.env_id, seed=seed, n_timesteps=400, returns=((seed,),), **cell.settings)
    found = compare_variants(group_runs(find_runs(tmp_path)[0]))
    pairs = {(c.control.conditions.env_id, c.variant.algo, c.variant.setting("lam"), c.control.algo) for c in found}
    of_tdc = [("tdc", 0.5), ("tdc", 1.0), ("tdc-auto", 1.0), ("tdc-shift", 1.0), ("tdc-kappa", 1.0)]
    expected = [*((*variant, "tdc") for variant in of_tdc), ("tdc-pessimism", 1.0, "tdc-auto")]
    assert pairs == {(task, *each) for task in ("Hopper-v4", "HalfCheetah-v4") for each in expected}


def test_the_difference_of_late_evaluations(tmp_path):
    make_runs(tmp_path, [(99.0, 101.0), (109.0, 111.0), (90.0, 90.0)], lam=0.5)
    make_runs(tmp_path, [(10.0, 10.0), (20.0, 20.0), (0.0, 0.0)], lam=0.0)
    (found,) = compare(tmp_path).values()
    # Welch: s²/n = 100/3 on both sides, ν = 4
    half = stats.t.ppf(0.975, 4) * np.sqrt(200 / 3)
    assert found.difference == pytest.approx((90, 90 - half, 90 + half))
    assert found.p == pytest.approx(2 * stats.t.sf(90 / np.sqrt(200 / 3), 4))
    assert found.verdict == "better"
    row = tables.make_comparisons_table(compare_variants(group_runs(find_runs(tmp_path)[0]))).to_dict("records")[0]
    assert row["Variant"] == "TDC, λ 0.5: 100 ± 10 (3 seeds)"
    assert row["Difference"] == f"90 [{90 - half:.1f}, {90 + half:.0f}]"


def test_many_variants_need_more(tmp_path):
    make_runs(tmp_path, [(0.0, 0.0), (10.0, 10.0), (20.0, 20.0)], lam=0.0)
    for lam in (0.25, 0.5, 0.75, 1.0):
        make_runs(tmp_path, [(25.0, 25.0), (35.0, 35.0), (45.0, 45.0)], lam=lam)
    found = compare(tmp_path)
    assert len(found) == 4
    alone = 2 * stats.t.sf(25 / np.sqrt(200 / 3), 4)
    assert alone < 0.05
    assert {c.verdict for c in found.values()} == {"undecided"}
    assert {round(c.p, 6) for c in found.values()} == {round(4 * alone, 6)}


def test_a_variant_may_be_worse(tmp_path):
    make_runs(tmp_path, [(10.0, 10.0), (20.0, 20.0), (0.0, 0.0)], lam=0.5)
    make_runs(tmp_path, [(99.0, 101.0), (109.0, 111.0), (90.0, 90.0)], lam=0.0)
    (found,) = compare(tmp_path).values()
    assert found.verdict == "worse"


def test_variants_of_another_length_are_counted_for_themselves(tmp_path):
    for steps in (1000, 400):
        of_length = {"n_timesteps": steps, "steps": steps}
        make_runs(tmp_path, [(0.0, 0.0), (10.0, 10.0), (20.0, 20.0)], lam=0.0, **of_length)
        make_runs(tmp_path, [(25.0, 25.0), (35.0, 35.0), (45.0, 45.0)], lam=0.5, **of_length)
    found = compare_variants(group_runs(find_runs(tmp_path)[0]))
    alone = 2 * stats.t.sf(25 / np.sqrt(200 / 3), 4)
    assert [c.p for c in found] == pytest.approx([alone, alone])


def test_ablations_are_drawn_next_to_their_control(tmp_path):
    pytest.importorskip("matplotlib")
    make_runs(tmp_path / "logs", [(1.0, 2.0), (2.0, 3.0)])
    make_runs(tmp_path / "logs", [(1.0, 2.0)], algo="tdc-shift")
    make_runs(tmp_path / "logs", [(1.0, 2.0)], algo="sac")
    groups = group_runs(find_runs(tmp_path / "logs")[0])
    report = sections.Report(groups, tmp_path / "report")
    (picture,) = report.lambda_sweep().pictures
    assert picture.name == f"variant-1-{groups[0].conditions.file_name}"
    assert "TDC: 2 (1, 2); TDC-SHIFT: 1 (1)." in picture.caption
    (picture,) = report.learning_curves().pictures
    assert "TDC: 2 (1, 2); SAC: 1 (1)." in picture.caption


def test_one_seed_decides_nothing(tmp_path):
    make_runs(tmp_path, [(1.0, 1.0)], lam=0.5)
    make_runs(tmp_path, [(0.0, 0.0)], lam=0.0)
    (found,) = compare(tmp_path).values()
    assert (found.difference[0], found.verdict) == (1, "undecided: too few seeds")


@pytest.mark.filterwarnings("error")
def test_runs_without_late_evaluations_are_not_said_to_be_too_few(tmp_path):
    for seed in (1, 2):
        run = make_run(tmp_path, seed=seed, lam=0.5, returns=((3.0,), (4.0,)))
        np.savez(run.path / "evaluations.npz", timesteps=[300, 600], results=[[3.0], [4.0]])  # of 1,000 steps
    make_runs(tmp_path, [(1.0, 1.0), (3.0, 3.0)], lam=0.0)
    (row,) = tables.make_comparisons_table(compare_variants(group_runs(find_runs(tmp_path)[0]))).to_dict("records")
    assert row["Variant"] == "TDC, λ 0.5: – (0 seeds)"
    assert row["Control"].endswith("2 ± 1.4 (2 seeds)")
    assert (row["Difference"], row["p"]) == ("–", "–")
    assert row["Verdict"] == "undecided: no evaluation in the last third"


@pytest.mark.filterwarnings("ignore:Precision loss")
def test_equal_returns_decide_nothing(tmp_path):
    for lam in (0.5, 0.0):
        make_runs(tmp_path, [(7.0, 7.0), (7.0, 7.0), (7.0, 7.0)], lam=lam)
    (found,) = compare(tmp_path).values()
    assert (found.difference[0], found.verdict) == (0, "undecided")


def test_a_schedule_has_its_curve_next_to_the_numbers(tmp_path):
    pytest.importorskip("matplotlib")
    for lam in (0.0, 0.5, "lin_1.0"):
        make_runs(tmp_path / "logs", [(1.0, 2.0), (2.0, 3.0)], lam=lam)
    groups = group_runs(find_runs(tmp_path / "logs")[0])
    section = sections.Report(groups, tmp_path / "report").lambda_sweep()
    where = groups[0].conditions.file_name
    assert [picture.name for picture in section.pictures] == [f"lambda-curves-1-{where}", f"lambda-sweep-1-{where}"]
    assert "λ = lin_1.0: 2 (1, 2)" in section.pictures[0].caption
    assert (tmp_path / "report" / "tables" / "variants.csv").is_file()


def test_other_settings_are_compared_with_those_of_the_file(tmp_path):
    """λ alone and the head alone are compared elsewhere; without a control nothing is compared."""
    late = [(1.0, 2.0), (2.0, 3.0), (4.0, 9.0)]
    for algo, config in (
        ("tdc", {}),
        ("tdc", {"lam": 0.0}),
        ("tdc", {"stochastic_actor": True}),
        ("tdc", {"kappa": 10.0}),
        ("tdc", {"learning_rate": 3e-4, "qf_learning_rate": 3e-4}),
        ("tdc", {"lam": 0.0, "kappa": 10.0}),
        ("td3", {}),
        ("td3", {"learning_starts": 25_000}),
        ("sac", {"tau": 0.5}),
        ("tdc", {"args": {"env_kwargs": {"healthy_reward": 9}}}),  # another task
        ("tdc", {"args": {"trained_agent": "old.zip"}, "kappa": 10.0}),  # trained before
        ("tdc", {"env_wrapper": "gymnasium.wrappers.FlattenObservation", "kappa": 10.0}),
    ):
        make_runs(tmp_path, late, algo, **config)
    make_runs(tmp_path, late, "tdc", kappa=10.0, env_id="Walker2d-v4")
    found = compare_settings(group_runs(find_runs(tmp_path)[0]))
    assert {(c.variant.label, c.control.label) for c in found} == {
        ("TDC, kappa 10", "TDC"),
        ("TDC, learning_rate 0.0003, qf_learning_rate 0.0003", "TDC"),
        ("TDC, λ 0, kappa 10", "TDC"),
        ("TD3, learning_starts 25,000", "TD3, learning_starts 100"),
    }


def test_other_settings_are_compared_with_the_same_warm_up(tmp_path):
    """The matrix has shortened the warm-up of some runs, 5,000 steps, to 100: a difference that is not κ's."""
    late = [(1.0, 2.0), (2.0, 3.0)]
    make_runs(tmp_path, [*late, (9.0, 9.0)], learning_starts=5000)
    make_runs(tmp_path, late)
    make_runs(tmp_path, late, kappa=10.0)
    make_runs(tmp_path, late, kappa=20.0, learning_starts=5000)
    make_runs(tmp_path, late, kappa=40.0, args={"eval_freq": 7})  # how it is evaluated may differ
    found = compare_settings(group_runs(find_runs(tmp_path)[0]))
    of = {c.variant.setting("kappa"): (c.control.setting("learning_starts"), c.difference[0]) for c in found}
    assert of == {10.0: (100, 0), 20.0: (5000, pytest.approx(2 - 13 / 3)), 40.0: (100, 0)}


def test_algorithms_of_other_packages_are_compared_with_nothing(tmp_path):
    make_runs(tmp_path, [(1.0, 2.0)], "a2c", n_steps=5)
    make_runs(tmp_path, [(1.0, 2.0)], "a2c", n_steps=7)
    groups = group_runs(find_runs(tmp_path)[0])
    assert compare_settings(groups) == compare_variants(groups) == []


def test_other_settings_are_in_the_report(tmp_path):
    pytest.importorskip("matplotlib")
    make_runs(tmp_path / "logs", [(1.0, 2.0), (2.0, 3.0)])
    make_runs(tmp_path / "logs", [(5.0, 6.0)], kappa=10.0)
    groups = group_runs(find_runs(tmp_path / "logs")[0])
    report = sections.Report(groups, tmp_path / "report")
    section = report.other_settings()
    (picture,), ((_, table),) = section.pictures, section.tables
    assert "TDC: 2 (1, 2); TDC, kappa 10: 1 (1)." in picture.caption
    assert table["Variant"].tolist() == ["TDC, kappa 10: 5.5 (1 seed)"]
    assert report.lambda_sweep().tables == []


def test_figures_of_variants_and_of_settings_have_names_of_their_own(tmp_path):
    """Even with many settings: a file name has at most 255 bytes."""
    pytest.importorskip("matplotlib")
    many = {"learning_rate": 1e-3, "qf_learning_rate": 2e-3, "buffer_size": 1234, "batch_size": 123, "gamma": 0.123}
    many |= {"target_policy_noise": 0.123, "target_noise_clip": 0.456, "gradient_steps": 3, "policy_delay": 3}
    many |= {
        "kappa": 123.0,
        "learning_starts": 123,
        "target_entropy": -1.23,
        "noise_std": 0.123,
        "ent_coef": "auto_0.1",
    }
    for algo in ("tdc", "tdc-shift"):
        for config in ({}, {"tau": 0.3}, many):
            make_runs(tmp_path / "logs", [(1.0, 2.0)], algo, **config)
    report = sections.Report(group_runs(find_runs(tmp_path / "logs")[0]), tmp_path / "report")
    names = [
        picture.name for section in (report.lambda_sweep(), report.other_settings()) for picture in section.pictures
    ]
    assert len(names) == 7  # three of tdc-shift next to tdc; two settings of each
    assert len({*names}) == 7
    assert all((tmp_path / "report" / "figures" / f"{name}.png").is_file() for name in names)


def test_other_settings_by_scipy(tmp_path):
    make_runs(tmp_path, [(1.0, 3.0), (2.0, 6.0), (5.0, 7.0)])
    make_runs(tmp_path, [(11.0, 13.0), (12.0, 14.0), (14.0, 18.0)], kappa=10.0)
    make_runs(tmp_path, [(4.0, 4.0), (2.0, 9.0), (5.0, 3.0)], kappa=100.0)
    found = {c.variant.setting("kappa"): c for c in compare_settings(group_runs(find_runs(tmp_path)[0]))}
    control = [2.0, 4.0, 6.0]  # means of the two late evaluations
    p = {10: stats.ttest_ind([12.0, 13.0, 16.0], control, equal_var=False).pvalue}
    p[100] = stats.ttest_ind([4.0, 5.5, 4.0], control, equal_var=False).pvalue
    assert p[10] < p[100]
    assert found[10].p == pytest.approx(2 * p[10])  # Holm: the smaller of two
    assert found[100].p == pytest.approx(p[100])
    assert found[10].difference[0] == pytest.approx(41 / 3 - 4)
    assert (found[10].verdict, found[100].verdict) == ("better", "undecided")


def test_an_algorithm_has_one_colour_in_all_figures():
    def colors(*labels):
        return dict(zip(labels, figures.colors_of(labels), strict=True))

    few = colors("TDC, λ 0", "TDC-AUTO, λ 1", "TDC-KAPPA, λ 1")
    many = colors("TDC", "TDC, λ 0", "TDC-AUTO", "TDC-SHIFT", "TDC-PESSIMISM", "TDC-KAPPA")
    assert few["TDC-AUTO, λ 1"] == many["TDC-AUTO"]
    assert few["TDC-KAPPA, λ 1"] == many["TDC-KAPPA"]
    assert colors("TD3", "ADVB_SAC")["ADVB_SAC"] == colors("ADVB_SAC", "ADVB_TD3")["ADVB_SAC"]
    assert len(set(many.values())) == len(many)
    assert len(set(colors("TDC", "TDC, λ 0", "TDC, λ 1", "TDC-AUTO", "MEOW", "TD3", "SAC").values())) == 7
