"""Test generated code: derived once, pickled without SymPy, its parameters free to change."""

import pickle

import numpy as np
import pytest
import sympy as sp
from sympy.physics.mechanics import dynamicsymbols

from tests.processes import run_python
from twoloop import solve_dae
from twoloop.problem import compiled_functions
from twoloop.symbolic import from_lagrangian
from twoloop.symbolic.expressions import Equations

m, length, g = sp.symbols("m l g")


def pendulum(**changed):
    q = x, y = dynamicsymbols("x y")
    T = m * sum(each.diff() ** 2 for each in q) / 2
    given = {"constraints": [(x**2 + y**2 - length**2) / 2], "parameters": {m: 2.0, length: 0.5, g: 9.81}, **changed}
    return from_lagrangian(T, m * g * y, given.pop("constraints"), q, name="pendulum", **given)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(compiled_functions, "sources_folder", lambda: tmp_path / "equations")
    compiled_functions._functions.cache_clear()
    compiled_functions._compiled.cache_clear()
    return tmp_path


def never(*_):
    raise AssertionError("derived again")


def test_equations_that_were_derived_before_are_not_derived_again(folder, monkeypatch):
    code = pendulum().code
    code.value("mass")  # writes the file
    with monkeypatch.context() as patch:
        patch.setattr(Equations, "source", never)
        assert pendulum().code == code
        assert pendulum(parameters={m: 1.0, length: 1.0, g: 1.62}).code == code  # numbers are no part of it
        with pytest.raises(AssertionError, match="derived again"):
            pendulum(tangents=True)
        with pytest.raises(AssertionError, match="derived again"):
            pendulum(dissipation=m * dynamicsymbols("x").diff() ** 2)
    assert pendulum(dissipation=m * dynamicsymbols("x").diff() ** 2).code.key != code.key


def test_parameters_change_without_compiling_again(folder):
    first = pendulum()
    start = first.problem({"x": 0.3, "y": -0.4}, [0.0, 0.0], (0.0, 1.0))
    other = first.with_parameters({length: 1.0, "g": 1.62})
    assert other.system.given == start.system.given  # the same machine code
    moved = other.problem([0.6, -0.8], {"x": 0.8, "y": 0.6}, (0.0, 1.0))
    assert moved.parameters == {"m": 2.0, "l": 1.0, "g": 1.62}
    for problem, side, gravity in ((start, 0.5, 9.81), (moved, 1.0, 1.62)):
        result = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, rtol=1e-8, atol=1e-8)
        assert np.hypot(*result.q) == pytest.approx(side, rel=1e-12)
        energy = 1.0 * (result.v**2).sum(axis=0) + 2.0 * gravity * result.q[1]
        assert problem.energy(result.t, result.q, result.v) == pytest.approx(energy, rel=1e-14)
        assert np.ptp(energy) < 1e-7


UNPICKLED = """
import pickle, sys
from pathlib import Path
sys.modules["sympy"] = None
from twoloop.problem import compiled_functions
compiled_functions.sources_folder = lambda: Path("equations").resolve()
problem = pickle.loads(Path("problem.pickle").read_bytes())
system = problem.system
print(system.mass(0.0, problem.q0)[0, 0], system.gamma(0.0, problem.q0, [3.0, 4.0])[0])
print(problem.energy(0.0, problem.q0, problem.v0))
print([kind for kind, each in system.given.items() if not sum(each.stats.cache_hits.values())])
try:
    import twoloop.symbolic
except ImportError as error:
    print(error)
"""


@pytest.mark.slow
def test_a_problem_goes_to_another_process_by_its_equations(folder):
    (folder / "problem.pickle").write_bytes(pickle.dumps(pendulum().problem([0.3, -0.4], [0.0, 0.0], (0.0, 1.0))))
    numbers, energy, compiled, refusal = run_python(UNPICKLED, folder=folder).stdout.splitlines()
    assert [float(each) for each in numbers.split()] == [2.0, -25.0]
    assert float(energy) == pytest.approx(2.0 * 9.81 * -0.4)
    assert compiled == "[]"  # all machine code was read from the disk
    assert "pip install sympy" in refusal
