"""Wrong arguments of the ready mechanisms."""

from functools import partial

import numpy as np

from tests.bad_input.case import FEW_POSITIVES, INFINITE, POSITIVE, argument, cases_of
from twoloop.mechanisms import ancf_beam, closed_chain, four_bar, n_four_bar, pendulum, very_flexible_beam
from twoloop.mechanisms.ancf_beam import midpoint_deflection


def beam(n_elements=1, **options):
    usual = {"youngs_modulus": 2e6, "amplitude": 0.02, "angular_frequency": 1.0}
    return ancf_beam(n_elements, **{**usual, **options})


APART = "the linkage cannot be assembled.*"
GEOMETRY = "change lengths, ground or theta3"
of_four_bar = cases_of("four_bar")
of_linkage = partial(argument, "four_bar", four_bar)
of_beam = partial(argument, "ancf_beam", beam)
MECHANISMS = [
    *of_linkage(
        "lengths",
        ((1.0, 2.0), ValueError, r"must have shape \(3,\)", "give three lengths"),
        ((1.0, -2.0, 1.5), ValueError, "must be positive", "give positive lengths"),
        ((1.0, np.nan, 1.5), ValueError, "must be finite", "give finite lengths"),
        (("a", "b", "c"), TypeError, "must be an array of real numbers", "give three numbers"),
        ((True, 2.0, 1.5), TypeError, "must be an array of real numbers", "give three numbers"),
    ),
    *of_linkage("ground", *FEW_POSITIVES, (np.inf, ValueError, "must be finite; given inf", "give metres")),
    *of_linkage("theta3", (np.inf, ValueError, "must be finite; given inf", "give an angle, rad"), ("flat", TypeError, "must be a number; given 'flat'", "give an angle, rad"), (None, TypeError, "must be a number; given None", "give an angle, rad")),
    *of_linkage("branch", (0, ValueError, "must be 1 .*or -1 .*given 0", "give 1 or -1"), ("up", ValueError, "must be 1 .*or -1 .*given 'up'", "give 1 or -1"), (True, ValueError, "must be 1 .*or -1 .*given True", "give 1 or -1")),
    of_four_bar("bars too short", lambda: four_bar((1.0, 1.0, 0.5), 5.0), f"{APART} 4.5 m .*0 and 2 m", GEOMETRY),
    of_four_bar("bars too long", lambda: four_bar((3.0, 1.0, 0.5), 1.0), f"{APART} 0.5 m .*2 and 4 m", GEOMETRY),
    of_four_bar("bars in one line", lambda: four_bar((1.0, 1.0, 1.0), 3.0), f"{APART} 2 m .*ends excluded", GEOMETRY),
    *of_beam("n_elements", (0, ValueError, "must be at least 1; given 0", "give an int of at least 1"), (2.5, TypeError, "must be an int; given 2.5", "give an int of at least 1")),
    *of_beam("start", *[(start, ValueError, "must be 'node'", "take one of the values named") for start in ("tip", ["node"])]),
    *of_beam("youngs_modulus", *FEW_POSITIVES, INFINITE),
    *of_beam("length", *FEW_POSITIVES[:2]),
    *of_beam("amplitude", (np.inf, ValueError, "must be finite; given inf", "give metres")),
    *of_beam("poisson_ratio", *[(nu, ValueError, "must lie between -1 and 0.5", "give 0.3, say") for nu in (-1.0, 0.5)]),
    *of_beam("poisson_ratio", (np.nan, ValueError, "must be finite", "give 0.3, say")),
    *of_beam("angular_frequency", *FEW_POSITIVES[:1]),
    *of_beam("density", *FEW_POSITIVES[:1]),
    *of_beam("height", (-0.02, ValueError, "must be positive", POSITIVE)),
    *of_beam("width", INFINITE),
    *of_beam("gravity", (-9.81, ValueError, "must be at least 0", "gravity acts along -y")),
    *argument("very_flexible_beam", very_flexible_beam, "n_elements", ("4", TypeError, "must be an int", "give an int")),
    cases_of("midpoint_deflection")("a beam of an odd number of elements", lambda: midpoint_deflection(beam(1).q0)).says("q must be of an even number of elements.*given 1", "take an even number of elements"),
    *argument("closed_chain", closed_chain, "n", (1, ValueError, "must be at least 2; given 1", "give an int from 2 to 20"), (21, ValueError, "must be at most 20.*given 21", "give an int from 2 to 20"), (4.0, TypeError, "must be an int", "give an int from 2 to 20")),
    *argument("n_four_bar", n_four_bar, "n", (0, ValueError, "must be at least 1", "give a number of windows")),
    *argument("n_four_bar", n_four_bar, "coordinates", ("angles", ValueError, "must be one of tips, bodies", "take one of the values named")),
    *argument("pendulum", pendulum, "start", (0.5, ValueError, "must be -1 or 1", "give the side it starts from")),
]
