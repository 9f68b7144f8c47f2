"""Every public argument by values of every sort: a result, or a TypeError or ValueError that names the argument.

A kind is an argument with a sort of value; hypothesis draws the values. What each mistake should say in particular is
in tests/bad_input.
"""

import inspect
import re
import warnings
from fractions import Fraction
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import twoloop
from tests.problems import PLAIN, pendulum
from twoloop import ConstrainedSystem, Joint, consistent_state, mechanisms, solve_dae
from twoloop.kernels.compile.callbacks import KINDS
from twoloop.methods import tableaux

FLOATS = st.floats(-1e3, 1e3)
SORTS = {
    "None": st.none(),
    "bool": st.booleans(),
    "int": st.integers(-10, 12),
    "int of 64 bits and more": st.sampled_from([2**40, 2**63, -(2**63), 10**400]),
    "float": FLOATS,
    "not finite": st.sampled_from([np.nan, np.inf, -np.inf]),
    "huge or tiny": st.sampled_from([1e308, -1e308, 1e-308, 5e-324]),
    "complex": st.complex_numbers(max_magnitude=10.0),
    "fraction": st.fractions(Fraction(-3), Fraction(3)),
    "text": st.text(max_size=8),
    "bytes": st.binary(max_size=8),
    "list of numbers": st.lists(FLOATS, max_size=4),
    "list of ints": st.lists(st.integers(-3, 3), max_size=4),
    "list with NaN": st.sampled_from([[np.nan, 0.0], [0.0, np.inf], [np.nan]]),
    "ragged": st.just([[1.0], [2.0, 3.0]]),
    "list of anything": st.lists(st.one_of(st.none(), st.text(max_size=3), st.booleans()), min_size=1, max_size=3),
    "empty": st.sampled_from([(), [], {}, set(), np.zeros(0), ""]),
    "array": st.sampled_from([np.eye(2), np.zeros((2, 1, 1)), np.array(1.0), np.arange(3), np.zeros((1, 2))]),
    "array of objects": st.just(np.array([None, "a"], dtype=object)),
    "masked array": st.just(np.ma.MaskedArray([-1.0, 0.0], mask=[False, True])),
    "dates": st.just(np.array(["2016-01-01", "2016-01-02"], dtype="datetime64[D]")),
    "mapping": st.dictionaries(st.text(max_size=2), FLOATS, min_size=1, max_size=2),
    "set": st.just({0.0, 1.0}),
    "generator": st.builds(lambda: (x for x in (0.0, 1.0))),
    "class": st.sampled_from([int, ConstrainedSystem, twoloop.BDF]),
    "function of the wrong signature": st.just(lambda: 0.0),
    "object": st.builds(object),
}
BEAM = {"youngs_modulus": 2e11, "amplitude": 0.1, "angular_frequency": 1.0}
BOUNDS = {"max_steps": 5, "time_limit": 0.05}  # of the runs
SHOWN_AS = {"n_q": "shape", "n_c": "shape", "n_a": "shape"}  # a size that does not fit shows in what functions return


def solve(**changed):
    problem = {"system": pendulum(), "t_span": (0.0, 0.01), "q0": [-1.0, 0.0], "v0": [0.0, 0.0]}
    result = solve_dae(**(problem | BOUNDS | changed))
    assert np.isfinite(result.q).all() and result.message
    return result


def from_python(**changed):
    """A system, and a short run of it: a function may be wrong without a mistake in its arguments."""
    if changed.get("compile") is True:
        return None  # takes seconds; other tests do it
    system = ConstrainedSystem.from_python(**(PLAIN | changed))
    return solve(system=system) if set(changed) & {"n_q", "n_c", "n_a", *KINDS} else system


def start(**changed):
    return consistent_state(**({"system": pendulum(), "t": 0.0, "q": [-0.6, -0.81], "v": [0.0, 0.0]} | changed))


def joint(**changed):
    return Joint(**({"name": "A", "rows": (0,), "translation": (0, 1)} | changed))


def method(make, **needed):
    """A method, made and run."""
    return lambda **changed: solve(method=make(**(needed | changed)), t_span=(0.0, 1e-3))


@cache
def swung():
    """A result with joints."""
    problem = mechanisms.four_bar()
    return solve_dae(problem.system, (0.0, 0.01), problem.q0, problem.v0)


def arguments(call, of, **skipped):
    """(call, argument) of all parameters of a function."""
    return [(call, name) for name in inspect.signature(of).parameters if name not in skipped]


def cases():
    yield "solve_dae", arguments(solve, solve_dae)
    yield "consistent_state", arguments(start, consistent_state)
    yield "from_python", arguments(from_python, ConstrainedSystem.from_python)
    yield "Joint", arguments(joint, Joint)
    yield "RungeKutta", arguments(method(twoloop.RungeKutta, tableau=tableaux.gauss(2)), twoloop.RungeKutta)
    for make in (twoloop.Newmark, twoloop.BDF, twoloop.DOP853, twoloop.paper_irk, twoloop.paper_newmark):
        yield make.__name__, arguments(method(make), make)
    for make in (tableaux.gauss, tableaux.radau_iia, tableaux.lobatto_iiie, tableaux.sun_radau_iib):
        yield make.__name__, arguments(make, make)
    for make in (mechanisms.four_bar, mechanisms.pendulum, mechanisms.closed_chain, mechanisms.n_four_bar):
        yield make.__name__, arguments(make, make)
    beam = mechanisms.ancf_beam
    yield "ancf_beam", arguments(lambda **changed: beam(**(BEAM | changed)), beam)
    yield "Result.reactions", [(lambda **changed: swung().reactions(**changed), "name")]
    yield "Result.save", [(lambda **changed: swung().save(**changed), "path")]
    yield "load", [(twoloop.load, "path")]
    yield "callback", [(twoloop.callback, "kind")]


ARGUMENTS = [pytest.param(*each, id=f"{of}({each[1]})") for of, found in cases() for each in found]


def try_one(call, name, value):
    """Call it; what an error must be."""
    with warnings.catch_warnings(action="ignore"):
        try:
            call(**{name: value})
        except MemoryError:  # of 2^40 bars
            pass
        except OSError:
            assert name == "path"
        except (TypeError, ValueError) as error:
            if "array is too big" in str(error):  # what numpy says beyond what a MemoryError says
                return
            assert not isinstance(error, (OverflowError, UnicodeError)), repr(error)
            notes = " ".join([str(error), *getattr(error, "__notes__", [])])
            named = rf"\b({name}|{SHOWN_AS.get(name, name)})\b"
            assert re.search(named, notes), f"{name} = {value!r}: {error!r} does not name the argument"


@pytest.mark.parametrize(("call", "name"), ARGUMENTS)
def test_a_result_or_an_error_that_names_the_argument(call, name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where files are written
    if name == "progress":
        pytest.importorskip("rich")  # with which the bar is drawn

    @settings(max_examples=2, database=None)
    @given(st.tuples(*SORTS.values()))
    def each(values):
        for value in values:
            try_one(call, name, value)

    each()
