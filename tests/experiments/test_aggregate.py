"""Scores over tasks, from run folders made by hand."""

import itertools

from hypothesis import given
from hypothesis import strategies as st

from sb3_tdc.experiments import aggregate, sections
from sb3_tdc.experiments.groups import group_runs
from sb3_tdc.experiments.results import find_runs
from sb3_tdc.hyperparams import hyperparams_file, read_entry
from tests.helpers.run_folders import make_run


def read_groups(folder):
    return group_runs(find_runs(folder)[0])


def make_shipped(folder, algo, env_id, finals, steps=1000):
    for seed, final in enumerate(finals, 1):
        make_run(folder, algo, env_id, seed=seed, steps=steps, returns=((final,),), n_timesteps=steps)


def test_scores_over_tasks_need_two_seeds_of_everything(tmp_path):
    for env_id in ("Hopper-v4", "Walker2d-v4"):
        make_shipped(tmp_path, "tdc", env_id, (10, 20))
        make_shipped(tmp_path, "sac", env_id, (0, 10))
        make_shipped(tmp_path, "sac", env_id, (500, 600), steps=400)  # of another length
    make_shipped(tmp_path, "td3", "Hopper-v4", (1, 2))
    make_shipped(tmp_path, "td3", "Walker2d-v4", (1,))  # one seed
    (found,) = aggregate.aggregate(read_groups(tmp_path))
    assert (found.length, found.env_ids, found.left_out) == (
        "1,000 steps",
        ("Hopper-v4", "Walker2d-v4"),
        ("TD3",),
    )
    # Returns 10 and 20 against 0 and 10
    assert {label: [s.tolist() for s in scores] for label, scores in found.scores.items()} == {
        "TDC": [[0.5, 1], [0.5, 1]],
        "SAC": [[0, 0.5], [0, 0.5]],
    }
    assert [point for point, _, _ in found.intervals()] == [0.75, 0.25]
    picture = sections.Report(read_groups(tmp_path), tmp_path / "report").returns_section().pictures[0]
    assert "Left out, for want of two seeds: TD3." in picture.caption


def test_full_length_is_one_length_whatever_the_task(tmp_path):
    for env_id in ("Hopper-v4", "Walker2d-v4"):
        for algo in ("tdc", "sac"):
            steps = read_entry(hyperparams_file(algo), env_id)[0]["n_timesteps"]
            make_shipped(tmp_path, algo, env_id, (1.0, 1.0), steps)
    (found,) = aggregate.aggregate(read_groups(tmp_path))
    assert found.length == "all steps of hyperparams/"


def test_a_scaled_matrix_is_one_length(tmp_path):
    for algo in ("tdc", "sac"):
        for env_id, steps in (("Hopper-v4", 30_000), ("HalfCheetah-v4", 30_000), ("Walker2d-v4", 80_000)):
            make_shipped(tmp_path, algo, env_id, (1, 2), steps)
    (found,) = aggregate.aggregate(read_groups(tmp_path))  # 2 % of each task's steps; two tasks have equally many
    assert found.length == "2 % of the steps in hyperparams/"
    assert set(found.env_ids) == {"Hopper-v4", "HalfCheetah-v4", "Walker2d-v4"}


def test_each_aggregate_has_its_file(tmp_path):
    for algo in ("tdc", "sac"):
        for env_id in ("Hopper-v4", "Walker2d-v4", "HopperBulletEnv-v0", "AntBulletEnv-v0"):
            make_shipped(tmp_path / "logs", algo, env_id, (1, 2))
    pictures = sections.Report(read_groups(tmp_path / "logs"), tmp_path).returns_section().pictures
    assert len({picture.name for picture in pictures}) == 2
    assert len(list((tmp_path / "tables").glob("aggregate-*.csv"))) == 2


def test_of_several_groups_as_shipped_the_one_with_most_seeds_is_taken(tmp_path):
    make_shipped(tmp_path, "sac", "Hopper-v4", (1, 2))
    make_shipped(tmp_path, "tdc", "Hopper-v4", (10, 20, 30))
    for algo in ("tdc", "sac"):
        make_shipped(tmp_path, algo, "Walker2d-v4", (1, 2))
    for seed in (1, 2):
        make_run(tmp_path, seed=seed, returns=((500.0,),), args={"eval_freq": 7})
    (found,) = aggregate.aggregate(read_groups(tmp_path))
    assert found.groups["TDC"][0].final_returns.tolist() == [10, 20, 30]


TASKS = st.dictionaries(st.sampled_from("abcd"), st.lists(st.sampled_from("uvwxyz"), unique=True), max_size=4)


@given(TASKS)
def test_those_with_the_most_runs_in_common_are_chosen(tasks):
    labels, common = aggregate.choose(tasks)
    assert all(set(common) <= set(tasks[label]) for label in labels)
    for one, other in itertools.combinations(tasks, 2):
        shared = len(set(tasks[one]) & set(tasks[other]))
        assert 2 * shared <= len(labels) * len(common) or shared < 2
    assert (labels, common) == ((), ()) or min(len(labels), len(common)) >= 2


def test_choices_by_hand():
    assert aggregate.choose({"TDC": "ab", "TD3": "ab", "SAC": "cde"}) == (("TDC", "TD3"), ("a", "b"))
    assert aggregate.choose({"TDC": "abcde", "SAC": "abcde", "MEOW": "ab"}) == (("TDC", "SAC"), tuple("abcde"))
    # Six runs either way: more algorithms are preferred to more tasks
    assert aggregate.choose({"TDC": "abc", "SAC": "bca", "MEOW": "ab"}) == (("TDC", "SAC", "MEOW"), ("a", "b"))
    assert aggregate.choose({"TDC": "a", "SAC": "a"}) == ((), ())
