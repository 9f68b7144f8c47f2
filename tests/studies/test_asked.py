"""Who was asked for what: no miss is made of our limits, no solver is alone before all were asked."""

import pandas as pd
import pytest

from studies.bench import headline, tables
from studies.bench.render import render
from studies.work_precision import rivals
from studies.work_precision import study as work_precision
from tests.studies.test_tables import rows
from twoloop.rows.equal_error import LOOSEST

ERROR = 1e-6


def runs(*lines):
    """Rows of (tolerance, error or None, status) of a rival."""
    made = rows(*(("rival", error, 0.1) for _, error, _ in lines))
    return made.assign(
        tol=[tol for tol, *_ in lines],
        status=[status for *_, status in lines],
        family="theirs",
        times=[(0.1,) * 5] * len(lines),
    )


END, LIMIT, FAILED = "REACHED_END", "TIME_LIMIT", "SOLVER_FAILED"


@pytest.mark.parametrize(
    ("lines", "missed"),
    [
        ([(1e-3, 1e-3, END), (1e-5, None, LIMIT)], False),  # stopped by us
        ([(1e-3, 1e-3, END), (1e-5, None, LIMIT), (1e-7, None, FAILED)], False),
        ([(1e-3, None, LIMIT)], False),
        ([(1e-3, None, FAILED), (1e-5, None, FAILED)], False),  # tighter ones may do better
        ([(1e-3, None, FAILED), (tables.TIGHTEST, None, FAILED)], True),
        ([(1e-3, None, LIMIT), (1e-5, 1e-3, END), (tables.TIGHTEST, 1e-4, END)], True),  # only a loose run was stopped
        ([(1e-3, 1e-3, END), (1e-5, None, FAILED)], True),
        ([(1e-3, 1e-3, END), (1e-5, 1e-4, END)], False),  # not asked for more
        ([(1e-3, 1e-3, END), (1e-5, 1e-7, END), (1e-7, None, FAILED)], False),  # it gets there
    ],
)
def test_a_solver_misses_what_it_was_asked_for_to_its_end(lines, missed):
    assert tables.missed(runs(*lines), ERROR) is missed


@pytest.mark.parametrize("message", ["100000 steps were not enough. Raise most_steps", "CV_TOO_MUCH_WORK at t = 1"])
def test_the_most_steps_that_an_adapter_allows_are_a_limit_of_ours(message):
    made = runs((1e-3, 1e-3, END), (1e-5, None, FAILED))
    assert tables.missed(made, ERROR)
    made.loc[1, "message"] = message
    assert not tables.missed(made, ERROR)


def standing_beside(*rivals):
    ours = rows(("auto", 1e-7, 0.1)).assign(tol=LOOSEST, times=[(0.1,) * 5])
    named = [own.assign(solver=f"rival {k}") for k, own in enumerate(rivals)]
    return headline.of_errors(pd.concat([ours, *named], ignore_index=True), [ERROR])[0]["auto"]["verdict"]


def test_ours_is_alone_only_if_all_that_were_put_were_asked_to_their_end():
    to_the_end, ended = runs((tables.TIGHTEST, 1e-4, END)), runs((1e-3, 1e-3, END))
    refused = runs((1e-3, None, "RAISED"))
    assert standing_beside(to_the_end) == standing_beside(to_the_end, refused) == "alone"
    assert standing_beside(to_the_end, ended) == standing_beside(refused) == "unasked"
    assert standing_beside(to_the_end, runs((1e-3, None, LIMIT))) == "unasked"


def test_how_many_rivals_could_be_put_is_counted():
    """Refusals, by our adapters or for want of a package, are not counted; a run that failed is."""
    ours = rows(("auto", 1e-7, 0.1)).assign(tol=1e-3)
    there = [runs((1e-3, None, status)).assign(solver=f"rival {status}") for status in (END, LIMIT, FAILED)]
    refused = [
        runs((1e-3, None, status)).assign(solver=f"rival {k}") for k, status in enumerate(("RAISED", "NOT_AVAILABLE"))
    ]
    some = pd.concat([ours, *there, *refused]).assign(case="hoist")
    alone = ours.assign(case="robot")
    every = pd.concat([ours, *there, *(own.assign(status=FAILED) for own in refused)]).assign(case="crane")
    found = rivals.put(pd.concat([some, alone, every], ignore_index=True))
    assert found == {"n": 5, "least": 0, "mechanisms": 3, "counts": tables.LEAST, "nearly": tables.NEARLY}
    assert rivals.put(every)["least"] == 5
    text = render("against", {}, {}, put=found, names="heyoka")
    assert text.startswith("0 to 5 rival configurations for each mechanism (heyoka)")
    assert render("against", {}, {}, put=rivals.put(every), names="heyoka").startswith("all 5 rival configurations (")


def test_pairs_that_were_refused_or_not_asked_for_all_are_counted_apart():
    """One that fails by itself, or gets to the tightest tolerance, was asked for all."""
    pairs = {
        "to the end": ((1e-3, 1e-3, END), (tables.TIGHTEST, 1e-12, END)),
        "failed": ((1e-3, 1e-3, END), (1e-5, 1e-5, END), (1e-7, None, FAILED)),
        "stopped": ((1e-3, 1e-3, END), (1e-5, None, LIMIT)),
        "loose": ((1e-3, 1e-3, END),),
        "refused": ((1e-3, None, "NOT_APPLICABLE"),),
    }
    made = [runs(*lines).assign(solver=name, case="hoist") for name, lines in pairs.items()]
    ours = rows(("auto", 1e-7, 0.1)).assign(tol=1e-3, case="hoist")
    found = work_precision.asked(pd.concat([ours, *made], ignore_index=True))
    assert (found["n"], found["refused"], found["fewer"]) == (5, 1, 2)
