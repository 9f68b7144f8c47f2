"""An import compiles no kernels, and mechanisms are imported one by one: each compiles its callbacks and no others."""

from types import ModuleType

import pytest

from tests.processes import run_python
from twoloop import mechanisms


def imported(*statements):
    """Modules of twoloop after each of the statements in a new process."""
    told = "print(*(m for m in sys.modules if m.startswith('twoloop.')))"
    source = "\n".join(["import sys", *(f"{statement}; {told}" for statement in statements)])
    return [set(line.split()) for line in run_python(source).stdout.splitlines()]


def mechanisms_among(modules):
    """Names of those of mechanisms."""
    return {name.removeprefix("twoloop.mechanisms.") for name in modules if name.startswith("twoloop.mechanisms.")}


def test_a_mechanism_imports_no_other_and_its_name_is_a_function_also_after_an_import_of_the_module():
    first, *after = imported(
        "import twoloop; twoloop.solve_dae",
        "import twoloop.mechanisms",
        "from twoloop.mechanisms import four_bar",
        "import twoloop.mechanisms.heavy_top; from twoloop.mechanisms import heavy_top; assert callable(heavy_top)",
    )
    assert not first & {f"twoloop.kernels.{name}" for name in ("lanes.lane_room", "evaluation.calls", "advance")}
    none, one, other = map(mechanisms_among, after)
    assert none == set() and one == {"four_bar"}
    assert {"four_bar", "heavy_top"} <= other and "andrews" not in other


def test_a_first_run_imports_no_models_and_no_step_that_it_does_not_come_to():
    """Of an implicit method, whose machine code takes a third of a cold first run, and of SciPy's optimisation."""
    source = """
import sys
from twoloop import solve_dae
from twoloop.mechanisms import four_bar
problem = four_bar()
print(solve_dae(problem.system, (0.0, 0.5), problem.q0, problem.v0).success, *sys.modules)
"""
    success, *modules = run_python(source).stdout.split()
    assert success == "True" and "twoloop.kernels.steps.explicit_step" in modules
    unused = ("newton_step", "diagonal_step", "fixed_point_step", "paper_step")
    assert not {*modules} & {f"twoloop.kernels.steps.{name}" for name in unused}
    assert not {*modules} & {"twoloop.bodies.model", "twoloop.bodies.assembly", "scipy.optimize"}


def test_names_are_functions():
    assert not [name for name in mechanisms.__all__ if isinstance(getattr(mechanisms, name), ModuleType)]
    assert set(mechanisms.__all__) <= set(dir(mechanisms))


def test_unknown_names():
    with pytest.raises(ImportError, match="cannot import name 'five_bar'"):
        from twoloop.mechanisms import five_bar  # noqa: F401
