"""Imports: in one direction (a contract in pyproject.toml), without circles, without packages that are not needed."""

import subprocess
import sys

import grimp
import pytest

import sb3_tdc


def test_no_modules_import_each_other_in_a_circle():
    graph = grimp.build_graph("sb3_tdc", exclude_type_checking_imports=False)
    remaining = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    while leaves := [module for module, imported in remaining.items() if not imported & remaining.keys()]:
        for module in leaves:
            del remaining[module]
    assert remaining == {}  # whatever remains imports itself, directly or not


def test_the_algorithm_is_imported_without_simulators_plots_searches_and_compiler():
    others = {"mujoco", "matplotlib", "ray", "pandas", "scipy", "imageio", "torch._dynamo"}
    code = f"import sys; from sb3_tdc import TDC; print(*{others} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_what_the_package_offers_is_there():
    for name in sb3_tdc.__all__:
        assert name == "__version__" or getattr(sb3_tdc, name).__module__.startswith("sb3_tdc.")
    with pytest.raises(AttributeError, match="no attribute 'TCD'"):
        _ = sb3_tdc.TCD


def test_the_command_answers_before_pytorch_is_imported():
    """Importing it takes seconds, in which a Ctrl-C would end in a traceback."""
    code = "import sys, sb3_tdc.__main__; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False"]


def test_the_commands_that_draw_nothing_choose_mujocos_backend_themselves():
    """MuJoCo reads ``MUJOCO_GL`` when it is imported: nothing may import it before ``enjoy`` has chosen."""
    code = "import sys, sb3_tdc.cli.enjoy, sb3_tdc.cli.train; print('mujoco' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False"]


def test_training_and_watching_require_no_extras():
    """They work with the dependencies of the package alone, as after the README's installation."""
    extras = {"pandas", "scipy", "jinja2", "ray", "imageio"}
    code = f"import sys, sb3_tdc.cli.enjoy, sb3_tdc.cli.train, sb3_tdc.cli.inspect; print(*{extras} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
