"""The paper's suites, and which runs belong to their cells."""

from sb3_tdc.experiments.results import find_runs
from sb3_tdc.experiments.suites import SUITES, Cell
from tests.helpers.run_folders import make_run


def test_cells_of_the_paper():
    algos = {cell.algo for cell in SUITES["fig1"]}
    assert algos == {"tdc", "td3", "sac", "ddpg", "meow"}
    assert len(SUITES["fig1"]) == 25
    assert [len(SUITES[name]) for name in ("fig2", "fig3", "fig5", "figS1")] == [10, 10, 12, 2]


def test_a_run_belongs_to_a_cell_by_what_the_cell_varies(tmp_path):
    make_run(tmp_path, lam=0.0)
    make_run(tmp_path, seed=2, lam=0.0, kappa=10.0)
    run, other = find_runs(tmp_path)[0]
    assert Cell("tdc", "Hopper-v4", {"lam": 0.0}).includes(run)
    assert not Cell("tdc", "Hopper-v4").includes(run)  # λ is not that of hyperparams/
    assert not Cell("tdc", "Hopper-v4", {"stochastic_actor": False}).includes(run)
    assert not Cell("tdc", "Hopper-v4", {"lam": 1.0}).includes(run)
    assert not Cell("td3", "Hopper-v4").includes(run)
    assert not Cell("tdc", "Hopper-v4", {"lam": 0.0}).includes(other)
    assert Cell("tdc", "Hopper-v4", {"lam": 0.0, "kappa": 10.0}).includes(other)
