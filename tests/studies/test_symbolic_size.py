"""The report on the size of symbolic mechanisms: its sentences follow from its rows."""

import pandas as pd

from studies.symbolic_size import study as symbolic_size
from tests.studies.of_study import said


def rows():
    sizes = [
        {"group": "size", "case": "angles", "n": 5, "tangents": tangents, "status": "REACHED_END", "lines": 100}
        | {"derive_s": 1.0, "compile_s": 30.0 if tangents else 3.0, "second_s": 1.5, "evaluation_us": 1.0}
        for tangents in (False, True)
    ]
    twin = {"group": "twin", "case": "four-bar", "status": "REACHED_END", "hand_us": 1.0, "twin_us": 1.1}
    return pd.DataFrame([*sizes, twin | {"hand_evaluations": 100, "twin_evaluations": 100}])


def test_sentences_turn_with_the_rows():
    _, given = said(symbolic_size, rows())
    assert "All chains up to n = 5 were derived and compiled" in given
    assert "compiling takes 30 s with them (`tangents=True`) and 3.0 s without" in given
    assert "takes 1.5 s of CPU time in the median, 1.5 s at most" in given
    assert "costs 1.1 to 1.1 times as much. Counts of evaluations are the same." in given
    worse = rows()
    worse.loc[0, "second_s"], worse.loc[1, "status"] = 2.5, "TIME_LIMIT"
    worse.loc[2, ["twin_us", "twin_evaluations"]] = 2.0, 101.0
    _, given = said(symbolic_size, worse)
    assert "Not all chains were derived and compiled: angles, n = 5: TIME_LIMIT" in given
    assert "takes 2.5 s of CPU time in the median, 2.5 s at most" in given and "costs 2.0 to 2.0 times as much" in given
    assert "Counts of evaluations differ in four-bar." in given


def test_a_chain_that_takes_too_long_is_a_row(monkeypatch):
    monkeypatch.setattr(symbolic_size, "TIME_LIMIT", 0.01)
    row = symbolic_size.made("positions", 2, False)
    assert row["status"] == "TIME_LIMIT" and "first process" in row["message"]
