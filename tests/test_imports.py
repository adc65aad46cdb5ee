"""The house: imports point in one direction (a contract in pyproject.toml), without circles; a few cost nothing."""

import subprocess
import sys

import grimp


def test_no_modules_import_each_other_in_a_circle():
    graph = grimp.build_graph("sb3_tdc", exclude_type_checking_imports=False)
    remaining = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    while leaves := [module for module, imported in remaining.items() if not imported & remaining.keys()]:
        for module in leaves:
            del remaining[module]
    assert remaining == {}  # what is left imports, directly or not, itself


def test_the_package_is_imported_without_simulators_plots_and_searches():
    code = (
        "import sys, sb3_tdc; print(*{'mujoco', 'matplotlib', 'ray', 'pandas', 'scipy', 'imageio'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_the_commands_that_draw_nothing_choose_mujocos_backend_themselves():
    """MuJoCo reads ``MUJOCO_GL`` when it is imported: nothing may import it before ``enjoy`` has chosen."""
    code = "import sys, sb3_tdc.cli.enjoy, sb3_tdc.cli.train; print('mujoco' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False"]
