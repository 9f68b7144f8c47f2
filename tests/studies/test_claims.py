"""Verdicts follow from rows: they turn when the rows do, and a missing row is "not run"."""

import itertools
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from studies.bench.cli import StudyError
from studies.claims import judges
from studies.claims import study as claims
from studies.claims import study as experiments
from studies.claims.judges import BEAMS, Claim, Judgement, Rows, Verdict, kind_of, load, read
from studies.claims.study import JUDGES, judged
from studies.reproduction import beam
from studies.table3 import PAPER_IRK, PAPER_NEWMARK, TOLERANCES
from tests.studies.claim_rows import EXPERIMENTS, MADE
from twoloop import paper_irk, solve_dae
from twoloop.mechanisms import four_bar

CLAIMS = {claim.key: claim for claim in load()}
HOLDS, PART, FAILS, CONSISTENT, ASSUMED, CIRCULAR, NOT_RUN = Verdict


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Rows of a full run, made up, and the report on them."""
    out = tmp_path_factory.mktemp("claims")
    for name, make in MADE.items():
        rows = make()
        (out / f"{name}.csv").write_text(f"# full {name}; made up; 2026-01-01; commit 0\n{rows.to_csv(index=False)}")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(experiments, "make", lambda quick: EXPERIMENTS)
        claims.main(["--out", str(out)])
    return out


@pytest.fixture(scope="module")
def whole(folder):
    return read(folder)


@pytest.fixture
def tables(whole):
    return {name: table.copy() for name, table in whole.items()}


EXPECTED = {
    **dict.fromkeys(("more_efficient", "because_of_order", "energy_bounds_y3", "projection_exact"), PART),
    **dict.fromkeys(("tolerances_and_steps", "values_alone", "general", "low_index_fails", "stiff_applicable"), PART),
    **dict.fromkeys(("implicit_needed", "symplectic_stable", "euler_predictor", "partition_kept"), PART),
    **dict.fromkeys(("gstiff_short", "gstiff_long", "parting", "stiff_step"), CONSISTENT),
    **dict.fromkeys(("fourteen_times", "table_3_seconds", "soft_step", "beam_seconds"), ASSUMED),
    **dict.fromkeys(("newmark_tolerances", "newmark_star"), CIRCULAR),
    **dict.fromkeys(("index_1_drifts", "constraints_kept", "agree_and_reach", "large_steps", "works_long"), HOLDS),
    **dict.fromkeys(("beams_work", "dependents_in_the_loop", "newmark_symplectic", "baumgarte_inexact"), HOLDS),
    **dict.fromkeys(("extra_multipliers", "grows_a_lot", "any_method", "nonholonomic"), HOLDS),
}


def test_verdicts_of_the_made_up_rows(tables):
    found = {key: judgement.verdict for key, (_, judgement) in judged(Rows(tables, EXPERIMENTS)).items()}
    assert found == {key: EXPECTED.get(key, FAILS) for key in found}


T3 = "table3_full"
FLIPS = [  # claim, study, rows, changes, verdict then
    ("low_index_fails", "motion", "group == 'GSTIFF stand-in'", {"astray": True}, CONSISTENT),
    ("low_index_fails", "motion", "group == 'GSTIFF stand-in'", {"astray": False}, FAILS),
    ("index_1_drifts", T3, "solver.str.startswith('DOP')", {"violation_late": 1e-15}, PART),
    ("index_1_drifts", T3, "solver == solver", {"violation_late": 1e-15}, FAILS),
    ("baumgarte_inexact", "violation", "group == 'tolerances' and tol == 1e-8", {"violation_q": 1e-14}, PART),
    ("baumgarte_inexact", "violation", "group == 'tolerances'", {"violation_q": 1e-14}, FAILS),
    ("projection_exact", T3, "solver == 'IDA, stabilised'", {"violation_q": 0.0}, HOLDS),
    ("projection_exact", T3, "solver == 'IDA, stabilised' and tol > 1e-13", {"astray": True}, NOT_RUN),
    ("projection_inefficient", T3, "solver.str.contains('sta|pro')", {"call_s": 9, "n_evaluations": 1e9}, HOLDS),
    ("projection_inefficient", T3, "solver.str.endswith('1')", {"call_s": 1e-6, "n_evaluations": 1.0}, FAILS),
    ("jacobian_difficult", "beam", "solver == 'SunRadau5'", {"call_s": 99.0}, PART),
    ("constraints_kept", "violation", "solver == 'PaperIRK'", {"growth_q": 1.0, "late_q": 1e-13}, FAILS),
    ("constraints_kept", "violation", "solver == 'PaperIRK'", {"violation_a": 1e-9}, FAILS),
    ("stiff_applicable", "beam", "case == 'moderately stiff'", {"h_median": 1e-2}, HOLDS),
    ("stiff_applicable", "beam", "case == 'moderately stiff'", {"error_q": 0.1}, FAILS),
    ("symplectic_stable", "energy", "solver == solver", {"slope": 0.0}, HOLDS),
    ("symplectic_stable", "energy", "solver == 'PaperIRK'", {"slope": -1.0}, FAILS),
    ("symplectic_stable", "energy", "solver == 'PaperIRK'", {"lost": True}, FAILS),
    ("newmark_symplectic", "energy", "solver.str.startswith('Newmark')", {"slope": -1e-6}, FAILS),
    ("parting", "beam", "group == 'sensitivity'", {"before": 0.03}, FAILS),
    ("parting", "beam", "group == 'sensitivity'", {"largest": 0.03}, FAILS),
    ("agree_and_reach", "motion", "solver == 'PaperIRK'", {"top": 0.01}, PART),
    ("agree_and_reach", "motion", "solver == 'PaperIRK'", {"error_y3_short": 0.1}, FAILS),
    ("gstiff_short", "motion", "h == 0.02", {"error_y3_short": 1e-3}, FAILS),
    ("gstiff_long", "motion", "h == 0.01", {"error_y3": 1e-3}, FAILS),
    ("stand_in_as_foil", "motion", "h > 0", {"call_s": 99.0}, CONSISTENT),
    ("large_steps", "step_size", "solver == 'PaperIRK'", {"share_time": 0.4}, PART),
    ("tolerances_and_steps", T3, "err_in == 1e-3", {"n_steps": 1.0}, PART),
    ("tolerances_and_steps", T3, "solver == solver", {"n_steps": 9.0}, FAILS),
    ("newmark_tolerances", T3, "solver == 'PaperNewmark (beta = 1/2)'", {"call_s": 1.0}, FAILS),
    ("irk_tolerances", T3, "solver == 'PaperIRK' and err_in == 1e-9", {"call_s": 99.0}, HOLDS),
    ("newmark_star", T3, "solver == 'PaperNewmark (beta = 1/2)'", {"lost": True}, FAILS),
    ("irk_star", T3, "solver == 'PaperIRK'", {"astray": False, "y3_max": 0.0}, CIRCULAR),
    ("fourteen_times", T3, "solver == 'PaperIRK'", {"call_s": 0.01, "n_evaluations": 1e3}, CONSISTENT),
    ("works_long", "motion", "solver == 'PaperIRK'", {"astray": True}, FAILS),
    ("more_efficient", "beam", "solver.str.startswith('PaperNewmark')", {"call_s": 99.0}, HOLDS),
    ("more_efficient", T3, "solver.str.startswith('PaperNewmark')", {"call_s": 1e-6}, FAILS),
    ("because_of_order", "beam", "solver.str.startswith('PaperNewmark')", {"call_s": 99.0}, HOLDS),
    ("implicit_needed", "beam", "solver.str.startswith('DOP')", {"n_evaluations": 1e9, "call_s": 99.0}, HOLDS),
    ("implicit_needed", "beam", "solver == 'TRBDF2'", {"n_evaluations": 1e9, "call_s": 99.0}, FAILS),
    ("soft_step", "beam", "solver == 'PaperIRK'", {"h_median": 1e-3}, CONSISTENT),
    ("stiff_step", "beam", "solver == 'PaperIRK'", {"h_median": 1e-3}, ASSUMED),
    ("beams_work", "beam", "case == 'very flexible'", {"error_q": 0.1}, PART),
    ("grows_a_lot", "beam", "solver == 'PaperIRK'", {"call_s": 1.0}, FAILS),
    ("beam_seconds", "beam", "case == 'moderately stiff'", {"call_s": 111.6}, CONSISTENT),
    ("beams_work", "beam", "case == 'very flexible'", {"error_q": np.nan}, NOT_RUN),
    ("extra_multipliers", "ablation", "solver == 'stabilised index 2' and tol == 1e-2", {"n_evaluations": 99.0}, PART),
    ("extra_multipliers", "ablation", "solver == 'stabilised index 2'", {"call_s": 0.01}, FAILS),
    ("dependents_in_the_loop", "ablation", "solver == 'dependents frozen'", {"n_evaluations": 1.0}, PART),
    ("dependents_in_the_loop", "ablation", "solver != 'dependents frozen'", {"error_q": 1.0}, NOT_RUN),
]  # fmt: skip
OTHER_NUMBERS = [
    ("euler_predictor", "iterations from the step before", 8.0, HOLDS),
    *(("jacobian_difficult", f"Newton over fixed point, {case}", 2.0, PART) for case in ("linkage", *BEAMS)),
    ("partition_kept", "partitions mostly kept", 18.0, HOLDS),
    ("partition_kept", "partitions mostly kept", 3.0, FAILS),
    ("energy_bounds_y3", "linkages passing", 0.0, HOLDS),
    ("energy_bounds_y3", "highest y3, assumed", 0.01, FAILS),
    ("any_method", "methods of their order", 9.0, PART),
    ("values_alone", "calls differenced", 4.0, HOLDS),
    ("values_alone", "difference", 1e-3, FAILS),
    ("general", "mechanisms right", 21.0, HOLDS),
    ("general", "mechanisms right", 3.0, FAILS),
    ("nonholonomic", "non-holonomic error", 1.0, PART),
]


def verdict(key, tables, numbers=EXPERIMENTS):
    return CLAIMS[key].judgement(JUDGES[CLAIMS[key].judge], Rows(tables, numbers)).verdict


def with_changed(tables, study, where, changes):
    table = tables[study].astype({column: object for column in changes})
    place = table.index[table.eval(where, engine="python")]
    assert len(place), where
    for column, value in changes.items():
        table.loc[place, column] = value
    return {**tables, study: table.infer_objects()}


@pytest.mark.parametrize(("key", "study", "where", "changes", "after"), FLIPS)
def test_verdicts_turn_with_the_rows(key, study, where, changes, after, tables):
    assert verdict(key, with_changed(tables, study, where, changes)) is after


@pytest.mark.parametrize(("key", "number", "value", "after"), OTHER_NUMBERS)
def test_verdicts_turn_with_the_experiments(key, number, value, after, tables):
    assert verdict(key, tables, EXPERIMENTS | {number: value}) is after


def test_one_factor_of_the_machine_would_be_seen(tables):
    table = tables["table3_full"]
    for group, paper in (("Table 3: IRK", PAPER_IRK), ("Table 3: Newmark", PAPER_NEWMARK)):
        for (i, e_in), (j, e_out) in itertools.product(enumerate(TOLERANCES), repeat=2):
            place = (table["group"] == group) & (table["err_in"] == e_in) & (table["err_out"] == e_out)
            table.loc[place, "call_s"] = (paper[i][j] or 1.0) / 10.0
    tables["table3_full"] = table.drop(columns="times")
    assert verdict("table_3_seconds", tables) is CONSISTENT


def test_every_claim_is_seen_to_turn():
    assert {flip[0] for flip in (*FLIPS, *OTHER_NUMBERS)} | {"table_3_seconds"} == set(CLAIMS)


def test_the_numbers_are_those_of_the_rows(tables):
    """On the beams PaperIRK has no run as bad as the errors: the cheapest of Newmark's that is as good counts."""
    found = {key: judgement for key, (_, judgement) in judged(Rows(tables, EXPERIMENTS)).items()}
    assert found["more_efficient"].values["soft"] == pytest.approx([0.4, 3.2])
    assert found["beam_seconds"].values["soft"] == pytest.approx(56.27)
    assert (found["symplectic_stable"].values["drifting"], found["symplectic_stable"].values["runs"]) == (2, 2)
    assert CLAIMS["energy_bounds_y3"].text(found["energy_bounds_y3"]) == "10 of 20 linkages pass"


def test_without_rows_nothing_is_judged():
    assert all(judgement.verdict is NOT_RUN and judgement.why for _, judgement in judged(Rows({}, {})).values())


def test_quick_rows_do_not_answer_what_is_about_long_runs(tables):
    short = {name: table.assign(t_end=0.1) for name, table in tables.items()}
    found = {key: judgement.verdict for key, (_, judgement) in judged(Rows(short, EXPERIMENTS)).items()}
    of_experiments = {flip[0] for flip in OTHER_NUMBERS}
    assert {key for key, verdict in found.items() if verdict is not NOT_RUN} <= of_experiments


def test_the_file_of_claims_is_complete():
    returned = {name: getattr(made, "__annotations__", {}).get("return") for name, made in vars(judges).items()}
    judging = {name for name, kind in returned.items() if kind is Judgement} - {"decide"}
    assert {claim.judge for claim in CLAIMS.values()} == judging
    assert all(claim.fixed in ("before", "after") for claim in CLAIMS.values())


def test_circular_and_stand_in_limit_the_verdict():
    def verdict(found, **marks):
        claim = Claim("key", "1", "It is so.", "It is.", "before", "judge", "{x}", **marks)
        return claim.judgement(lambda rows: Judgement(found, {"x": 1.0}), Rows({}, {})).verdict

    assert verdict(HOLDS) is HOLDS
    assert verdict(HOLDS, circular="it was read so") is CIRCULAR and verdict(FAILS, circular="x") is FAILS
    assert verdict(HOLDS, stand_in="another") is CONSISTENT and verdict(FAILS, stand_in="another") is FAILS
    assert verdict(PART, stand_in="another") is PART
    assert verdict(FAILS, inputs="geometry") is ASSUMED and verdict(HOLDS, inputs="geometry") is CONSISTENT


def test_the_report_has_every_claim_once_under_its_verdict(folder):
    text, rows = (folder / "claims.md").read_text(), pd.read_csv(folder / "claims.csv", comment="#")
    for _, row in rows.iterrows():
        assert text.count(f"|{row['statement']}|{row['number']}|\n") == 1
    assert "nan" not in text
    claims.main(["--redraw", "--out", str(folder)])
    assert (folder / "claims.md").read_text() == text


@pytest.mark.slow
def test_experiments_are_what_the_judges_read():
    """Their names, from a quick run."""
    assert set(experiments.make(True)) == set(EXPERIMENTS)
    found = {"iterations of Gauss12": 1234.0, "iterations of BDF": 5.0, "linkages": 6.0}
    assert experiments.iterations_of_procedures(found) == "1,234 (Gauss12), 5 (BDF)"
    assert experiments.iterations_of_procedures({}) == ""


def test_every_solver_of_the_beams_is_explicit_or_not():
    """CyRK's DOP853 was once compared as an implicit method, as it stood in no list."""
    kinds = {name: kind_of(name) for name in beam.line_up()}
    assert kinds["CyRK, DOP853"] == kinds["heyoka"] == "explicit" and kinds["CyRK, Radau"] == "Newton"
    with pytest.raises(StudyError, match="whether 'another' is explicit is not known"):
        kind_of("another")


def test_energy_does_not_bound_y3():
    """The assumed linkage stays below 0, its other assembly does not."""
    found = experiments.passing([(1.0, 2.0, 1.5, 3.0)])
    assert (found["linkages"], found["linkages passing"]) == (2.0, 1.0) and found["highest y3, assumed"] <= 1e-9


def test_orders_see_a_method_below_its_own(monkeypatch):
    monkeypatch.setattr(experiments, "ORDERS", {"TRBDF2": 3, "RadauIIA5": 5})
    assert experiments.orders() == {"methods": 2.0, "methods of their order": 1.0}


@pytest.mark.slow
def test_choices_repeat_where_nothing_moves_and_change_with_the_motion():
    problem = four_bar()
    run = solve_dae(problem.system, (0.0, 3.0), problem.q0, problem.v0, method=paper_irk(), rtol=1e-5, atol=1e-5)
    assert 0.5 < experiments.repeated_choices(problem, run) < 1.0
    still = replace(run, q=np.repeat(run.q[:, :1], run.t.size, axis=1))
    assert experiments.repeated_choices(problem, still) == 1.0


@pytest.mark.slow
def test_outer_loops_differ_in_nothing_else():
    assert experiments.outer_loops()["Newton over fixed point, moderately stiff"] < 0.1
