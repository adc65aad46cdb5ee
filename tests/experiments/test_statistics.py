"""Numbers of tables and figures, on arrays whose results can be worked out by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sb3_tdc.experiments import statistics as s

RETURNS = st.floats(-1e4, 1e4).map(lambda x: round(x, 3))


def test_a_bin_ends_with_its_edge():
    edges = s.bin_edges(50, 20)
    assert edges.tolist() == [0, 20, 40, 60]  # 50 lies in the third
    # 20 belongs to the first bin with 10; 21 and 40 to the second; 61 and 0 to none; the NaN is left out
    steps = np.array([10, 20, 21, 40, 61, 0, 30])
    values = np.array([1.0, 3.0, 5.0, 9.0, 100.0, 100.0, np.nan])
    np.testing.assert_array_equal(s.bin_means(steps, values, edges), [2.0, 7.0, np.nan])


def test_an_evaluation_at_every_edge_is_a_bin_of_its_own():
    steps = np.arange(1, 76) * 20_000
    values = np.random.default_rng(0).normal(size=75)
    np.testing.assert_array_equal(s.bin_means(steps, values, s.bin_edges(1_500_000, 20_000)), values)


@given(arrays(float, st.integers(1, 30), elements=RETURNS), st.randoms(use_true_random=False))
def test_the_order_of_evaluations_does_not_matter(values, random):
    steps = np.arange(1, len(values) + 1) * 7
    order = list(range(len(values)))
    random.shuffle(order)
    edges = s.bin_edges(int(steps[-1]), 10)
    np.testing.assert_allclose(
        s.bin_means(steps[order], values[order], edges), s.bin_means(steps, values, edges), rtol=1e-9, atol=1e-9
    )


def test_edges_need_steps():
    for last_step, width in ((0, 10), (10, 0)):
        with pytest.raises(ValueError, match="at least 1"):
            s.bin_edges(last_step, width)


def test_interval_of_three_seeds_by_hand():
    # mean 4, sample variance ((−2)² + 0 + 2²)/2 = 4, standard error 2/√3; the 97.5 % point of t with 2 degrees of
    # freedom is 4.302653 (any table)
    mean, low, high = s.mean_interval(np.array([[2.0], [4.0], [6.0]]))
    half = 4.302653 * 2 / np.sqrt(3)
    np.testing.assert_allclose([mean[0], low[0], high[0]], [4, 4 - half, 4 + half], rtol=1e-6)


def test_there_is_no_interval_of_one_seed():
    # two runs in the first bin, one in the second, none in the third
    mean, low, high = s.mean_interval(np.array([[1.0, 5.0, np.nan], [3.0, np.nan, np.nan]]))
    np.testing.assert_array_equal(mean, [2.0, 5.0, np.nan])
    assert np.isfinite([low[0], high[0]]).all()
    assert np.isnan([low[1:], high[1:]]).all()
    assert np.isnan(s.spread(np.array([3.0])))
    assert np.isnan(s.iqm_interval([np.array([3.0])])).all()
    assert np.isnan(s.iqm_interval([np.array([3.0, 4.0]), np.array([1.0])])).all()


@given(arrays(float, st.tuples(st.integers(2, 6), st.integers(1, 4)), elements=RETURNS), st.floats(-100, 100))
def test_intervals_hold_the_mean_move_along_and_know_no_order(values, shift):
    mean, low, high = s.mean_interval(values)
    assert (low <= mean).all()
    assert (mean <= high).all()
    np.testing.assert_allclose(s.mean_interval(values[::-1]), (mean, low, high), atol=1e-6)
    np.testing.assert_allclose(s.mean_interval(values + shift), np.add((mean, low, high), shift), atol=1e-6)


def test_t_intervals_cover_as_often_as_they_say():
    values = np.random.default_rng(1).normal(3.0, 2.0, size=(3, 20_000))
    _, low, high = s.mean_interval(values)
    assert ((low <= 3.0) & (high >= 3.0)).mean() == pytest.approx(0.95, abs=0.006)


def test_returns_of_one_run():
    steps, returns = np.array([10, 20, 40]), np.array([[0.0, 2.0], [9.0, 11.0], [3.0, 5.0]])  # means 1, 10, 4
    assert s.final_return(returns) == 4
    assert s.best_return(returns) == 10
    # trapezoids: 10·(1 + 10)/2 + 20·(10 + 4)/2 = 55 + 140, over 30 steps
    assert s.area_under_curve(steps, returns) == pytest.approx(195 / 30)
    assert s.area_under_curve(steps[:1], returns[:1]) == 1
    assert s.spread(np.array([2.0, 4.0, 6.0])) == pytest.approx(2.0)


def test_interquartile_mean_drops_a_quarter_on_either_side():
    assert s.interquartile_mean(np.array([-100.0, 1.0, 3.0, 100.0])) == 2
    assert s.interquartile_mean(np.array([0.0, 1.0, 8.0])) == 3  # a quarter of three rounds down to none
    # Over tasks, all scores are one pool: of 0, 0, 1, 2, 3, 9, 9, 9 the middle four
    assert s.interquartile_mean(np.array([0.0, 9.0, 1.0, 9.0]), np.array([3.0, 0.0, 9.0, 2.0])) == (1 + 2 + 3 + 9) / 4


def test_bootstrap_resamples_seeds_within_tasks():
    # Each task is constant: whichever seeds are drawn, four scores of 0 and four of 1 stay, and their IQM is 0.5.
    # Drawn across tasks, the numbers of 0 and 1 would vary
    assert s.iqm_interval([np.zeros(4), np.ones(4)]) == (0.5, 0.5)
    scores = [np.array([0.0, 1.0, 2.0, 3.0]), np.array([5.0, 6.0])]  # tasks may differ in their number of seeds
    low, high = s.iqm_interval(scores, seed=3)
    assert 0 <= low < s.interquartile_mean(*scores) < high <= 6
    assert s.iqm_interval(scores, seed=3) == (low, high)


@given(st.lists(RETURNS, min_size=2, max_size=6), st.lists(RETURNS, min_size=2, max_size=6), st.floats(0.1, 10))
def test_scores_keep_the_order_and_know_no_unit(a, b, unit):
    returns = {"a": np.array(a), "b": np.array(b)}
    scores = s.normalise_scores(returns)
    pooled = np.concatenate(list(scores.values()))
    if len({*a, *b}) == 1:
        assert (pooled == 0.5).all()
        return
    assert pooled.min() == 0
    assert pooled.max() == pytest.approx(1)
    scaled = s.normalise_scores({name: unit * r - 5 for name, r in returns.items()})
    for name in returns:
        np.testing.assert_array_less(-1e-9, np.diff(scores[name][np.argsort(returns[name])]))
        if np.ptp([*a, *b]) > 1e-2:
            np.testing.assert_allclose(scaled[name], scores[name], atol=1e-6)
