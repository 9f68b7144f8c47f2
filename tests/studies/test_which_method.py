"""The page "Which method?": its table and sentences follow the findings."""

import json

import pytest

from studies.bench.store import WHOLE_CALL
from studies.bench.takes import NO_ANGLES, takes
from studies.which_method import page, table
from tests.studies.test_index import energy

SOLVER = {"family": "two-loop", "right": 9, "wrong": 0, "said so": 1, "ratio": 0.1}
VALIDATION = {"n": 4, "tight": 1e-10, "decades": 2}
COUNTS = {"WRONG AND SILENT": 2, "HANG": 1}

AMONG = f", among solvers with constraints: {NO_ANGLES}"


@pytest.fixture
def text_of(tmp_path):
    """The page made from findings of validation, and of honesty where they are given."""

    def make(solvers, counts=None):
        (tmp_path / "validation.json").write_text(json.dumps(VALIDATION | {"solvers": solvers}))
        if counts is not None:
            (tmp_path / "honesty.json").write_text(json.dumps({"n_traps": 5, "counts": counts}))
        return page(tmp_path)

    return make


def test_nothing_has_been_run(tmp_path):
    text = page(tmp_path)
    assert text.count("not run yet") == 2 and "python -m studies.validation" in text


def test_a_line_for_each_method_of_ours_best_first(text_of):
    bad = SOLVER | {"solver": "BDF", "wrong": 3}
    good = SOLVER | {"solver": "DOP853 (twoloop)"}
    text = text_of([bad, good, SOLVER | {"solver": "IDA", "family": "SUNDIALS"}], {"DOP853 (twoloop)": COUNTS})
    lines = [line for line in text.splitlines() if line.startswith("| `")][:2]
    assert (
        lines == ['| `method="DOP853"` | 9 | 1 | 0 | 0.10 | 3 |', '| `method="BDF"` | 9 | 1 | 3 | 0.10 | – |']
        and "`IDA`" not in text
    )


def test_the_default_has_its_own_traps(text_of):
    text = text_of([SOLVER | {"solver": "the default"}], {"the default (twoloop)": COUNTS, "auto (twoloop)": {}})
    assert "| the default | 9 | 1 | 0 | 0.10 | 3 |" in text


@pytest.mark.parametrize(
    ("changed", "said", "unsaid"),
    [
        ({}, 'Never wrong at the end of a run: `method="Gauss12"`.', "None of the methods"),
        ({"wrong": 1}, "None of the methods is right on every run", "Never wrong"),
        ({"ratio": 0.5}, "The median error stays below the tolerance", "set a smaller"),
        (
            {"ratio": 5.0},
            'The error exceeds the tolerance in the median of `method="Gauss12"`: set a smaller',
            "stays below",
        ),
    ],
)
def test_sentences_follow_the_findings(text_of, changed, said, unsaid):
    text = text_of([SOLVER | {"solver": "Gauss12"} | changed])
    assert said in text and unsaid not in text and "traps" not in text


def test_the_table_has_a_row_for_each_class_with_the_cheapest():
    loose = {"solver": "TRBDF2", "accuracies": ["1e-2", "1e-4"], "undecided": []}
    tight = {"solver": "auto, compiled", "accuracies": ["1e-6"], "undecided": []}
    entries = [{"class": "odd", "name": name, "t_end": 2.0, "picks": [loose, tight]} for name in ("a crane", "another")]
    (row,) = takes({}, entries)
    assert row["what"] == "odd (a crane and another, 2.0 s)"
    assert row["take"] == '`method="TRBDF2"` (4 of 6 errors), `compiled=True` (2)' + AMONG
    entries[1]["picks"] = [loose | {"undecided": ["1e-4"]}, tight]
    (row,) = takes({}, entries)
    assert row["take"] == 'no clear choice (of 6 errors: `method="TRBDF2"` 3, `compiled=True` 2)' + AMONG
    entries[1]["name"] = "a crane, second"
    assert takes({}, entries)[0]["what"] == "odd (2 geometries, 2.0 s)"


@pytest.mark.parametrize(
    ("pays", "never", "said"),
    [
        ([3.0, 42.0], 1, "`compiled=True` after some 3 to 40 calls on 4 of 5 mechanisms"),
        ([58.0], 4, "`compiled=True` after some 60 calls on 1 of 5 mechanisms"),
        ([], 5, ""),
    ],
)
def test_code_for_the_mechanism_is_advised_where_the_first_calls_say_that_it_pays(pays, never, said):
    line = {"solver": "auto, compiled", "n": 5, "pays": pays, "never": never}
    theirs = {**line, "solver": "heyoka", "pays": [29817.0], "never": 0}
    (row,) = takes({"work_precision": {"first_calls": [line, theirs]}}, [])
    parts = " and ".join(part for part in (said, "`heyoka` after some 30000 calls") if part)
    assert row == {"what": "many single calls", "take": f"{parts}, against `compiled=False`"}
    assert takes({"work_precision": {"first_calls": []}}, []) == []


def test_no_row_of_advice_stands_without_a_finding(tmp_path):
    found = energy(n={"even": 3}, timed=WHOLE_CALL)
    (tmp_path / "energy.json").write_text(json.dumps(found | {"n_calm": {"even": 3}}))
    assert "| fixed steps, the energy without drift |" in table(tmp_path)
    (tmp_path / "energy.json").write_text(json.dumps(found | {"n_calm": {"even": 2}}))
    without = table(tmp_path)
    assert not any(words in without for words in ("fixed steps", "Radau", "drag", "compiled=True"))
