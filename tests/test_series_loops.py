"""Series as loops over tables: the same numbers as by straight code, and code that does not grow with a mechanism."""

import numpy as np
import pytest

from tests.large_systems import spatial_chain
from tests.problems import unconstrained, worst
from twoloop import mechanisms, solve_dae
from twoloop.generate import compiled_series, families
from twoloop.generate.coefficients import Coefficients
from twoloop.generate.llvm_code import Emitter
from twoloop.generate.llvm_text import Module
from twoloop.generate.series import series_program
from twoloop.generate.series_code import SeriesCode
from twoloop.generate.series_loops import SeriesLoops
from twoloop.generate.traced_equations import Equations

FUNCTIONS = {
    "square root": lambda t, q, v: -np.sqrt(2.0 + q * q),
    "reciprocal": lambda t, q, v: -1.0 / (2.0 + q) - 0.3 * v,
    "exponential": lambda t, q, v: -np.exp(0.5 * q),
    "logarithm": lambda t, q, v: -np.log(3.0 + q),
    "arctangent": lambda t, q, v: -np.arctan(2.0 * q + 0.1 * v),
    "sines of some angles": lambda t, q, v: -np.sin(q) + 0.1 * np.cos(3.0 * t),
}
MECHANISMS = [
    mechanisms.four_bar,
    mechanisms.driven_slider_crank,
    mechanisms.andrews,
    mechanisms.heavy_top,
    mechanisms.spatial_slider_crank,
    mechanisms.rolling_disc,
    pytest.param(mechanisms.governor, marks=pytest.mark.slow),  # in space, too, as are three of the others
    mechanisms.moderately_stiff_beam,
]


def both(monkeypatch, make, t_end):
    """Runs by loops and by straight code; `make` gives a system and its start."""
    made = []
    for long in (0, 10**9):
        monkeypatch.setattr(compiled_series, "LONG", long)
        monkeypatch.setattr(families, "_FAMILIES", {})
        system, q0, v0 = make()
        result = solve_dae(system, (0.0, t_end), q0, v0, "Taylor", 1e-10, 1e-10, compiled=True)
        assert result.success, result.message
        made.append(result)
    return made


@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
@pytest.mark.parametrize("make", MECHANISMS)
def test_mechanisms_move_as_by_straight_code(make, monkeypatch):
    def start():
        problem = make()
        return problem.system, problem.q0, problem.v0

    t_end = 0.002 * make().t_span[1]
    loops, straight = both(monkeypatch, start, t_end)
    assert abs(loops.stats.n_accepted - straight.stats.n_accepted) <= 1 + 0.05 * straight.stats.n_accepted
    assert worst(loops.q[:, -1], straight.q[:, -1]) < 1e-9 * max(1.0, np.abs(straight.q).max())
    assert worst(loops.lam[:, -1], straight.lam[:, -1]) < 1e-6 * max(1.0, np.abs(straight.lam).max())


@pytest.mark.parametrize("n", [1, 3, 9])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_of_any_number_of_quantities(name, n, monkeypatch):
    """One group, groups of which the last is not full, and more than one turn of a loop."""

    def start():
        return unconstrained(FUNCTIONS[name], n), np.linspace(0.1, 0.9, n), np.linspace(-0.5, 0.4, n)

    loops, straight = both(monkeypatch, start, 1.0)
    assert worst(loops.q[:, -1], straight.q[:, -1]) < 1e-12
    q, v = loops.q[:, 0], loops.v[:, 0]
    assert np.allclose(loops.a[:, 0], FUNCTIONS[name](0.0, q, v), rtol=1e-14, atol=0.0)


def n_lines(kind, system):
    """Of the code of a kind."""
    module, code = Module(), kind(series_program(system), Coefficients())
    code.write_parts(module)
    for name, emit, n_vectors in (("begin", code.begin, 5), ("find", code.find_order, 4), ("take", code.take_order, 4)):
        more = {"begin": 2, "find": 2, "take": 1}[name]
        arguments = ["double*"] * n_vectors + ["double"] * more
        arguments += ["double*"] * (2 if name == "begin" else 0) + ["i64"] * (name != "begin")
        arguments += ["double*"] * (name != "begin")
        builder = module.function(name, "void", arguments)
        emit(Emitter(builder), *builder.arguments)
        builder.ret(None)
    return str(module).count("\n")


def test_the_code_does_not_grow_with_a_mechanism():
    short, long = (n_lines(SeriesLoops, spatial_chain(n, hinges=True)[0]) for n in (4, 12))
    assert long < 1.2 * short
    assert n_lines(SeriesCode, spatial_chain(12, hinges=True)[0]) > 8 * long


def test_callbacks_are_traced_once_for_all_that_is_made_of_them(monkeypatch):
    problem, calls = mechanisms.spatial_four_bar(), []
    traced = Equations._traced
    monkeypatch.setattr(families, "_FAMILIES", {})
    monkeypatch.setattr(Equations, "_traced", lambda self, kind, v: calls.append(kind) or traced(self, kind, v))
    solve_dae(problem.system, (0.0, 0.01), problem.q0, problem.v0, "Taylor", 1e-6, 1e-6, compiled=True)
    assert len(calls) == len(set(calls)) and {"mass", "force", "jacobian", "constraint"} <= set(calls)
