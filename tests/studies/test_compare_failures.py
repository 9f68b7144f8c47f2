"""`studies.compare` where something is missing or fails: no reference, no end, no measure, a mass of less rank."""

import numpy as np
import pandas as pd
import pytest

from studies import compare
from studies.bench import reference_motion
from studies.bench.collector import Case, Run, called_from
from studies.bench.linkages import moved
from studies.bench.solvers import CATALOGUE
from twoloop import solve_dae
from twoloop.mechanisms import Problem, n_four_bar

MECHANISMS = """
import dataclasses
import numpy as np
from twoloop import ConstrainedSystem
from twoloop.mechanisms import Problem, heavy_top

def top():
    return dataclasses.replace(heavy_top(), conserved=None)

def swinging(drag, **more):
    system = ConstrainedSystem.from_python(
        n_q=2, n_c=1, mass=np.eye(2), force=lambda t, q, v: np.array([0.0, -9.81]) - drag * v,
        constraint=lambda t, q: np.array([q @ q - 1.0]), jacobian=lambda t, q: 2.0 * q[None, :], name="swing")
    energy = lambda t, q, v: 0.5 * (v * v).sum(axis=0) + 9.81 * q[1]
    return Problem("swing", system, np.array([1.0, 0.0]), np.zeros(2), (0.0, 0.5), energy, **more)

def plain():
    return swinging(0.0)

def raising():
    return swinging(Raises())

class Raises:
    def __rmul__(self, v): return self
    __mul__ = __rmul__
    def __rsub__(self, v): raise KeyError("x")
    __array_ufunc__ = None

def still():
    made = swinging(0.0)
    return dataclasses.replace(made, q0=np.array([0.0, -1.0]))
"""


@pytest.fixture
def mechanisms(tmp_path):
    path = tmp_path / "mechanisms.py"
    path.write_text(MECHANISMS)
    return path


def compared(path, name, *words):
    out = path.parent / name
    compare.main([f"{path}:{name}", "--quick", "--out", str(out), "--errors", "1e-3", *words])
    return (out / "compare.md").read_text(), pd.read_csv(out / "compare.csv", comment="#")


def test_called_from_python_is_said_of_what_is():
    names = {}
    exec(MECHANISMS, names)
    case = Case("case", names["plain"](), 0.1)
    expected = {"DOP853, compiled": "compiled", "DOP853 (twoloop)": "Python", "LSODA, index 1": "Python"}
    expected |= {"CVODE from C, Adams": "compiled", "IDA, stabilised": "Python"}
    assert {name: called_from(Run(case, CATALOGUE[name], 1e-3)) for name in expected} == expected


def test_without_a_reference_the_report_says_why(mechanisms, monkeypatch):
    def too_slow(*run, time_limit, **options):
        raise RuntimeError(f"stopped after {time_limit:g} s")

    for name in ("_explicit", "_own_explicit", "_ida"):
        monkeypatch.setattr(reference_motion, name, too_slow)
    says = r"^error: no reference for 'heavy top': .*stopped after 7 s\. Choose a shorter --t-end, or more than"
    with pytest.raises(SystemExit, match=says):
        compared(mechanisms, "top", "--reference-limit", "7")
    assert "no reference for 'heavy top'" in (mechanisms.parent / "top" / "compare.md").read_text()


@pytest.fixture
def only_own_methods_pass(monkeypatch):
    def singular(*run, **options):
        raise RuntimeError("singular")  # which SciPy's DOP853 says after a minute

    monkeypatch.setattr(reference_motion, "_explicit", singular)


@pytest.mark.usefixtures("only_own_methods_pass")
def test_the_reference_where_rows_are_singular_is_the_ode_in_minimal_coordinates():
    problem = n_four_bar(2)
    known = reference_motion.make_reference(problem, 0.5)
    assert "minimal coordinates" in known.source and known.floor < 1e-10
    result = solve_dae(problem.system, (0.0, 0.5), problem.q0, problem.v0, rtol=1e-10, atol=1e-10)
    q, v = known.states(result.t)
    assert np.abs(q - result.q).max() < 1e-8 > 0.1 * np.abs(v - result.v).max()


@pytest.mark.usefixtures("only_own_methods_pass")
@pytest.mark.filterwarnings("ignore:the constraint Jacobian has lost rank")
def test_a_rhombus_of_ones_own_has_a_reference_across_its_folds():
    drawn = moved("rhombus", (9,))
    span = (0.0, drawn["t_end"])
    own = Problem("own", drawn["system"], drawn["q0"], drawn["v0"], span, lambda t, q, v: 0.0)
    motion = reference_motion.make_reference(own, span[1])
    assert "and DOP853 (both two-loop)" in motion.source and motion.floor < 1e-9
    assert np.abs(motion.states(np.array(span))[0][:, 1] - drawn["positions"](span[1])).max() < 1e-9


def test_functions_that_raise_are_named(mechanisms):
    with pytest.raises(SystemExit, match=r"^error: no reference for 'swing': KeyError: 'x'; raised by force of system"):
        compared(mechanisms, "raising")
