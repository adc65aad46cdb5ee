"""From a search to a page, through Ray, in the order in which a user works: search → matrix → test returns → report."""

import yaml

from sb3_tdc.cli import evaluate, report
from sb3_tdc.experiments.final_episodes import read_test_returns
from sb3_tdc.experiments.results import find_runs
from tests.helpers.matrices import finish, start_matrix
from tests.helpers.searches import arguments, start_search


def test_from_a_search_to_a_page(tmp_path, capsys):
    options = [*arguments(tmp_path, steps=100), "--seeds", 1]
    out, status = finish(start_search(*options, "--search", "lam:[0.0, 1.0]"))
    assert status == 0, out
    search = tmp_path / "search/tdc/Pendulum-v1_1"
    ranking = (search / "ranking.csv").read_text().splitlines()
    assert ranking[0] == "lam,mean,std,seeds,steps"
    assert sorted(line.split(",")[0] for line in ranking[1:]) == ["0.0", "1.0"]
    assert yaml.safe_load((search / "best.yml").read_text())["Pendulum-v1"]["lam"] == float(ranking[1].split(",")[0])
    assert {path.name for path in search.glob("lam.*")} == {"lam.png", "lam.pdf"}

    matrix = tmp_path / "matrix"
    scale = ["--scale", "0.0003"]  # 300 steps
    out, status = finish(start_matrix("fig2", matrix, *scale))
    assert status == 1, out  # one of the two fails, and does not stop the other
    assert "failed tdc Pendulum-v1" in out
    assert "lam must be" in out
    (run,), _ = find_runs(matrix)
    assert run.is_finished
    out, status = finish(start_matrix("fig1", matrix, *scale, "--dry-run"))
    assert status == 0, out
    assert "skip   tdc Pendulum-v1" in out  # a cell of both suites is one run
    assert "1 of 2 to run" in out

    assert evaluate.main([str(matrix), "--episodes", "2"]) == 0
    assert report.main([str(matrix), "-o", str(tmp_path / "report")]) == 0
    page = (tmp_path / "report" / "report.html").read_text(encoding="utf-8")
    assert "300 steps; bins of" in page
    assert f"{read_test_returns(run).mean():,.0f}".replace("-", "−") in page
    capsys.readouterr()
