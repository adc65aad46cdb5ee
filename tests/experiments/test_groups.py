"""Which runs may be averaged as a group, and which groups may be compared."""

import numpy as np
import pytest

from sb3_tdc.experiments.groups import (
    as_shipped,
    by_conditions,
    describe,
    differences,
    group_runs,
    is_as_shipped,
    shared_differences,
    vary,
)
from sb3_tdc.experiments.provenance import list_unfinished
from sb3_tdc.experiments.results import find_runs
from tests.helpers.run_folders import NETWORKS, make_run


def labels(folder):
    return [(group.label, [run.seed for run in group.runs]) for group in group_runs(find_runs(folder)[0])]


def test_only_seeds_are_put_together(tmp_path):
    for seed in (2, 1, 3):
        make_run(tmp_path, seed=seed)
    make_run(tmp_path, seed=1, lam=0.5)
    make_run(tmp_path, seed=1, stochastic_actor=True)
    make_run(tmp_path, seed=1, policy_kwargs={**NETWORKS, "n_quantiles": 8})
    make_run(tmp_path, seed=1, args={"env_kwargs": {"reset_noise_scale": 0.0}})
    make_run(tmp_path, algo="td3", seed=1)
    assert labels(tmp_path) == [
        ("TDC", [1, 2, 3]),
        ("TDC, env_kwargs.reset_noise_scale 0", [1]),
        ("TDC, n_quantiles 8", [1]),
        ("TDC, stochastic head", [1]),
        ("TDC, λ 0.5", [1]),
        ("TD3", [1]),
    ]


def test_what_is_said_and_what_is_the_default_are_the_same(tmp_path):
    make_run(tmp_path, seed=1)
    make_run(tmp_path, seed=2, gamma=0.99, stochastic_actor=False)  # the constructor's defaults
    make_run(tmp_path, seed=3, kappa=1)  # not 1.0, but the same
    assert labels(tmp_path) == [("TDC", [1, 2, 3])]


def test_a_repetition_is_no_other_seed(tmp_path):
    make_run(tmp_path, seed=1, returns=((1.0,),))
    make_run(tmp_path, seed=1, returns=((2.0,),))
    make_run(tmp_path, seed=1, returns=((3.0,),), steps=None)
    (group,) = group_runs(find_runs(tmp_path)[0])
    (run,) = group.runs
    assert run.evaluations.returns.tolist() == [[2.0]]  # the last finished one


def test_only_finished_runs_count(tmp_path):
    make_run(tmp_path, seed=1)
    make_run(tmp_path, seed=2, steps=400)
    make_run(tmp_path, seed=3, steps=None)
    (group,) = group_runs(find_runs(tmp_path)[0])
    assert [run.steps for run in group.runs] == [1000, 400, 500]
    assert group.seeds == "1 (1)"


def test_ablations_differ_in_one_setting_alone(tmp_path):
    make_run(tmp_path, lam=1.0)
    make_run(tmp_path, lam=0.25)
    make_run(tmp_path, lam=0.25, kappa=2.0)
    make_run(tmp_path, env_id="Ant-v4", lam=0.5)
    groups = group_runs(find_runs(tmp_path)[0])
    assert [[group.setting("lam") for group in some] for some in vary(groups, "lam")] == [[0.25, 1.0]]
    assert [[group.setting("kappa") for group in some] for some in vary(groups, "kappa")] == [[1.0, 2.0]]
    assert vary(groups, "stochastic_actor") == []


def test_what_differs_from_the_hyperparameter_file_is_named(tmp_path):
    make_run(tmp_path, lam=0.5, learning_starts=100)
    (run,), _ = find_runs(tmp_path)
    text = describe(differences(run))
    assert "steps 1,000" in text
    assert "λ 0.5" in text
    assert "learning_starts 100" in text
    assert "learning_rate" not in text
    assert "gamma" not in text


def test_a_run_that_a_callback_ended_is_finished_for_all_but_not_averaged(tmp_path):
    """``train.py`` marks its finished runs; their number of steps matters only for averages."""
    folder = make_run(tmp_path, steps=400, args={"resume_freq": 100})
    assert not find_runs(tmp_path)[0][0].is_finished
    folder.mark_finished(400)
    (run,), _ = find_runs(tmp_path)
    assert (run.is_finished, run.folder.is_finished, run.steps, run.n_timesteps) == (True, True, 400, 1000)
    (group,) = group_runs([run])
    assert group.finished == ()
    (row,) = list_unfinished([run], []).to_dict("records")
    assert (row["Steps"], row["Why"]) == (
        "400 of 1,000",
        "finished early: a callback ended it, or n_timesteps was edited afterwards",
    )


def test_runs_with_other_contacts_are_not_averaged(tmp_path):
    for seed, mujoco in ((1, "3.4.0"), (2, "4.0.0"), (3, "3.5.1"), (4, "3.2.7")):
        run = make_run(tmp_path, seed=seed, returns=((1.0,),))
        (run.path / run.env_name / "versions.yml").write_text(f"mujoco: {mujoco}\n")
    groups = {(g.label, g.conditions.mujoco): g.seeds for g in group_runs(find_runs(tmp_path)[0])}
    assert groups == {("TDC", "before 3.5"): "2 (1, 4)", ("TDC", "since 3.5"): "2 (2, 3)"}


@pytest.mark.parametrize("env_id", ["HopperBulletEnv-v0", "Isaac-Repose-Cube-Allegro-v0", "Pendulum-v1"])
def test_mujoco_matters_to_its_own_tasks_alone(tmp_path, env_id):
    for seed, mujoco in ((1, "3.4.0"), (2, "4.0.0")):
        run = make_run(tmp_path, env_id=env_id, seed=seed)
        (run.path / run.env_name / "versions.yml").write_text(f"mujoco: {mujoco}\n")
    (group,) = group_runs(find_runs(tmp_path)[0])
    assert group.seeds == "2 (1, 2)"


def test_what_is_compared_has_one_length(tmp_path):
    for steps in (1000, 400):
        make_run(tmp_path, n_timesteps=steps, steps=steps)
        make_run(tmp_path, n_timesteps=steps, steps=steps, lam=0.0)
    found = by_conditions(group_runs(find_runs(tmp_path)[0]))
    assert [(conditions.n_timesteps, [g.label for g in groups]) for conditions, groups in found.items()] == [
        (400, ["TDC", "TDC, λ 0"]),
        (1000, ["TDC", "TDC, λ 0"]),
    ]


def test_as_shipped_whatever_the_length(tmp_path):
    warm_ups = ({"learning_starts": 5000}, {"learning_starts": 100}, {"learning_starts": 99})
    for seed, changed in enumerate((*warm_ups, {"kappa": 2.0})):
        make_run(tmp_path, seed=seed, **changed)
    make_run(tmp_path, seed=4, args={"eval_freq": 7, "eval_episodes": 1})
    found = {run.seed: is_as_shipped(run) for run in find_runs(tmp_path)[0]}
    assert found == {0: True, 1: True, 2: False, 3: False, 4: True}
    other = next(run for run in find_runs(tmp_path)[0] if run.seed == 3)
    assert is_as_shipped(other, but={"kappa"})


def test_algorithms_are_shown_with_the_same_kind_of_warm_up(tmp_path):
    """Two of three algorithms have a shortened one, 100 steps: so is TDC's, although it has more seeds without."""
    for seed in (1, 2, 3):
        make_run(tmp_path, seed=seed, learning_starts=5000)
    for algo in ("tdc", "td3", "sac"):
        make_run(tmp_path, algo)

    def shown():
        groups = group_runs(find_runs(tmp_path)[0])
        return {group.algo: group.setting("learning_starts") for group in as_shipped(groups)}

    assert shown() == {"tdc": 100, "td3": 100, "sac": 100}
    make_run(tmp_path, "td3", learning_starts=5000)
    make_run(tmp_path, "sac", learning_starts=5000)
    assert shown() == {"tdc": 5000, "td3": 5000, "sac": 5000}


def test_groups_of_a_task_have_different_names(tmp_path):
    for args, warm_up in (({"eval_freq": 7}, 100), ({}, 5000), ({"eval_freq": 7}, 5000)):
        make_run(tmp_path, lam=0.0, learning_starts=warm_up, args=args)
        make_run(tmp_path, learning_starts=warm_up, args=args)
    names = [group.name for group in group_runs(find_runs(tmp_path)[0])]
    assert len(set(names)) == 6
    assert "TDC, λ 0, learning_starts 100, eval_freq 7" in names


def test_what_all_of_an_algorithm_have_is_said_once(tmp_path):
    for lam in (0.0, 0.5):
        make_run(tmp_path, lam=lam, tau=0.25)
    make_run(tmp_path, algo="td3", batch_size=7)
    groups = group_runs(find_runs(tmp_path)[0])
    said = shared_differences(groups)
    assert "tau 0.25" in said
    assert "λ" not in said
    assert "all TD3: " in said
    assert "batch_size 7" in said
    assert "steps" not in said


def test_a_run_whose_hyperparameters_were_changed_is_another_experiment(tmp_path):
    make_run(tmp_path, seed=1, lam=0.5)
    changed = make_run(tmp_path, seed=2, lam=0.5)
    (changed.path / changed.env_name / "changes.yml").write_text("changes:\n- {step: 100, lam: 0.5}\n")
    assert sorted(group.seeds for group in group_runs(find_runs(tmp_path)[0])) == ["1 (1)", "1 (2)"]


def test_of_two_runs_of_one_seed_the_later_one_counts_after_nine_too(tmp_path):
    for i in range(1, 12):
        make_run(tmp_path, seed=1, returns=((float(i),),))
    (group,) = group_runs(find_runs(tmp_path)[0])
    assert group.runs[0].folder.path.name == "Hopper-v4_11"


def test_a_longer_warm_up_is_not_as_shipped(tmp_path):
    make_run(tmp_path, n_timesteps=300_000, learning_starts=30_000)  # in hyperparams/: 5,000
    (group,) = group_runs(find_runs(tmp_path)[0])
    assert not group.is_as_shipped
    assert group.name == "TDC, learning_starts 30,000"
    assert group.label == "TDC"  # there is no other to tell it from


def test_a_repetition_that_ended_early_replaces_nothing(tmp_path):
    make_run(tmp_path, seed=1, args={"resume_freq": 100}, returns=((1.0,),)).mark_finished(1000)
    make_run(tmp_path, seed=1, args={"resume_freq": 100}, returns=((2.0,),), steps=400).mark_finished(400)
    (group,) = group_runs(find_runs(tmp_path)[0])
    assert group.final_returns.tolist() == [1]


def test_physics_that_are_not_known_are_no_known_physics(tmp_path):
    for seed, text in ((1, "mujoco: 3.4.0"), (2, "torch: 2.13.0")):
        run = make_run(tmp_path, seed=seed)
        (run.path / run.env_name / "versions.yml").write_text(text)
    groups = group_runs(find_runs(tmp_path)[0])
    assert {g.conditions.task for g in groups} == {"Hopper-v4", "Hopper-v4, MuJoCo of unknown version"}
    assert len({g.conditions.file_name for g in groups}) == 2


def test_no_late_evaluation_is_no_late_return(tmp_path):
    for seed, (steps, returns) in enumerate((((300,), ((1.0,),)), ((300, 1000), ((1.0,), (5.0,)))), 1):
        run = make_run(tmp_path, seed=seed)
        np.savez(run.path / "evaluations.npz", timesteps=steps, results=returns)
    (group,) = group_runs(find_runs(tmp_path)[0])
    assert len(group.finished) == 2
    assert group.late_returns.tolist() == [5]
