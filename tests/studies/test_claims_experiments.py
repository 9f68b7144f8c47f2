"""What the small runs behind the claims find, on runs made here; how the report begins."""

import math

import numpy as np
import pandas as pd
import pytest

from studies.bench.render import render
from studies.bench.solvers import NEWMARK, QUARTER
from studies.claims import experiments
from studies.claims.rows import BEAMS, NotRun, Rows
from studies.claims.study import JUDGES, findings_of
from studies.claims.verdicts import Judgement, Verdict, load, span_known
from twoloop import Result, paper_irk, solve_dae
from twoloop.mechanisms import four_bar


def test_line_5_counts_the_criteria_that_were_fixed_afterwards():
    claims = {claim.key: (claim, Judgement(Verdict.FAILS, {})) for claim in load()}
    found = findings_of(claims)
    claimed = [claim for claim in load() if not claim.choice]
    late = sum(claim.fixed == "after" for claim in claimed)
    assert 0 < late < len(claimed) < len(load())
    found["claims"] = {key: {"verdict": "not run"} for key in claims}
    text = render("claims", found, {}, lines=[], stamp="a; b", quick=False)
    assert f"{late} of {len(claimed)} criteria were chosen after seeing the data" in text.splitlines()[4]


def test_energy_does_not_bound_y3():
    """The assumed linkage stays below 0, its other assembly does not, at the same exact energy."""
    found = experiments.passing([(1.0, 2.0, 1.5, 3.0)])
    assert (found["linkages"], found["linkages passing"]) == (2.0, 1.0)
    assert found["highest y3"] == pytest.approx(0.5957, abs=1e-3) and found["energy change"] < 1e-9


def test_newmark_keeps_an_area_with_gamma_of_one_half_only():
    found = experiments.newmark_areas()
    assert found["Newmark's area"] < 1e-12
    assert min(found["Newmark's plain area"], found["Newmark's area, gamma 0.6"]) > 1e-3


def test_orders_see_a_method_below_its_own(monkeypatch):
    monkeypatch.setattr(experiments, "ORDERS", {"TRBDF2": 2, "RadauIIA5": 5})
    assert experiments.orders() == {"methods": 2.0, "methods of their order": 2.0}
    monkeypatch.setattr(experiments, "ORDERS", {"TRBDF2": 3, "RadauIIA5": 5})
    assert experiments.orders()["methods of their order"] == 1.0


def test_choices_repeat_where_nothing_moves_and_change_with_the_motion():
    problem = four_bar()
    run = solve_dae(problem.system, (0.0, 3.0), problem.q0, problem.v0, method=paper_irk(), rtol=1e-5, atol=1e-5)
    assert 0.5 < experiments.repeated_choices(problem, run) < 1.0
    still = Result(**{**vars(run), "q": np.repeat(run.q[:, :1], run.t.size, axis=1)})
    assert experiments.repeated_choices(problem, still) == 1.0


def test_outer_loops_differ_in_nothing_else():
    found = experiments.outer_loops()
    assert set(found) == {f"Newton over fixed point, {x}" for x in ("linkage", "very flexible", "moderately stiff")}
    assert found["Newton over fixed point, moderately stiff"] < 0.1


def test_no_jacobian_is_an_advantage_only_where_it_is_everywhere():
    """All five comparisons decide: two beams by time, and evaluations on these and the linkage."""
    claim = next(claim for claim in load() if claim.key == "jacobian_difficult")
    numbers = {f"Newton over fixed point, {name}": 2.0 for name in ("linkage", *BEAMS)}
    rows = [
        {"group": "run", "case": case, "solver": solver, "tol": 1e-5, "t_end": 2.0, "error_q": 1e-5, "call_s": seconds}
        for case in BEAMS
        for solver, seconds in (("SunRadau5", 2.0), ("PaperIRK", 1.0))
    ]
    table = pd.DataFrame(rows).assign(floor=0.0)

    def verdict(numbers):
        return claim.judgement(JUDGES[claim.judge], Rows({"beam": table}, numbers)).verdict

    assert verdict(numbers) is Verdict.HOLDS
    for key in numbers:
        assert verdict(numbers | {key: 0.5}) is Verdict.PART
    assert "difficult was not tested" in claim.criterion


def test_a_span_leaves_out_what_is_not_known():
    assert span_known([math.nan, 2.0, 1.0]) == [1.0, 2.0]
    with pytest.raises(NotRun, match="no error"):
        span_known([math.nan])


def test_newmark_is_compared_where_no_run_of_it_is_bad():
    """On the stiffer beam stability bounds its steps, and all errors are below 1e-5."""
    slow = {"very flexible": 1e-3, "moderately stiff": 5e-6}
    rows = [
        {"case": case, "solver": solver, "tol": 1e-1, "error_q": error, "call_s": 2.0}
        for case, error in slow.items()
        for solver, error in (("PaperIRK", 1e-9), (NEWMARK, error), (QUARTER, error))
    ]
    beam = pd.DataFrame(rows).assign(group="run", t_end=2.0, floor=0.0)
    names = ("PaperIRK, Atol = Rtol varied", NEWMARK, QUARTER)
    linkage = pd.DataFrame([{"solver": name, "error_q": e, "call_s": 1.0} for name in names for e in (0.2, 0.02)])
    linkage = linkage.assign(problem=four_bar().name, t_end=100.0, floor=0.0, err_in=np.nan)
    beam.loc[(beam["case"] == "moderately stiff") & (beam["solver"] != "PaperIRK"), "tol"] = 1e-3
    claim = next(claim for claim in load() if claim.key == "more_efficient")
    found = claim.judgement(JUDGES[claim.judge], Rows({"beam": beam, "table3": linkage.assign(tol=1e-3)}, {}))
    assert found.verdict is not Verdict.NOT_RUN and found.values["stiff"] == [1.0, 1.0]
