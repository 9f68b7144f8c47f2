"""Lines of progress: one for each piece of work, on stderr, with the time that the rest may take."""

import pytest

from studies.bench import cli as progress


@pytest.fixture
def clock(monkeypatch):
    times = iter(range(0, 1000, 10))
    monkeypatch.setattr(progress.time, "monotonic", lambda: float(next(times)))


def test_each_piece_has_a_line_with_its_time_and_what_is_left(clock, capsys):
    assert list(progress.track(["a", "b", "c"], "cell {}".format)) == ["a", "b", "c"]
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.splitlines() == [
        "1/3  cell a  10.0 s",
        "2/3  cell b  10.0 s  about 10 s left",
        "3/3  cell c  10.0 s  almost done",
    ]


def test_lines_that_need_not_be_printed_are_left_out_but_for_the_last(monkeypatch, capsys):
    monkeypatch.setattr(progress.time, "monotonic", lambda: 5.0)
    list(progress.track(range(1, 100), str, lambda number: number % 50 == 1))
    assert [line.split()[0] for line in capsys.readouterr().err.splitlines()] == ["1/99", "51/99", "99/99"]


@pytest.mark.parametrize(("seconds", "says"), [(0.1, "almost done"), (119.0, "119 s"), (600.0, "10 min")])
def test_the_remaining_time_is_told_in_seconds_or_minutes(seconds, says):
    assert says in progress.remaining(seconds)
