"""What the first call with code made for a mechanism adds, from rows made by hand, and in a process."""

import numpy as np
import pandas as pd
import pytest

from studies.work_precision import builds, first_calls, rivals


def rows(**times):
    """Rows of first calls of mechanisms, s; later ones take 0.1 s."""
    made = [{"case": case, "first_call_s": each, "call_s": 0.1} for case, own in times.items() for each in own]
    return pd.DataFrame(made)


def test_a_build_is_the_median_of_what_first_calls_take_longer():
    failed = pd.DataFrame([{"case": "hoist", "first_call_s": None, "call_s": None}])
    made = pd.concat([rows(crane=(0.3, 0.5, 0.2), winch=(1.1,)), failed])
    crane, winch = builds.findings_of(made, {"crane"})
    assert crane == {"case": "crane", "build_s": pytest.approx(0.2), "default": True}
    assert winch == {"case": "winch", "build_s": pytest.approx(1.0), "default": False}
    assert builds.findings_of(pd.DataFrame({"case": []}), set()) == []


def test_every_mechanism_is_found_by_its_name():
    known = rivals.problems(quick=False)
    assert set(known) - set(builds.names(quick=False)) == {"four-bar, second"} and len(builds.names(quick=True)) == 1
    for name in builds.names(quick=False):
        np.testing.assert_array_equal(builds.problem_of(name).q0, known[name].q0)


@pytest.mark.slow
def test_a_process_finds_the_callbacks_and_builds_the_code():
    row = first_calls.in_process(builds.__name__, "four-bar")
    assert row["status"] == "REACHED_END" and {"first_call_s", "call_s"} <= row.keys()
