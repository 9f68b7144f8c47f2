"""What a case of wrong input is, and the wrong values that many arguments share."""

import datetime
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from tests.problems import pendulum
from twoloop import solve_dae
from twoloop.mechanisms import four_bar

Q0, V0 = [-1.0, 0.0], [0.0, 0.0]
HUGE = 10**400
DAY = datetime.datetime(2016, 1, 1)
DAYS = np.array(["2016-01-01", "2016-01-02"], dtype="datetime64[D]")
MASKED = np.ma.MaskedArray([-1.0, 0.0], mask=[False, True])
WRONG = (TypeError, ValueError)


@dataclass(frozen=True)
class Case:
    """One mistake: what was done, the error that it gets, words that must stand in it, and what to do instead."""

    group: str
    what: str
    call: Callable[[], Any]
    words: str
    advice: str
    error: type[Exception] | tuple[type[Exception], ...] = ValueError

    @property
    def id(self):
        return f"{self.group}: {self.what}"

    def when(self, call):
        return replace(self, call=call)

    def says(self, words, advice, error=ValueError):
        """The case, of words that did not fit into the line of the call."""
        return replace(self, words=words, advice=advice, error=error)


def cases_of(group):
    """What makes the cases of a group: of (what, call, words, advice), and of the error, if it is no ValueError."""

    def case(what, call=None, words="", advice="", error=ValueError):
        return Case(group, what, call, words, advice, error)

    return case


@cache
def swinging():
    return pendulum()


@cache
def linkage():
    return four_bar()


def solve(system=None, t_span=(0.0, 1.0), q0=Q0, v0=V0, **options):
    return solve_dae(swinging() if system is None else system, t_span, q0, v0, **options)


def shown(value):
    if value is HUGE:
        return "10**400"
    if isinstance(value, np.ma.MaskedArray):
        return "a masked array"
    if isinstance(value, np.ndarray):
        return f"an array of {value.dtype}, shape {value.shape}"
    return repr(value).replace(repr(HUGE), "10**400") if not isinstance(value, (list, tuple)) else listed(value)


def listed(value):
    inner = ", ".join(shown(each) for each in value)
    return f"({inner})" if isinstance(value, tuple) else f"[{inner}]"


def argument(group, call, name, *values):
    """A case for each wrong value of one argument: (value, error, words, advice)."""
    return [Case(group, f"`{name}={shown(value)}`", lambda value=value: call(**{name: value}), f"{name} {words}", do, error) for value, error, words, do in values]


NUMBERS = "give a list or array of n_q real numbers"
VECTORS = [
    ([1.0], ValueError, r"must have shape \(2,\); given shape \(1,\), \[1.0\]", NUMBERS),
    (np.zeros((2, 1)), ValueError, r"must have shape \(2,\); given shape \(2, 1\)", "give one dimension: ravel() it"),
    (0.0, ValueError, r"must have shape \(2,\); given the number 0.0", NUMBERS),
    ([np.nan, 0.0], ValueError, r"must be finite; entries \[0\] .*given \[nan\]", "find out where the NaN comes from"),
    ([0.0, np.inf], ValueError, r"must be finite; entries \[1\] .*given \[inf\]", "find out where the infinity comes from"),
    (["left", "down"], TypeError, "must be an array of real numbers; given .*left", NUMBERS),
    (["1.0", "0.0"], TypeError, "must be an array of real numbers", "convert text to numbers first"),
    (None, TypeError, "must be an array of real numbers; given None", NUMBERS),
    ([1j, 0.0], TypeError, "must be an array of real numbers; given .*1j", "take the real part if that is meant"),
    ([[1.0], [0.0, 1.0]], TypeError, "must be an array of real numbers; given", NUMBERS),
    ([True, False], TypeError, "must be an array of real numbers.*True and False", "write 1.0 and 0.0"),
    ([1.0, True], TypeError, "must be an array of real numbers.*True and False", "write 1.0 and 0.0"),
    (DAYS, TypeError, "must be an array of real numbers.*which holds dates", "convert dates to seconds"),
    (MASKED, TypeError, "must be an array of real numbers; given a masked array", "fill the gaps with filled()"),
    ([HUGE, 0], ValueError, "must hold numbers that fit into a float", "use units in which numbers are moderate"),
    ([object, 0.0], TypeError, "must be an array of real numbers", NUMBERS),
    ([None, 0.0], TypeError, "must be an array of real numbers", NUMBERS),
    ({"x": 1.0}, TypeError, "must be an array of real numbers", NUMBERS),
    ({0.0, 1.0}, TypeError, "must be an array of real numbers", "a set has no order: give a list"),
    ("10", TypeError, "must be an array of real numbers", NUMBERS),
]
FEW_VECTORS = [VECTORS[k] for k in (0, 3, 5, 8, 10, 12, 13, 14)]
POSITIVE = "give a positive number"
POSITIVES = [
    (0.0, ValueError, "must be positive.*given 0.0", POSITIVE),
    (-1e-6, ValueError, "must be positive.*given -1e-06", POSITIVE),
    (np.nan, ValueError, "must be positive.*given nan", POSITIVE),
    ("small", TypeError, "must be a number; given 'small' of type str", POSITIVE),
    (True, TypeError, "must be a number; given True of type bool", POSITIVE),
    (1e-3j, TypeError, "must be a number; given 0.001j", POSITIVE),
    (HUGE, ValueError, "must fit into a float", POSITIVE),
    (DAY, TypeError, "must be a number; given datetime", POSITIVE),
]
FEW_POSITIVES = [POSITIVES[k] for k in (0, 3, 4, 6)]
INFINITE = (np.inf, ValueError, "must be positive and finite; given inf", POSITIVE)
LIST = ([1e-6, 1e-6], TypeError, "must be a number; given", POSITIVE)
NONE = (None, TypeError, "must be a number; given None", POSITIVE)
SHORT_ATOL = ([1e-6, 1e-6, 1e-6], WRONG, "must be a number", "give one number, or one for each coordinate")
