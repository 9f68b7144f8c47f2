"""What was aimed at is judged by the rows."""

import pandas as pd
import pytest

from studies.bench import tables
from studies.bench.collector import Case
from studies.work_precision import goals
from tests.studies.test_rivals import compared, rows
from twoloop.rows.equal_error import LOOSEST


def test_the_default_is_compared_with_the_best_of_ours_wherever_one_gets():
    pair = ("auto", "two-loop", "compiled", 1e-3, 2.0), ("Adams", "two-loop", "compiled", 1e-4, 1.0)
    found = goals.of_default(rows(*pair), False)
    assert (found["n"], found["n_within"], found["n_unreached"]) == (2, 0, 1) and found["worst"] == 2.0
    assert goals.of_default(rows(("auto", "two-loop", "compiled", 1e-3, 2.0)), False)["n_within"] == 1


def test_the_default_with_code_for_the_mechanism_is_compared_with_its_like_only():
    times = {"auto": 2.0, "Adams": 1.0, "auto, compiled": 0.5, "DOP853, compiled": 0.2}
    table = rows(*((solver, "two-loop", "compiled", 1e-3, cpu) for solver, cpu in times.items()))
    without, compiled = goals.findings_of([], table, table)["default"]
    assert (without["solver"], without["worst"]) == ("auto", 2.0)
    assert (compiled["solver"], compiled["worst"]) == ("auto, compiled", 2.5)


def test_the_long_motion_is_judged_at_its_full_length_only():
    table = rows(("Adams", "two-loop", "compiled", 1e-7, 0.02), ("LSODA", "SciPy", "Python", 1e-7, 0.001))
    long, short = (Case("four-bar", None, t_end) for t_end in (100.0, 10.0))
    found = goals.findings_of([long], table, table)["long"]
    assert (found["solver"], found["call_s"]) == ("Adams", pytest.approx(0.02))
    assert goals.findings_of([short], table, table)["long"] is None
    assert goals.findings_of([long], table[1:], table)["long"]["call_s"] is None


ERRORS = goals.BEAM_ERRORS
REACHED, LOOSE = 0.5 * ERRORS[2], 0.5 * ERRORS[1]  # errors of all three, and of two of these


@pytest.mark.parametrize(
    ("ours", "ida", "tol", "ahead", "lost"),
    [
        ((REACHED, 1.0), (REACHED, 1.5), 0.1, True, False),
        ((REACHED, 1.0), (REACHED, 0.9), 0.1, False, True),
        ((REACHED, 1.0), (REACHED, 1.02), 0.1, False, True),  # not by so much that it counts
        ((LOOSE, 1.0), (REACHED, 1.5), 0.1, False, True),  # ahead at two of three, and the third is missed
        ((REACHED, 1.0), (LOOSE, 1.5), 0.1, False, False),  # IDA was not asked for the third
        ((REACHED, 1.0), (LOOSE, 1.5), tables.TIGHTEST, True, False),  # it was
    ],
)
def test_the_stiff_beam_is_compared_with_ida_from_c_at_every_error(ours, ida, tol, ahead, lost):
    case = Case("beam", None, 2.0, tags=("stiff", "vibrations irrelevant"))
    table = rows(
        ("TRBDF2", "two-loop", "compiled", *ours),
        ("IDA from C, stabilised", "SUNDIALS", "compiled", ida[0], 3.0),
        ("IDA from C, order 2, positions tested", "SUNDIALS", "compiled", *ida),
        ("CVODE from C, BDF", "SUNDIALS", "compiled", REACHED, 0.1),
        case="beam",
    )
    table.loc[1:2, "tol"] = tol
    loose = table.loc[1:2].assign(error_q=ERRORS[0], tol=LOOSEST)  # what it costs to miss is told
    (found,) = goals.findings_of([case], pd.concat([table, loose], ignore_index=True), table)["stiff"]
    assert (found["ahead"], found["lost"]) == (ahead, lost)
    assert found["ours_miss"] == ([ERRORS[2]] if ours[0] == LOOSE else [])


def test_violations_are_those_of_ours_on_the_four_bars():
    table = pd.concat([compared(1.0, 2.0), rows(("Adams", "two-loop", "compiled", 1e-3, 1.0), case="beam")])
    table["violation_q"] = [3e-15, 1.0, 1.0, 1.0]
    assert goals.findings_of([], table, table)["violation"]["largest"] == 3e-15
