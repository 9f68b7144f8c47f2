"""The planar slider-crank of the library with a redundant row: free, and driven at a prescribed crank angle.

The redundant row says once more, and not linearly, that the crank pin is as far from the slider as the rod is long.
"""

import numpy as np

from tests.general.mechanism import Mechanism, known, of_functions, of_problem
from tests.mechanisms.motions import planar
from tests.problems import functions_of
from twoloop import mechanisms

DRIVEN = mechanisms.driven_slider_crank()


def redundant_slider_crank():
    """The ready mechanism."""
    return of_problem(mechanisms.redundant_slider_crank(), known(planar.slider_crank(), 2.0), 2.0, rank=8)


def driven_slider_crank(redundant):
    """No freedom is left: the motion is the drive's. With redundant=True there are ten rows for nine coordinates."""
    if not redundant:
        return of_problem(DRIVEN, DRIVEN.motion, 2.0)
    free, driven = mechanisms.redundant_slider_crank().system, DRIVEN.system

    def joined(kind):  # the last row of the other is the drive
        of_free, of_driven = getattr(free, kind), getattr(driven, kind)
        return lambda *state: np.concatenate([of_free(*state), of_driven(*state)[-1:]])

    rows = {kind: joined(kind) for kind in ("constraint", "jacobian", "constraint_rate", "gamma")}
    return Mechanism(
        name="driven slider-crank, redundant",
        system=of_functions(n_q=9, n_c=10, **functions_of(free) | rows),
        end=2.0,
        state=DRIVEN.motion,
        rank=9,
    )
