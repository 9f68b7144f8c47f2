"""Verdicts follow from rows: they change when the rows do, need no column that is not named, and are never typed in."""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from studies import claims
from studies.claims import CLAIMS, SOURCES
from studies.claims_report import judged, summary
from studies.claims_verdicts import Verdict
from studies.report import REPORTS, load_rows, save_rows
from tests.studies.claims_rows import beam, energy, motion, step_size, violation

HOLDS, CONDITIONS, FAILS, UNCHECKED = Verdict
KEYS = {"group", "solver", "problem", "err_in", "err_out", "h", "tol", "check", "case", "setting"}
KEYS |= {"geometry", "variables", "partition", "t_end"}  # they pick rows and name runs
DIFFERENT = (0.0, 1e9, 9.0, -1e9, True, False, "NOT_CONVERGED")


def claim(words):
    """The one claim whose statement contains these words."""
    found = [each for each in CLAIMS if words in each.statement]
    assert len(found) == 1, (words, [each.statement for each in found])
    return found[0]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Rows as after a full run: Table 3 as reported, the others made up; then a quick run of this study."""
    out = tmp_path_factory.mktemp("claims")
    for name, rows in {
        "motion": motion(),
        "step_size": step_size(),
        "violation": violation(),
        "energy": energy(),
        "beam": beam(),
    }.items():
        save_rows(out / f"{name}.csv", rows, "made up")
    (out / "table3.csv").write_text((REPORTS / "table3.csv").read_text())
    claims.main(["--quick", "--out", str(out)])
    return out


@pytest.fixture
def rows(folder):
    return {name: load_rows(folder / f"{name}.csv")[0] for name in (*SOURCES, "claims")}


def verdict(words, rows):
    return claim(words).judgement(rows).verdict


def test_claims_are_many_and_complete():
    assert len(CLAIMS) >= 40
    assert len({each.statement for each in CLAIMS}) == len(CLAIMS)
    for each in CLAIMS:
        assert each.section and each.runs and each.criterion and set(each.rows) <= {*SOURCES, "claims"}


def test_report_says_of_each_claim_what_decided(folder, rows):
    text = (folder / "claims.md").read_text()
    pairs = judged(CLAIMS, rows)
    assert summary(pairs) in text
    assert "Sect. 4.2" in text and "assumed" in text
    for k, (each, found) in enumerate(pairs, 1):
        part = text.split(f"### Claim {k}\n")[1].split("### Claim")[0]
        assert each.statement in part and each.criterion in part and f"**{found.verdict.capitalize()}**" in part
        assert ("assumed" in part) == each.assumed or k == len(pairs)
        assert "nan" not in found.number and "nan" not in found.why.split(), each.statement
    assert "[claims](claims.md)" in (folder / "README.md").read_text()


def test_report_is_written_again_from_rows(folder):
    text = (folder / "claims.md").read_text()
    claims.main(["--quick", "--redraw", "--out", str(folder)])
    assert (folder / "claims.md").read_text() == text


@pytest.mark.parametrize("each", CLAIMS, ids=lambda each: each.statement[:40])
def test_verdict_needs_only_the_columns_named(each, rows):
    whole = each.judgement(rows)
    named = {study: set(columns) for study, (_, columns) in each.rows.items()}
    for study, columns in named.items():
        if study in ("table3", "claims"):  # rows of a real run
            assert columns <= set(rows[study].columns)
    known = {
        name: table[[c for c in table if c in KEYS | named[name]]] for name, table in rows.items() if name in named
    }
    assert each.judgement(known) == whole


def changes(each, rows):
    """Rows with one named column, or one value of claims.csv, made different; first everywhere, then in parts."""
    for study, (which, columns) in each.rows.items():
        table = rows[study]
        if study == "claims":
            checks = [check for check in table["check"].unique() if check in which]
            assert checks, which
            part = table[table["check"].isin(checks)]
            cases = [part.index[part["case"] == case] for case in part["case"].unique()]
            targets = [("value", place) for place in (part.index, *cases)]
        else:
            keys = [key for key in ("err_in", "solver") if key in table]
            split = [table.index, *(table.index[table[key] == one] for key in keys for one in table[key].unique())]
            targets = [(column, place) for column in columns if column not in KEYS for place in split]
        for column, place in targets:
            for different in DIFFERENT:
                changed = table.astype({column: object})
                changed.loc[place, column] = different
                yield {**rows, study: changed.infer_objects()}


@pytest.mark.parametrize("each", [each for each in CLAIMS if each.rows], ids=lambda each: each.statement[:40])
def test_another_row_makes_another_verdict(each, rows):
    before = each.judgement(rows).verdict
    if before is UNCHECKED:
        pytest.skip("no rows yet")
    with np.errstate(all="ignore"):
        for changed in changes(each, rows):
            try:
                after = each.judgement(changed).verdict
            except (ArithmeticError, TypeError, ValueError):  # nonsense in, nothing out
                continue
            if after not in (before, UNCHECKED):
                return
    raise AssertionError(f"nothing changes the verdict {before!r}")


def test_without_rows_nothing_can_be_checked():
    for each in CLAIMS:
        assert each.judgement({}).verdict is UNCHECKED


def with_changed(rows: Mapping[str, pd.DataFrame], study: str, where: str, **values):
    table = rows[study].copy()
    for column, different in values.items():
        place = table.index[table.eval(where, engine="python")]
        assert len(place), where
        table = table.astype({column: object})
        table.loc[place, column] = different
    return {**rows, study: table}


def scaled(rows, study, where, **factors):
    table = rows[study].copy()
    place = table.index[table.eval(where, engine="python")]
    assert len(place), where
    for column, factor in factors.items():
        table[column] = table[column].astype(float)
        table.loc[place, column] *= factor
    return {**rows, study: table}


NEWMARK = "solver == 'PaperNewmark (beta = 1/2)'"
CASES = [
    ("violated very little", "violation", "solver == 'PaperIRK'", {"growth_q": 1.0, "late_q": 1e-14}, HOLDS, FAILS),
    ("reach y3 = 0", "motion", "solver == 'PaperIRK'", {"top": 0.01}, HOLDS, CONDITIONS),
    ("reach y3 = 0", "motion", "solver == solver", {"top_late": -0.01}, HOLDS, FAILS),
    ("h = 0.02 s differs", "motion", "h == 0.02", {"error_y3_short": 0.1}, CONDITIONS, HOLDS),
    ("h = 0.02 s differs", "motion", "h == 0.02", {"error_y3_short": 1e-3}, CONDITIONS, FAILS),
    ("obviously wrong", "motion", "h == 0.01", {"error_y3": 1e-3}, HOLDS, FAILS),
    (
        "obviously wrong",
        "motion",
        "solver == 'GSTIFF stand-in, order 6' and h == 0.01",
        {"error_y3": 1e-3},
        HOLDS,
        CONDITIONS,
    ),
    ("above 0.02 s", "step_size", "solver == 'PaperIRK'", {"share_time": 0.4}, HOLDS, FAILS),
    ("stable over long times", "energy", "solver == solver", {"slope": 0.0}, CONDITIONS, HOLDS),
    ("stable over long times", "energy", "solver == solver", {"slope": 1e-3}, CONDITIONS, FAILS),
    ("stable over long times", "energy", "variables == 'momenta'", {"slope": 1e-3}, CONDITIONS, FAILS),
    ("Newmark gives no reasonable", "table3", NEWMARK + " and err_out < 1e-3", {"astray": False}, CONDITIONS, HOLDS),
    ("Newmark gives no reasonable", "table3", NEWMARK, {"lost": False}, CONDITIONS, FAILS),
    ("order of 1e-3 s", "beam", "case == 'very flexible'", {"h_median": 1e-3}, CONDITIONS, HOLDS),
    ("order of 1e-3 s", "beam", "case == 'very flexible'", {"h_max": 1e-4}, CONDITIONS, FAILS),
    ("order of 1e-5 s", "beam", "case == 'moderately stiff'", {"h_median": 4e-5}, HOLDS, FAILS),
    ("works for the very flexible", "beam", "case == 'very flexible'", {"error_tip": 0.1}, HOLDS, CONDITIONS),
    ("computation time grows a lot", "beam", "case == 'moderately stiff'", {"cpu_s": 4.0}, HOLDS, CONDITIONS),
    ("implicit method is needed", "beam", "solver == 'DOP853, projected'", {"n_evaluations": 1e4}, CONDITIONS, FAILS),
    ("implicit method is needed", "beam", "solver == 'DOP853, projected'", {"n_evaluations": 1e9}, CONDITIONS, HOLDS),
    ("new procedure still gives", "table3", "solver == 'PaperIRK'", {"lost": True}, CONDITIONS, FAILS),
]


@pytest.mark.parametrize(("words", "study", "where", "values", "before", "after"), CASES)
def test_verdicts_follow_the_rows(words, study, where, values, before, after, rows):
    assert verdict(words, rows) is before
    assert verdict(words, with_changed(rows, study, where, **values)) is after


def test_fourteen_times_faster_is_a_matter_of_both_time_and_evaluations(rows):
    words = "14 times as fast"
    assert verdict(words, rows) is CONDITIONS
    slower = scaled(rows, "table3", NEWMARK, cpu_s=3.0, n_evaluations=3.0)
    assert verdict(words, slower) is HOLDS
    assert verdict(words, scaled(rows, "table3", NEWMARK, cpu_s=3.0)) is CONDITIONS
    assert verdict(words, scaled(rows, "table3", NEWMARK, n_evaluations=0.05)) is FAILS


def test_cost_is_compared_at_equal_error(rows):
    words = "more efficient than the two-loop procedure"
    assert verdict(words, rows) is HOLDS
    newmark = "solver in ('PaperNewmark (beta = 1/2)', 'PaperNewmark, beta = 1/4')"
    # as cheap at equal tolerance as before, but so accurate that at equal error it is the cheaper
    accurate = scaled(rows, "table3", newmark, error_q=1e-3)
    assert verdict(words, accurate) in (FAILS, CONDITIONS, UNCHECKED)
    assert verdict(words, scaled(rows, "table3", newmark, cpu_s=0.05, n_evaluations=0.05)) is FAILS


def test_quick_rows_do_not_answer_what_is_about_100_s(rows):
    rows["table3"]["t_end"] = 10.0
    found = claim("Newmark gives no reasonable").judgement(rows)
    assert found.verdict is UNCHECKED and "quick run" in found.why
    short = energy().assign(t_end=75.0)
    found = claim("stable over long times").judgement({**rows, "energy": short})
    assert found.verdict is UNCHECKED and "quick run" in found.why


def test_equations_of_the_paper(rows):
    """The errata, by computation: a change of the formulas behind them shows here."""
    expected = {
        "cosine of θ3": FAILS,
        "n in (27)": FAILS,
        "(32) as printed": FAILS,
        "(18) reduces": FAILS,
        "(22)–(24)": FAILS,
        "the integration is symplectic": FAILS,
        "β = γ = 1/2 stands": CONDITIONS,
        "(26), (27)": CONDITIONS,
        "Table 1 is Sun's": HOLDS,
        "err ∝ h^(q+1)": HOLDS,
        "(5): C_q": HOLDS,
        "(7), (8)": HOLDS,
        "(14), (15)": HOLDS,
        "No explicit": HOLDS,
    }
    assert {words: verdict(words, rows) for words in expected} == expected


def test_no_verdict_is_typed_in():
    """Verdicts are made by `grade` alone: no claim's file names one."""
    folder = Path(claims.__file__).parent
    for path in folder.glob("claims*.py"):
        if path.name in ("claims_verdicts.py", "claims_report.py"):
            continue
        text = path.read_text()
        assert "Verdict" not in text, path.name
        assert not re.search(r"Judgement\([^()]*\"(holds|does not hold)", text), path.name


@pytest.mark.slow
def test_everything_from_nothing(tmp_path):
    """All studies quick, then the columns that the claims name exist in what they really write."""
    claims.main(["--quick", "--out", str(tmp_path)])
    rows = {name: load_rows(tmp_path / f"{name}.csv")[0] for name in (*SOURCES, "claims")}
    for each in CLAIMS:
        for study, (_, columns) in each.rows.items():
            assert set(columns) <= set(rows[study].columns), (each.statement, study)
    found = [each.judgement(rows).verdict for each in CLAIMS]
    assert sum(verdict is not UNCHECKED for verdict in found) >= 25
