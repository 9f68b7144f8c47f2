"""Result, Status and Statistics on their own."""

from dataclasses import FrozenInstanceError

import numpy as np
import pytest

from twoloop import Result, Statistics, Status


def result(status=Status.REACHED_END, n_t=2, stats=None):
    table = np.zeros((3, n_t))
    return Result(
        t=np.arange(float(n_t)),
        q=table,
        v=table,
        a=table,
        lam=table[:1],
        h=np.ones(max(n_t - 1, 0)),
        status=status,
        message="Said so.",
        stats=stats or Statistics(),
    )


def test_zero_is_the_end_one_an_event_negative_a_failure():
    assert Status.REACHED_END == 0 and Status.EVENT == 1
    assert all(status < 0 for status in Status if status not in (Status.REACHED_END, Status.EVENT))
    assert len({int(status) for status in Status}) == len(Status)


@pytest.mark.parametrize("status", Status)
def test_success_is_a_status_that_is_not_negative(status):
    assert result(status).success == (status >= 0)


def test_repr_says_status_message_and_the_counts_that_are_known():
    text = repr(result(Status.MAX_STEPS, stats=Statistics(n_accepted=1, n_evaluations=17)))
    assert "MAX_STEPS" in text and "Said so." in text and "n_evaluations=17" in text
    assert "n_inner" not in text  # not told
    assert "t[-1]=1" in text


def test_repr_of_a_run_without_output():
    assert "no output" in repr(result(n_t=0))


def test_counts_are_unknown_until_told():
    assert Statistics().n_evaluations is None


def test_results_are_not_changed():
    with pytest.raises(FrozenInstanceError):
        result().status = Status.EVENT
