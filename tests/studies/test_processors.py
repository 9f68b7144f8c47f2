"""Who is ahead on which processor: from rows that are made up."""

import numpy as np
import pandas as pd
import pytest

from studies.bench.cli import StudyError
from studies.work_precision import processors, rivals

STAMP = "full work_precision; commit 0123456789; A"


def rows(processor, ours, theirs):
    """Of one mechanism: `auto` takes `ours` seconds, heyoka `theirs`, for an error of 1e-6."""
    lines = []
    for solver, family, seconds in (("auto", "two-loop", ours), ("heyoka", "heyoka", theirs)):
        for repeat in range(5):
            line = {"group": rivals.GROUP, "case": "A01 pendulum", "solver": solver, "family": family, "tol": 1e-6}
            line |= {"called_from": "compiled", "keeps_constraints": True, "repeat": repeat, "status": "REACHED_END"}
            line |= {"call_s": seconds * (1 + 0.001 * repeat), "inside_s": 0.5 * seconds, "error_q": 1e-6}
            lines.append({**line, "floor": 1e-14, "processor": processor, "used": ""})
    return pd.DataFrame(lines)


def test_a_verdict_that_turns_between_two_processors_is_told():
    one, other = (
        processors.verdicts(rows(name, *times), STAMP) for name, times in (("A", (1.0, 2.0)), ("B", (2.0, 1.0)))
    )
    (found,) = processors.findings_of(pd.concat([one, other]))
    assert found["processors"] == ["A", "B"] and found["same_code"] and found["time"] == "whole call"
    assert {"case": "A01 pendulum", "error": 1e-6, "who": "auto", "ahead_on": "A"} in found["turned"]
    assert found["over"] == pytest.approx(0.25, rel=0.01) and found["apart"] == pytest.approx(4.0, rel=0.01)


def test_the_same_verdict_turns_nowhere():
    both = pd.concat([processors.verdicts(rows(name, 1.0, 2.0), STAMP) for name in "AB"])
    (found,) = processors.findings_of(both)
    assert found["turned"] == [] and found["n"] > 0 and found["most"] == pytest.approx(1.0)


def test_a_machine_that_knows_the_time_inside_alone_is_compared_by_it():
    old = processors.verdicts(rows("A", 1.0, 2.0).assign(call_s=np.nan), STAMP)
    assert set(old["time"]) == {"inside"}
    (found,) = processors.findings_of(pd.concat([old, processors.verdicts(rows("B", 1.0, 2.0), STAMP)]))
    assert found["time"] == "inside"


def test_rows_of_a_processor_replace_those_that_it_made_before(tmp_path):
    path = tmp_path / processors.FILE
    processors.added(path, processors.verdicts(rows("A", 1.0, 2.0), STAMP)).to_csv(path, index=False)
    processors.added(path, processors.verdicts(rows("B", 1.0, 2.0), STAMP)).to_csv(path, index=False)
    again = processors.added(path, processors.verdicts(rows("A", 2.0, 1.0), STAMP))
    assert again["processor"].value_counts().to_dict() == {"A": len(again) // 2, "B": len(again) // 2}
    assert set(again[again["processor"] == "A"]["verdict"]) == {"behind"}


def test_a_folder_without_rows_is_refused(tmp_path):
    with pytest.raises(StudyError, match="there is no"):
        processors.rows_of(tmp_path)
