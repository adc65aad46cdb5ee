"""Tables, figures and the page: from folders made by hand, then from real runs."""

import re
import shutil

import markupsafe
import numpy as np
import pytest
import yaml
from matplotlib import figure

from sb3_tdc.cli import evaluate, train
from sb3_tdc.cli import report as report_command
from sb3_tdc.experiments import curves, figures, final_episodes, provenance, report, sections, tables
from sb3_tdc.experiments.groups import group_runs
from sb3_tdc.experiments.results import Run, find_runs
from sb3_tdc.runs.algorithms import KNOWN_ALGORITHMS
from sb3_tdc.runs.trained import TrainedModel
from tests.helpers.run_folders import make_run


def read_groups(folder):
    return group_runs(find_runs(folder)[0])


def test_table_by_hand(tmp_path):
    # finals 2 and 6; bests 2 and 10; areas (0 + 2)/2 and (10 + 6)/2
    make_run(tmp_path, seed=1, returns=((-1.0, 1.0), (1.0, 3.0)))
    make_run(tmp_path, seed=2, returns=((9.0, 11.0), (5.0, 7.0)))
    make_run(tmp_path, seed=3, returns=((50.0, 50.0),), steps=400)  # not finished
    make_run(tmp_path, algo="sac", seed=5, returns=((7.0, 9.0),))
    table = tables.make_returns_table(read_groups(tmp_path)).set_index("algorithm")
    tdc, sac = table.loc["TDC"], table.loc["SAC"]
    assert (tdc.seeds, tdc.steps, tdc.episodes, tdc.test_seeds) == (2, 1000, 2, 0)
    assert (tdc.final_mean, tdc.final_min, tdc.final_max, tdc.best_mean) == (4, 2, 6, 6)
    assert tdc.final_std == pytest.approx(np.sqrt(8))  # ((2 − 4)² + (6 − 4)²)/1
    assert (tdc.area_mean, tdc.final_iqm) == (4.5, 4)
    assert 2 <= tdc.final_iqm_low < tdc.final_iqm_high <= 6
    assert sac.seeds == 1
    assert np.isnan([sac.final_std, sac.final_iqm_low, sac.best_std]).all()
    shown = tables.show_returns(table.reset_index()).set_index("Algorithm")
    assert shown.loc["TDC", "Final"] == "4 ± 2.8"
    assert shown.loc["SAC", "Final"] == "8"
    assert shown.loc["SAC", "IQM [95 %]"] == "–"


def test_what_lam_does_late_in_training(tmp_path):
    for seed, late in ((1, 0.1), (2, 0.3)):
        log = {
            "train/lam": [0.9] * 3,
            "train/lam_changes": [0.9, 0.9, late],
            "train/lowered": [0.0, 0.0, 1000.0 * seed],
            "eval/overestimation": [np.nan, -9.0, -50.0 * seed],
        }
        make_run(tmp_path, seed=seed, lam=0.9, log=log)
    make_run(tmp_path, seed=3, lam=0.9, steps=500, log={"train/lam_changes": [1.0]})  # not finished
    make_run(tmp_path, seed=1, lam=0.5, log={"train/lam": [0.5]})  # from a version that logged nothing else
    make_run(tmp_path, algo="td3", log={"train/critic_loss": [1.0]})
    (row,) = tables.make_lam_table(read_groups(tmp_path)).to_dict("records")
    assert (row["Algorithm"], row["Seeds"]) == ("TDC", 2)
    assert row["Choices changed, %"] == "20 ± 14"  # of 10 and 30
    assert row["Overestimation"] == "−75 ± 35"
    assert row["λ"] == "0.9"  # of all seeds
    assert row["Lowers the target by"] == "1500 ± 710"
    assert "κ" not in row


def test_a_value_of_all_seeds_has_no_deviation(tmp_path):
    for seed in (1, 2, 3):  # the mean of three times 0.1 is not quite 0.1
        make_run(tmp_path, seed=seed, lam=0.1, log={"train/lam": [0.1], "train/lam_changes": [0.1 * seed]})
    (row,) = tables.make_lam_table(read_groups(tmp_path)).to_dict("records")
    assert row["λ"] == "0.1"


def test_numbers_to_read():
    assert tables.number(1234.5) == "1,234"
    assert tables.number(12.34) == "12.3"
    assert tables.number(-3) == "−3"
    assert tables.plus_minus(1000.4, 20.0) == "1,000 ± 20"
    assert tables.plus_minus(5.0, float("nan")) == "5"


def test_published_returns_are_those_of_the_sources(tmp_path):
    make_run(tmp_path, seed=1, returns=((100.0,),))
    table = tables.make_published_table(tables.make_returns_table(read_groups(tmp_path))).set_index("Algorithm")
    assert len(table) == 15 + 1
    assert table.index[:2].tolist() == ["TDC: this report", "TDC-λ: the GeZo-SAC paper"]
    assert table.loc["TDC: this report", ["Hopper", "Ant", "Steps", "Seeds"]].tolist() == ["100", "–", "1,000", "1"]
    tianshou = table.loc["SAC: Tianshou's examples/mujoco"]
    assert (tianshou["HalfCheetah"], tianshou["Steps"], tianshou["Seeds"]) == ("12,139 ± 1,049", "1M", "10")
    assert table.loc["MEOW: MEOW's paper", "Steps"] == "1.5M / 1.5M / 4M / 4M / 5M"
    entries = yaml.safe_load(tables._PUBLISHED.read_text())
    assert all({"source", "how", "version", "seeds", "steps", "returns"} <= set(entry) for entry in entries)


def draw(function, *args, **kwargs):
    axes = figure.Figure().subplots()
    function(axes, *args, **kwargs)
    return axes


def test_a_curve_is_the_mean_of_finished_seeds():
    steps = np.array([10, 20])
    curve = figures.Curve("TDC", "blue", steps, np.array([[1.0, 3.0], [3.0, 7.0]]), np.array([[100.0, np.nan]]))
    axes = draw(figures.draw_curves, [curve], "A", "return")
    lines = [line.get_ydata().tolist() for line in axes.lines]
    assert lines == [[1, 3], [3, 7], [100], [2, 5]]
    assert axes.get_legend_handles_labels()[1] == ["TDC · 2 seeds, 1 unfinished"]


def test_one_seed_has_no_band():
    one = figures.Curve("TDC", "blue", np.array([10, 20]), np.array([[1.0, 3.0]]))
    two = figures.Curve("TD3", "red", np.array([10, 20]), np.array([[1.0, 3.0], [2.0, 5.0]]))
    bands = draw(figures.draw_curves, [one, two], "A", "return").collections
    drawn = [any(np.isfinite(path.vertices).any() for path in band.get_paths()) for band in bands]
    assert drawn == [False, True]


@pytest.mark.parametrize("log", [False, True])
def test_the_axis_fits_what_is_drawn_but_a_huge_interval(log):
    def limits(*seeds):
        curve = figures.Curve("TDC", "blue", np.array([10, 20]), np.exp(seeds) if log else np.array(seeds))
        found = draw(figures.draw_curves, [curve], "A", "return", log=log).get_ylim()
        return np.log(found) if log else found

    assert limits([1.0, 4.0]) == pytest.approx([1 - 0.05 * 3, 4 + 0.05 * 3])  # no interval: just Matplotlib's margin
    # mean 2.5, interval 2.5 ± 12.7 × 1.5: cut at a third of the range of the seeds
    assert limits([1.0, 1.0], [4.0, 4.0]) == pytest.approx([1 - 3 / 3, 4 + 3 / 3])


def test_the_mean_on_a_logarithmic_axis_is_geometric():
    curve = figures.Curve("TDC", "blue", np.array([10]), np.array([[1.0], [100.0]]))
    axes = draw(figures.draw_curves, [curve], "A", "variance", log=True)
    assert axes.lines[-1].get_ydata() == pytest.approx([10])
    assert axes.get_yscale() == "log"


def test_boxes_pool_episodes_and_dots_are_seeds():
    returns = np.array([[0.0, 2.0], [4.0, 10.0]])
    axes = draw(figures.draw_box_plots, ["TDC"], ["blue"], [returns], "A")
    (dots,) = axes.collections
    assert dots.get_offsets().tolist() == [[0, 1], [0, 7]]
    assert any(line.get_ydata().tolist() == [3, 3] for line in axes.lines)  # the median of all four
    assert "2 seeds" in axes.get_xticklabels()[0].get_text()


def test_boxes_of_different_numbers_of_episodes_are_labelled_with_all():
    def label(*episodes):
        returns = [np.arange(2.0 * n).reshape(2, n) for n in episodes]
        colors = ["blue"] * len(episodes)
        return draw(figures.draw_box_plots, [str(n) for n in episodes], colors, returns, "A").get_ylabel()

    assert label(3, 3) == "return of 3 test episodes a run"
    assert label(5, 2) == "return of 2 and 5 test episodes a run"


LONG = "TDC, " + ", ".join(f"policy_kwargs.some_setting_{i} {i / 7}" for i in range(12))


def test_long_labels_leave_the_axes_their_room():
    """At least half of the figure's width and height."""
    curve = figures.Curve(LONG, "blue", np.array([10, 20]), np.array([[1.0, 3.0]]))
    cases = [
        (figures.draw_curves, [curve, curve], "A", "return"),
        (figures.draw_box_plots, [LONG] * 4, ["blue"] * 4, [np.arange(4.0)[None]] * 4, "A"),
        (figures.draw_intervals, [f"{LONG}\n6 runs", "TD3\n6 runs"], ["blue"] * 2, [(0.5, 0.2, 0.8)] * 2, "A", "score"),
    ]
    for function, *args in cases:
        drawn = figure.Figure(figsize=(4.8, 3.4), layout="constrained")
        axes = drawn.subplots()
        function(axes, *args)
        drawn.draw_without_rendering()
        assert axes.get_position().width > 0.5, function
        assert axes.get_position().height > 0.5, function


def test_the_caption_has_the_whole_label(tmp_path):
    make_run(tmp_path, seed=1)
    groups, labels = read_groups(tmp_path), [LONG]
    picture = sections.Report(groups, tmp_path).draw_learning_curves("name", groups, labels, ["blue"])
    assert f"{LONG}: 1 (1)" in picture.caption


def test_bins_scale_with_the_run_but_hold_an_evaluation(tmp_path):
    def width(**kwargs):
        make_run(tmp_path / str(kwargs), **kwargs)
        (group,) = read_groups(tmp_path / str(kwargs))
        return curves.bin_width(group)

    assert width(n_timesteps=1_500_000, args={"eval_freq": 20_000}) == 20_000
    assert width(n_timesteps=1_500_000, args={"eval_freq": 5_000}) == 20_000
    assert width(n_timesteps=150_000, args={"eval_freq": 500}) == 2_000
    assert width(n_timesteps=150_000, args={"eval_freq": 20_000}) == 20_000
    assert width(n_timesteps=150_000, args={"eval_freq": 1_500}) == 1_500  # nearest multiple of 2,000


def test_what_is_missing_is_said(tmp_path, monkeypatch):
    others = {name: algorithm for name, algorithm in KNOWN_ALGORITHMS.items() if name != "meow"}
    monkeypatch.setattr(provenance, "KNOWN_ALGORITHMS", others)
    make_run(tmp_path, seed=1)
    make_run(tmp_path, seed=2, steps=400)
    make_run(tmp_path, seed=4, kappa=3.0)  # not of the paper
    broken = make_run(tmp_path, seed=3)
    (broken.path / "Hopper-v4" / "config.yml").write_text("lam: 0.9")  # no n_timesteps
    runs, unreadable = find_runs(tmp_path)
    page = report.write_report(runs, unreadable, tmp_path / "out").read_text()
    assert "1 (1,000 steps), 1 not averaged" in page
    assert "400 of 1,000" in page
    assert "stopped early; the model was saved" in page
    assert str(broken.path) in page
    assert "This version of the package has no MEOW" in page
    assert "These runs take 0.0667 % of the steps" in page
    assert "As few as 1 seed a group" in page


def test_bad_arguments_are_one_sentence(tmp_path, capsys):
    for main in (report_command.main, evaluate.main):
        with pytest.raises(SystemExit):
            main([str(tmp_path)])
        assert "There are no runs in" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        evaluate.main([str(tmp_path), "--episodes", "0"])
    assert "--episodes must be at least 1" in capsys.readouterr().err


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Real runs: two seeds of two algorithms, a sweep of λ, and both heads."""
    folder = tmp_path_factory.mktemp("logs")
    small = ["policy_kwargs:{net_arch: [16]}", "learning_starts:100", "batch_size:16", "train_freq:4"]
    variants = [("tdc", 1, []), ("tdc", 2, []), ("tdc", 1, ["lam:0.0"]), ("tdc", 1, ["stochastic_actor:true"])]
    for algo, seed, more in [*variants, ("td3", 1, []), ("td3", 2, [])]:
        argv = ["--algo", algo, "--env", "Hopper-v4", "-n", 400, "--seed", seed, "-f", folder, "--eval-freq", 200]
        assert train.main([*map(str, argv), "--verbose", "0", "-params", *small, *more]) == 0
    return folder


def test_returns_are_kept_until_the_model_changes(logs, capsys, monkeypatch):
    assert evaluate.main([str(logs), "--episodes", "4"]) == 0
    assert capsys.readouterr().out.count("(4 episodes)") == 6
    run = find_runs(logs)[0][0]
    returns = final_episodes.read_test_returns(run)
    assert len(returns) == 4
    assert len(set(returns)) == 4
    with monkeypatch.context() as patch:
        patch.setattr(final_episodes, "play_final_episodes", None)  # nothing is played again
        assert final_episodes.measure_run(run, 3).tolist() == returns[:3].tolist()
    assert final_episodes.measure_run(run, 6)[:4].tolist() == returns.tolist()  # each episode depends on its seed alone
    model = run.folder.model.read_bytes()
    other = next(r for r in find_runs(logs)[0] if r.algo == run.algo and r.folder != run.folder)
    run.folder.model.write_bytes(other.folder.model.read_bytes())
    assert final_episodes.read_test_returns(run) is None
    run.folder.model.write_bytes(model)
    assert final_episodes.read_test_returns(run) is not None


def test_a_run_that_cannot_be_tested_does_not_stop_the_others(logs, capsys, monkeypatch):
    def fail_for_td3(model, env, episodes):
        if type(model).__name__ == "TD3":
            raise RuntimeError("no such luck")
        return np.zeros(episodes)

    monkeypatch.setattr(final_episodes, "play_final_episodes", fail_for_td3)
    assert evaluate.main([str(logs), "--episodes", "7"]) == 1
    captured = capsys.readouterr()
    assert captured.err.count("RuntimeError: no such luck") == 2
    assert captured.out.count("(7 episodes)") == 4


def test_a_run_of_another_package_needs_its_name(tmp_path, monkeypatch):
    code = "import gymnasium as gym\ngym.register('Elsewhere-v0', gym.spec('Pendulum-v1').entry_point)\n"
    (tmp_path / "elsewhere_package.py").write_text(code)
    folder = make_run(tmp_path, env_id="Elsewhere-v0", args={"gym_packages": ["elsewhere_package"], "env_kwargs": {}})
    run = Run.open(folder.path)
    with pytest.raises(ValueError, match=r"asks for the package elsewhere_package: .*--gym-packages elsewhere_package"):
        final_episodes.measure_run(run)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(TrainedModel, "load", lambda *args: None)
    monkeypatch.setattr(final_episodes, "play_final_episodes", lambda model, env, episodes: np.ones(episodes))
    assert final_episodes.measure_run(run, 3, ["elsewhere_package"]).tolist() == [1, 1, 1]


def test_from_runs_to_a_page(logs, tmp_path, capsys):
    for run in find_runs(logs)[0]:
        final_episodes.measure_run(run, 2)
    assert report_command.main([str(logs), "-o", str(tmp_path)]) == 0
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert not re.search(r"""(src|href)=["'](?!data:|#)""", page)  # nothing is loaded from elsewhere
    assert "url(" not in page
    assert "<script" not in page
    names = {path.name for path in (tmp_path / "figures").iterdir()}
    where = read_groups(logs)[0].conditions.file_name
    assert where.startswith("Hopper-v4-400")
    figure_names = (
        "learning-curve",
        "test-returns",
        "lambda-curves-1",
        "lambda-sweep-1",
        "heads-1",
        "td-error-variance",
    )
    for stem in (f"{name}-{where}" for name in figure_names):
        assert {f"{stem}.{suffix}" for suffix in ("svg", "png", "pdf")} <= names
        assert f"figures/{stem}.svg" in page
    table = (tmp_path / "tables" / "returns.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in table[1:]] == ["Hopper-v4"] * 4
    assert "TDC, λ 0" in page
    assert "TDC, stochastic head" in page
    assert all(str(markupsafe.escape(run.command)) in page for run in find_runs(logs)[0])  # as Jinja escapes
    assert "stable-baselines3" in page
    assert "bins of 200 steps. Seeds: TDC: 2 (1, 2);" in page
    assert "All TDC: " in page  # the hyperparameters of this test


def test_the_finished_runs_are_shown_where_those_as_shipped_are_not_finished(tmp_path):
    make_run(tmp_path, steps=400)
    make_run(tmp_path, lam=0.3)
    make_run(tmp_path, algo="td3")
    assert [group.label for group in curves.headline(read_groups(tmp_path))] == ["TDC", "TDC, λ 0.3", "TD3"]


def test_runs_without_evaluations_have_no_figure(tmp_path):
    run = make_run(tmp_path / "logs", env_id="Isaac-Repose-Cube-Allegro-v0")
    (run.path / "evaluations.npz").unlink()
    groups = read_groups(tmp_path / "logs")
    assert sections.Report(groups, tmp_path).learning_curves().pictures == []
    assert report.make_warnings(groups)[0].startswith("No run is finished and evaluated")


def test_ablations_without_evaluations_have_no_figure(tmp_path):
    for settings in ({"lam": 0.0}, {"lam": 0.5}, {"lam": 0.5, "stochastic_actor": True}):
        (make_run(tmp_path / "logs", **settings).path / "evaluations.npz").unlink()
    whole = sections.Report(read_groups(tmp_path / "logs"), tmp_path)
    assert whole.lambda_sweep().pictures == whole.heads().pictures == []


def test_tasks_of_one_length_are_one_row(tmp_path):
    def rows():
        table = tables.make_published_table(tables.make_returns_table(read_groups(tmp_path)))
        return table[table["Algorithm"] == "TDC: this report"][["Hopper", "Walker2d", "Steps"]].values.tolist()

    for env_id, steps in (("Hopper-v4", 300_000), ("Walker2d-v4", 300_000)):
        make_run(tmp_path, env_id=env_id, steps=steps, n_timesteps=steps, returns=((5.0,),))
    assert rows() == [["5", "5", "300,000"]]
    shutil.rmtree(tmp_path / "tdc")
    for env_id, steps in (("Hopper-v4", 30_000), ("Walker2d-v4", 80_000)):  # 2 % of each
        make_run(tmp_path, env_id=env_id, steps=steps, n_timesteps=steps, returns=((5.0,),))
    assert rows() == [["5", "5", "– / 30,000 / 80,000 / – / –"]]


def test_an_earlier_report_leaves_nothing(tmp_path):
    make_run(tmp_path / "one", lam=0.0, log={"train/td_error_var": [1.0]})
    make_run(tmp_path / "other", algo="td3")
    out = tmp_path / "out"
    report.write_report(*find_runs(tmp_path / "one"), out)
    mine = [out / "figures" / "mine.svg", out / "figures" / "mine.txt", out / "tables" / "mine.csv", out / "mine.csv"]
    for path in mine:
        path.write_text("kept")
    with (out / "report_files.txt").open("a") as files:  # as someone else may have edited it
        files.write("figures/../mine.csv\nmine.csv\n")
    assert any("td-error" in path.name for path in (out / "figures").iterdir())
    report.write_report(*find_runs(tmp_path / "other"), out)
    assert not any("td-error" in path.name for path in (out / "figures").iterdir())
    assert [path.read_text() for path in mine] == ["kept"] * 4
    assert not (out / "tables" / "lambda.csv").exists()


def test_a_report_that_fails_leaves_the_earlier_one_and_the_next_removes_what_it_wrote(tmp_path, monkeypatch):
    make_run(tmp_path / "one", lam=0.0, log={"train/td_error_var": [1.0]})
    make_run(tmp_path / "other", algo="td3")
    out = tmp_path / "out"
    page = report.write_report(*find_runs(tmp_path / "one"), out)
    before = page.read_text(), {path for path in out.rglob("*") if path.is_file()}
    with monkeypatch.context() as failing:
        failing.setattr(report.Report, "claims", lambda self: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            report.write_report(*find_runs(tmp_path / "other"), out)
    assert page.read_text() == before[0]
    assert all(path.is_file() for path in before[1])
    report.write_report(*find_runs(tmp_path / "one"), out)
    assert {path for path in out.rglob("*") if path.is_file()} == before[1]


def test_seeds_of_several_commits_are_said(tmp_path):
    for seed, commit in ((1, "a" * 40), (2, f"{'b' * 40}, with uncommitted changes")):
        run = make_run(tmp_path, seed=seed)
        (run.path / run.env_name / "versions.yml").write_text(f"mujoco: 3.4.0\nsb3_tdc: {commit}\n")
    page = report.write_report(*find_runs(tmp_path), tmp_path / "out").read_text()
    assert "Seeds of 1 group were trained by several commits of sb3_tdc (TDC on Hopper-v4, 1,000 steps)" in page
    assert "aaaaaaa; bbbbbbb, with uncommitted changes" in page


def test_the_steps_of_test_episodes_of_a_board_are_said(tmp_path):
    make_run(tmp_path, algo="advb_td3", log={"board/test_steps": [100.0, 4321.0]})
    make_run(tmp_path, algo="td3")
    said = [text for text in report.make_warnings(read_groups(tmp_path)) if "board" in text]
    assert len(said) == 1
    assert "ADVB_TD3 on Hopper-v4" in said[0]
    assert "took up to 4,321 further environment steps a run" in said[0]


def test_results_and_logs_make_one_report(tmp_path, capsys):
    make_run(tmp_path / "results", seed=1)
    make_run(tmp_path / "logs", seed=2)
    assert report_command.main([str(tmp_path / "results"), str(tmp_path / "logs")]) == 0
    page = (tmp_path / "logs" / "report" / "report.html").read_text()
    assert "TDC: 2 (1, 2)" in page
