"""Wrong arguments of the ready mechanisms."""

from functools import partial

import numpy as np

from tests.bad_input.case import FEW_POSITIVES, INFINITE, Case, argument
from twoloop.mechanisms import ancf_beam, four_bar, very_flexible_beam
from twoloop.mechanisms.ancf_beam import midpoint_deflection


def beam(n_elements=1, **options):
    usual = {"youngs_modulus": 2e6, "amplitude": 0.02, "angular_frequency": 1.0}
    return ancf_beam(n_elements, **{**usual, **options})


of_linkage = partial(argument, "four_bar", four_bar)
of_beam = partial(argument, "ancf_beam", beam)
MECHANISMS = [
    *of_linkage(
        "lengths",
        [
            ((1.0, 2.0), ValueError, r"must have shape \(3,\)", "give three lengths"),
            ((1.0, -2.0, 1.5), ValueError, "must be positive", "give positive lengths"),
            ((1.0, np.nan, 1.5), ValueError, "must be finite", "give finite lengths"),
            (("a", "b", "c"), TypeError, "must be an array of real numbers", "give three numbers"),
            ((True, 2.0, 1.5), TypeError, "must be an array of real numbers", "give three numbers"),
        ],
    ),
    *of_linkage("ground", [*FEW_POSITIVES, (np.inf, ValueError, "must be finite; given inf", "give metres")]),
    *of_linkage(
        "theta3",
        [
            (np.inf, ValueError, "must be finite; given inf", "give an angle, rad"),
            ("flat", TypeError, "must be a number; given 'flat'", "give an angle, rad"),
            (None, TypeError, "must be a number; given None", "give an angle, rad"),
        ],
    ),
    *of_linkage(
        "branch",
        [
            (0, ValueError, "must be 1 .*or -1 .*given 0", "give 1 or -1"),
            ("up", ValueError, "must be 1 .*or -1 .*given 'up'", "give 1 or -1"),
            (True, ValueError, "must be 1 .*or -1 .*given True", "give 1 or -1"),
        ],
    ),
    Case(
        "four_bar",
        "bars that cannot be assembled",
        lambda: four_bar((0.1, 0.1, 0.1), 5.0),
        ValueError,
        "the linkage cannot be assembled.*Change lengths, ground or theta3",
        "change lengths, ground or theta3",
    ),
    *of_beam(
        "n_elements",
        [
            (0, ValueError, "must be at least 1; given 0", "give an int of at least 1"),
            (2.5, TypeError, "must be an int; given 2.5", "give an int of at least 1"),
        ],
    ),
    *of_beam("start", [("tip", ValueError, "must be 'node'.*given 'tip'", "take one of these")]),
    *of_beam("youngs_modulus", [*FEW_POSITIVES, INFINITE]),
    *of_beam("length", FEW_POSITIVES[:2]),
    *of_beam("amplitude", [(np.inf, ValueError, "must be finite; given inf", "give metres")]),
    *of_beam("poisson_ratio", [(0.5, ValueError, "must lie between -1 and 0.5", "give 0.3, say")]),
    *of_beam("gravity", [(-9.81, ValueError, "must be at least 0", "gravity acts along -y")]),
    *argument(
        "very_flexible_beam", very_flexible_beam, "n_elements", [("4", TypeError, "must be an int", "give an int")]
    ),
    Case(
        "midpoint_deflection",
        "a beam of an odd number of elements",
        lambda: midpoint_deflection(beam(1).q0),
        ValueError,
        "q must be of an even number of elements.*given 1",
        "take an even number of elements",
    ),
]
