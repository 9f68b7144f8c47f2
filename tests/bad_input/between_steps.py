"""Wrong events, wrong times for `result.sol`, wrong files."""

import tempfile
from functools import cache
from pathlib import Path

import numpy as np

from tests.bad_input.case import Case, argument, cases_of, linkage, solve
from twoloop import load


def having(**attributes):
    """An event function with these attributes."""

    def event(t, q, v):
        return q[0]

    for name, value in attributes.items():
        setattr(event, name, value)
    return event


def returning(value):
    return lambda t, q, v: value


@cache
def solution():
    return solve(dense_output=True).sol


def evaluated(t):
    return solution()(t)


def loaded(content, system=None):
    """Load a file with this content; of `solve` where it is None."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.npz"
        if content is None:
            solve().save(path)
        else:
            path.write_bytes(content)
        return load(path, system)


def event_case(what, events, error, words, advice):
    return Case("events", what, lambda: solve(events=events), words, advice, error)


NUMBER = "return one real number, e.g. float(q[0])"
COUNT = "give True or a count"
WITHIN = "ask between start and end"
FUNCTION = "give a function event(t, q, v), or a list of such"
of_load = cases_of("load")
BETWEEN_STEPS = [
    event_case("`events=3`", 3, TypeError, "events must be a function", FUNCTION),
    event_case("`events='hit'`", "hit", TypeError, "events must be a function", FUNCTION),
    event_case("`events=[hit, None]`", [having(), None], TypeError, r"events\[1\] must be a function", FUNCTION),
    event_case("an event that returns an array", returning(np.zeros(2)), TypeError, "must return a number", NUMBER),
    event_case("an event that returns None", returning(None), TypeError, "must return a number", NUMBER),
    event_case("an event that returns True", returning(True), TypeError, "must return a number", NUMBER),
    event_case("an event of the time alone", lambda t: 1.0, TypeError, r"called as event\(t, q, v\); the .* takes \(t\)", FUNCTION),
    event_case("an event that returns text", returning("high"), TypeError, "must return a number", NUMBER),
    event_case("an event that returns NaN", returning(np.nan), ValueError, r"events\[0\] must return a finite number; at t = 0.0", "let it be finite wherever the motion may go"),
    event_case("`hit.terminal = 'yes'`", having(terminal="yes"), TypeError, "terminal must be True", COUNT),
    event_case("`hit.terminal = -1`", having(terminal=-1), ValueError, "terminal must be True", COUNT),
    event_case("`hit.terminal = 1.5`", having(terminal=1.5), TypeError, "terminal must be True", COUNT),
    event_case("`hit.direction = 'up'`", having(direction="up"), TypeError, "direction must be -1, 0 or 1", "give 1, -1 or 0"),
    event_case("`hit.direction = nan`", having(direction=np.nan), ValueError, "direction must be -1, 0 or 1", "give 1, -1 or 0"),
    event_case("`hit.direction = 2`", having(direction=2), ValueError, "direction must be -1, 0 or 1", "give 1, -1 or 0"),
    event_case("`hit.direction = True`", having(direction=True), TypeError, "direction must be -1, 0 or 1", "give 1, -1 or 0"),
    *argument(
        "result.sol",
        evaluated,
        "t",
        (-1e-3, ValueError, "must lie within the run, from 0.0 to 1.0; given -0.001", WITHIN),
        ([0.5, 2.0], ValueError, "must lie within the run, from 0.0 to 1.0; given 2.0", "ask between start and end"),
        (np.nan, ValueError, "must lie within the run.*given nan", "find out where the NaN comes from"),
        ([[0.1]], ValueError, r"must be a number or have shape \(n,\)", "ravel() it"),
        ("now", TypeError, "must be an array of real numbers", "give seconds"),
        (None, TypeError, "must be an array of real numbers", "give seconds"),
        (True, TypeError, "must be an array of real numbers", "write 1.0"),
    ),
    of_load("a file of something else", lambda: loaded(b"text")).says("must lead to a file written by Result.save", "give a file that result.save(path) wrote"),
    of_load("the result of another system", lambda: loaded(None, linkage().system)).says(r"system must be the one that was solved, with n_q = 2 and n_c \+ n_a = 1", "give the system that was solved"),
    of_load("a problem in the place of its system", lambda: loaded(None, linkage())).says(r"give its system, problem\.system", "give problem.system", TypeError),
]
