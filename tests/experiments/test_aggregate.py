"""Scores over tasks, of folders made by hand."""

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
    shipped, _ = read_entry(hyperparams_file(algo), env_id)
    for seed, final in enumerate(finals, 1):
        config = {**shipped, "n_timesteps": steps, "learning_starts": steps // 10}
        make_run(folder, algo, env_id, seed=seed, steps=steps, returns=((final,),), **config)


def test_scores_over_tasks_need_two_seeds_of_everything(tmp_path):
    for env_id in ("Hopper-v4", "Walker2d-v4"):
        make_shipped(tmp_path, "tdc", env_id, (10, 20))
        make_shipped(tmp_path, "sac", env_id, (0, 10))
        make_shipped(tmp_path, "sac", env_id, (500, 600), steps=400)  # of another length
    make_shipped(tmp_path, "td3", "Hopper-v4", (1, 2))
    make_shipped(tmp_path, "td3", "Walker2d-v4", (1,))  # one seed
    (found,) = aggregate.aggregate(read_groups(tmp_path))
    assert (found.length, found.env_ids, found.left_out) == ("1,000 steps", ("Hopper-v4", "Walker2d-v4"), ("TD3",))
    # Returns 10 and 20 against 0 and 10
    assert {label: [s.tolist() for s in scores] for label, scores in found.scores.items()} == {
        "TDC": [[0.5, 1], [0.5, 1]],
        "SAC": [[0, 0.5], [0, 0.5]],
    }
    assert [point for point, _, _ in found.intervals()] == [0.75, 0.25]
    picture = sections.Report(read_groups(tmp_path), tmp_path / "report").returns_section().pictures[0]
    assert "Not on all of these tasks with two seeds: TD3" in picture.caption


def test_full_length_is_one_length_whatever_the_task(tmp_path):
    for env_id in ("Hopper-v4", "Walker2d-v4"):
        for algo in ("tdc", "sac"):
            steps = read_entry(hyperparams_file(algo), env_id)[0]["n_timesteps"]
            config = {**read_entry(hyperparams_file(algo), env_id)[0]}
            for seed in (1, 2):
                make_run(tmp_path, algo, env_id, seed=seed, steps=steps, returns=((1.0,),), **config)
    (found,) = aggregate.aggregate(read_groups(tmp_path))
    assert found.length == aggregate.FULL


@given(st.dictionaries(st.sampled_from("abcd"), st.lists(st.sampled_from("uvwxyz"), unique=True), max_size=4))
def test_algorithms_are_chosen_that_share_two_tasks(tasks):
    labels, common = aggregate.choose(tasks)
    assert all(set(common) <= set(tasks[label]) for label in labels)
    assert (len(labels) >= 2 and len(common) >= 2) or (labels, common) == ([], ())
    if len(tasks) == 2:
        assert bool(labels) == (len(set.intersection(*map(set, tasks.values()))) > 1)
