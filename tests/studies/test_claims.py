"""Verdicts follow from rows: they turn when the rows do, a missing row is "not run", and no verdict is typed in."""

import itertools

import numpy as np
import pandas as pd
import pytest

from studies.beam import runs
from studies.bench.cli import StudyError
from studies.bench.solvers import IRK, NEWMARK, QUARTER
from studies.claims import beam_judges, experiments, judges
from studies.claims import study as claims
from studies.claims.explicit import kind_of
from studies.claims.rows import STUDIES, Rows, processors, read
from studies.claims.study import JUDGES, judged
from studies.claims.verdicts import Claim, Judgement, Verdict, load
from studies.table3.causes import PAPER_IRK, PAPER_NEWMARK, TOLERANCES
from tests.studies.claim_rows import EXPERIMENTS, MADE

CLAIMS = load()
HOLDS, PART, FAILS, ASSUMED, CONSISTENT, CIRCULAR, CHOICE, NOT_RUN = Verdict


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Rows of a full run, made up, and the report on them."""
    out = tmp_path_factory.mktemp("claims")
    for name, make in MADE.items():
        rows = make()
        (out / f"{name}.csv").write_text(f"# full {name}; made up; 2026-01-01; commit 0\n{rows.to_csv(index=False)}")
    patch = pytest.MonkeyPatch()
    patch.setattr(experiments, "make", lambda quick: EXPERIMENTS)
    claims.main(["--out", str(out)])
    patch.undo()
    return out


@pytest.fixture(scope="module")
def whole(folder):
    return read(folder)


@pytest.fixture
def tables(whole):
    return {name: table.copy() for name, table in whole.items()}


EXPECTED = {
    **dict.fromkeys(("more_efficient", "because_of_order", "energy_bounds_y3", "projection_exact"), PART),
    **dict.fromkeys(("tolerances_and_steps", "values_alone", "general"), PART),
    **dict.fromkeys(("implicit_needed", "symplectic_stable", "euler_predictor", "partition_kept"), PART),
    **dict.fromkeys(("gstiff_short", "gstiff_long", "parting"), CONSISTENT),
    **dict.fromkeys(("fourteen_times", "table_3_seconds", "soft_step", "beam_seconds"), ASSUMED),
    "stiff_step": CONSISTENT,
    **dict.fromkeys(("richardson", "difference_is_the_error", "limit_reset_34"), CHOICE),
    "low_index_fails": PART,
    **dict.fromkeys(("newmark_tolerances", "newmark_star"), CIRCULAR),
    **dict.fromkeys(("index_1_drifts", "constraints_kept", "agree_and_reach", "large_steps", "works_long"), HOLDS),
    **dict.fromkeys(("beams_work", "dependents_in_the_loop", "newmark_symplectic", "baumgarte_inexact"), HOLDS),
    "extra_multipliers": HOLDS,
    "stiff_applicable": PART,
    **dict.fromkeys(("grows_a_lot", "any_method", "nonholonomic"), HOLDS),
}


def test_verdicts_of_the_made_up_rows(tables):
    found = {key: each.verdict for key, (_, each) in judged(Rows(tables, EXPERIMENTS)).items()}
    assert found == {key: EXPECTED.get(key, FAILS) for key in found}


FLIPS = [  # claim, study, rows, changes, verdict then
    ("low_index_fails", "motion", "group == 'GSTIFF stand-in'", {"astray": True}, CONSISTENT),
    ("low_index_fails", "motion", "group == 'GSTIFF stand-in'", {"astray": False}, FAILS),
    ("index_1_drifts", "table3", "solver.str.startswith('DOP')", {"violation_late": 1e-15}, PART),
    ("index_1_drifts", "table3", "solver == solver", {"violation_late": 1e-15}, FAILS),
    ("baumgarte_inexact", "violation", "group == 'tolerances' and tol == 1e-8", {"violation_q": 1e-14}, PART),
    ("baumgarte_inexact", "violation", "group == 'tolerances'", {"violation_q": 1e-14}, FAILS),
    ("projection_exact", "table3", "solver == 'IDA, stabilised'", {"violation_q": 0.0}, HOLDS),
    ("projection_exact", "table3", "solver == 'IDA, stabilised' and tol > 1e-13", {"astray": True}, NOT_RUN),
    ("projection_inefficient", "table3", "solver.str.contains('sta|pro')", {"call_s": 9, "n_evaluations": 1e9}, HOLDS),
    ("projection_inefficient", "table3", "solver.str.endswith('1')", {"call_s": 1e-6, "n_evaluations": 1.0}, FAILS),
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
    ("tolerances_and_steps", "table3", "err_in == 1e-3", {"n_steps": 1.0}, PART),
    ("tolerances_and_steps", "table3", "solver == solver", {"n_steps": 9.0}, FAILS),
    ("newmark_tolerances", "table3", "solver == 'PaperNewmark (beta = 1/2)'", {"call_s": 1.0}, FAILS),
    ("irk_tolerances", "table3", "solver == 'PaperIRK' and err_in == 1e-9", {"call_s": 99.0}, HOLDS),
    ("newmark_star", "table3", "solver == 'PaperNewmark (beta = 1/2)'", {"lost": True}, FAILS),
    ("irk_star", "table3", "solver == 'PaperIRK'", {"astray": False, "y3_max": 0.0}, CIRCULAR),
    ("fourteen_times", "table3", "solver == 'PaperIRK'", {"call_s": 0.01, "n_evaluations": 1e3}, CONSISTENT),
    ("works_long", "motion", "solver == 'PaperIRK'", {"astray": True}, FAILS),
    ("more_efficient", "beam", "solver.str.startswith('PaperNewmark')", {"call_s": 99.0}, HOLDS),
    ("more_efficient", "table3", "solver.str.startswith('PaperNewmark')", {"call_s": 1e-6}, FAILS),
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
    ("jacobian_difficult", "Newton over fixed point, linkage", 2.0, PART),
    ("newmark_symplectic", "Newmark's area", 1e-3, FAILS),
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
    claim = next(claim for claim in CLAIMS if claim.key == key)
    return claim.judgement(JUDGES[claim.judge], Rows(tables, numbers)).verdict


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
    table = tables["table3"]
    for group, paper in (("Table 3: IRK", PAPER_IRK), ("Table 3: Newmark", PAPER_NEWMARK)):
        for (i, e_in), (j, e_out) in itertools.product(enumerate(TOLERANCES), repeat=2):
            place = (table["group"] == group) & (table["err_in"] == e_in) & (table["err_out"] == e_out)
            table.loc[place, "call_s"] = (paper[i][j] or 1.0) / 10.0
    table = tables["table3"] = table.drop(columns="times")
    assert verdict("table_3_seconds", tables) is CONSISTENT


def test_every_claim_is_seen_to_turn():
    turned = {flip[0] for flip in FLIPS} | {flip[0] for flip in OTHER_NUMBERS} | {"table_3_seconds"}
    assert turned == {claim.key for claim in load() if not claim.choice}


@pytest.mark.parametrize(
    ("key", "number", "value"),
    [
        ("richardson", "share of the step for the estimate", 0.05),
        ("difference_is_the_error", "estimate over error", 1.1),
    ],
)
def test_what_the_paper_chose_has_a_number_and_no_verdict(key, number, value, tables):
    claim = next(claim for claim in CLAIMS if claim.key == key)
    found = [claim.judgement(JUDGES[claim.judge], Rows(tables, EXPERIMENTS | more)) for more in ({}, {number: value})]
    assert [each.verdict for each in found] == [CHOICE, CHOICE] and len({claim.text(each) for each in found}) == 2
    assert beam_judges.limit_reset_34(Rows(tables, {})).verdict is FAILS
    few = with_changed(tables, "beam", "solver == 'PaperIRK'", {"n_rejected_convergence": 1.0})
    assert beam_judges.limit_reset_34(Rows(few, {})).verdict is HOLDS
    n_choices = sum(claim.choice for claim in CLAIMS)
    assert claims.findings_of(judged(Rows(tables, EXPERIMENTS)))["n"] == len(CLAIMS) - n_choices and n_choices == 3


def test_errors_of_the_beams_are_compared_as_they_are(tables):
    """PaperIRK has no run as bad as the errors: of Newmark's the cheapest counts that is as good, and it is said."""
    found = judges.more_efficient(Rows(tables, EXPERIMENTS)).values
    assert found["unequal"] and found["soft_error"] == 1e-9 and found["soft"] == pytest.approx([0.4, 3.2])
    near = with_changed(tables, "beam", "solver == 'PaperIRK'", {"error_q": 1e-8})
    assert not judges.more_efficient(Rows(near, EXPERIMENTS)).values["unequal"]


def test_a_run_on_momenta_is_said_not_to_drift_for_what_it_is(tables):
    found = judges.symplectic_stable(Rows(tables, EXPERIMENTS)).values
    assert (found["on_momenta"], found["steady_on_momenta"], found["steady_fixed_on_one"]) == (1, 1, True)
    other = with_changed(tables, "energy", "variables == 'momenta'", {"case": "switching"})
    assert not judges.symplectic_stable(Rows(other, EXPERIMENTS)).values["steady_fixed_on_one"]


def test_without_rows_nothing_is_judged():
    assert all(each.verdict is NOT_RUN and each.why for _, each in judged(Rows({}, {})).values())


@pytest.mark.parametrize("every", [40, pytest.param(1, marks=pytest.mark.slow)])
def test_a_missing_solver_is_not_run_and_never_an_exception(tables, every):
    solvers = sorted({str(solver) for table in tables.values() for solver in table["solver"].unique()})
    for solver in {*solvers[::every], IRK, NEWMARK, QUARTER, "DOP853, projected"}:
        judged(Rows({name: table[table["solver"] != solver] for name, table in tables.items()}, EXPERIMENTS))


@pytest.mark.slow
@pytest.mark.parametrize("name", STUDIES)
def test_a_missing_column_or_row_is_not_run_and_never_an_exception(name, tables):
    table = tables[name]
    whole = {key: each.verdict for key, (_, each) in judged(Rows(tables, EXPERIMENTS)).items()}
    for column in table.columns:
        found = judged(Rows({**tables, name: table.drop(columns=column)}, EXPERIMENTS))
        assert all(each.verdict in (whole[key], NOT_RUN) for key, (_, each) in found.items()), column
    for k in range(0, len(table), 7):
        judged(Rows({**tables, name: table.drop(index=k)}, EXPERIMENTS))


def test_quick_rows_do_not_answer_what_is_about_long_runs(tables):
    short = {name: table.assign(t_end=0.1) for name, table in tables.items()}
    found = {key: each.verdict for key, (_, each) in judged(Rows(short, EXPERIMENTS)).items()}
    of_experiments = {flip[0] for flip in OTHER_NUMBERS} | {claim.key for claim in CLAIMS if claim.choice}
    assert found["limit_reset_34"] is NOT_RUN
    assert {key for key, verdict in found.items() if verdict is not NOT_RUN} <= of_experiments


def test_the_file_of_claims_is_complete():
    entries = load()
    assert 30 <= len(entries) <= 50 and len({claim.statement for claim in entries}) == len(entries)
    named = {
        name
        for module in (judges, beam_judges)
        for name, each in vars(module).items()
        if getattr(each, "__module__", "") == module.__name__
    }
    assert {claim.judge for claim in entries} == {name for name in named if not name.startswith("_")}
    for claim in entries:
        assert claim.fixed in ("before", "after") and claim.criterion and claim.section and claim.number


def test_circular_and_stand_in_limit_the_verdict():
    def verdict(found, **marks):
        claim = Claim("key", "1", "It is so.", "It is.", "before", "judge", "{x}", **marks)
        return claim.judgement(lambda rows: Judgement(found, {"x": 1.0}), Rows({}, {})).verdict

    assert verdict(HOLDS) is HOLDS
    assert verdict(HOLDS, circular="it was read so") is CIRCULAR and verdict(FAILS, circular="x") is FAILS
    assert verdict(HOLDS, stand_in="another") is CONSISTENT and verdict(FAILS, stand_in="another") is FAILS
    assert verdict(PART, stand_in="another") is PART
    assert verdict(FAILS, inputs="geometry") is ASSUMED and verdict(HOLDS, inputs="geometry") is CONSISTENT
    assert {verdict(each, choice=True) for each in (HOLDS, PART, FAILS)} == {CHOICE}


def test_report_rows_and_findings(folder):
    texts = [(folder / f"{name}.md").read_text() for name in ("claims", "claims_that_hold")]
    text, rows = "".join(texts), pd.read_csv(folder / "claims.csv", comment="#")
    for claim in load():
        assert text.count(f" *{claim.statement}*") == 1 and claim.number[0].isupper() | (claim.number[0] == "{")
        assert claim.statement[-1] == claim.number[-1] == "."
        row = rows[rows["claim"] == claim.key].iloc[0]
        assert (
            (row["verdict"].capitalize() in text or claim.choice)
            and row["number"] in text
            and row["criterion"] == claim.criterion
        )
    assert "nan" not in text and (folder / "errata.md").exists() and max(len(each.split()) for each in texts) < 1000


def test_every_report_begins_with_question_run_and_answer(folder):
    for name in ("claims", "claims_that_hold", "errata"):
        begin = (folder / f"{name}.md").read_text().split("\n## ")[0].split("**Holds**")[0]
        places = [begin.index(f"**{word}**") for word in ("Question", "Run", "Answer")]
        assert places == sorted(places)
    rows = pd.read_csv(folder / "claims.csv", comment="#")
    n = rows["verdict"].value_counts()
    claimed, held = len(rows) - n["choice of the paper"], (folder / "claims_that_hold.md").read_text()
    assert f"of {claimed} claims {n['holds']} hold, {n['consistent']} are consistent with our runs, " in held
    assert f"; {n['choice of the paper']} of its statements are choices." in held
    assert f"each of {claimed} claims is judged" in (folder / "claims.md").read_text()
    places = [line for line in (folder / "errata.md").read_text().splitlines() if line.startswith("| ")]
    n_places = len(places) - 3  # but the headings of three tables
    n_read = sum(line.endswith("| – |") for line in places)
    assert f"of {n_places} places, {n_places - n_read} are checked by a test each" in (folder / "errata.md").read_text()


def test_report_is_written_again_from_rows(folder):
    text = (folder / "claims.md").read_text()
    claims.main(["--redraw", "--out", str(folder)])
    assert (folder / "claims.md").read_text() == text


@pytest.mark.slow
def test_experiments_are_what_the_judges_read(monkeypatch):
    """Their names, from a quick run."""
    assert set(experiments.make(True)) == set(EXPERIMENTS)


def test_the_processors_are_those_of_the_rows_and_not_of_who_draws_them(tmp_path):
    for name, machine in (("table3", "Z80"), ("beam", "6502"), ("energy", "Z80")):
        first = f"# full {name}; `python -m studies.{name}`; 2026-01-01; commit abc; {machine}, 2 cores; Linux"
        (tmp_path / f"{name}.csv").write_text(f"{first}\nsolver\na\n")
    assert processors(tmp_path) == {"Z80": ["table3", "energy"], "6502": ["beam"]}


def test_every_solver_of_the_beams_is_explicit_or_not():
    """CyRK's DOP853 was once compared as an implicit method, as it stood in no list."""
    kinds = {name: kind_of(name) for name in runs.solvers()}
    assert kinds["CyRK, DOP853"] == kinds["heyoka"] == "explicit" and kinds["CyRK, Radau"] == "Newton"
    with pytest.raises(StudyError, match="whether 'another' is explicit is not known"):
        kind_of("another")
