"""Random mechanisms under random short and discontinuous forces: a run is right, or it says that it is not.

Right is what SciPy makes of the same motion in as few coordinates as it has freedoms, by the rule of
`differential_motions.py`, kept in differential_motions.json.
"""

import numpy as np
import pytest

from studies.bench.sharp_forces import KIND, SIZE, A
from studies.bench.sharp_mechanisms import TIMES
from tests.differential_motions import FAMILIES, RIGHT, SILENT, judged, mechanism_of, read
from tests.problems import quick

TIME_LIMIT = 20.0  # s
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
OTHERS = (
    *("Adams", "DOP853", "Gauss4", "Gauss8", "Gauss12", "Gauss16", "SunRadau5", "RadauIIA5", "RadauIIA9", "RadauIIA13"),
    *("TRBDF2", "ESDIRK4", "BDF"),
)
SHORT_CHANGES = ("gust of 3 ms",)  # lasts less than a hundredth of the run, which no method promises to see
MAY_END = ("drive with a kink",)  # whose velocities jump
MOTIONS = read()


def calls(place, n):
    """Names, tolerances, options of the runs of a family: the default, without and with code of its own, n others."""
    names = ["auto", "Taylor", *(OTHERS[(4 * place + k) % len(OTHERS)] for k in range(n))]
    made = [(name, TOLERANCES[(place + k) % len(TOLERANCES)], {}) for k, name in enumerate(names)]
    return made + [(name, tolerance, {"compiled": True}) for name, tolerance, _ in made[:2]]


@pytest.mark.parametrize("family", [family for family in FAMILIES if family not in SHORT_CHANGES])
@pytest.mark.parametrize("n_others", quick([1, 4]))
def test_a_run_is_right_or_says_that_it_is_not(family, n_others):
    n_drawn, known = MOTIONS[family]
    mechanism = mechanism_of(family, n_drawn)
    for name, tolerance, options in calls(FAMILIES.index(family), n_others):
        made = judged(mechanism, known, name, tolerance, TIME_LIMIT, **options)
        told = f"{name}, {options}, at {tolerance:g} on {mechanism.name}: {made}"
        assert made["outcome"] != SILENT, told
        refused = options and made["status"] == "RAISED"  # of equations that branch there is no code
        if name == "auto" and not refused and family not in MAY_END:
            assert made["outcome"] == RIGHT, told


def test_the_rule_sees_a_force_that_is_left_out():
    n_drawn, known = MOTIONS["gust of 100 ms"]
    mechanism = mechanism_of("gust of 100 ms", n_drawn)
    made = judged(mechanism, known, "DOP853", 1e-8, TIME_LIMIT)
    assert made["outcome"] == RIGHT and made["error"] > 0.0
    still = known.q + 2.0 * made["allowed"] * (TIMES[:, None] > 1.0)
    assert judged(mechanism, type(known)(still, 0.0, 1.0), "DOP853", 1e-8, TIME_LIMIT)["outcome"] == SILENT
    assert mechanism.system.parameters[-SIZE:][[KIND, A]].all() and np.isfinite(known.q).all()
