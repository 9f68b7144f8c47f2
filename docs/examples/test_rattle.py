"""The check of rattle.py, on problems of its kind: constant masses, forces without velocities, independent rows."""

from rattle import simulate

from twoloop.testing import check_simulator


def test_it_is_right():
    report = check_simulator(simulate, ["pendulum", "four_bar"], steps=(100, 200), order=2)
    assert report.passed, str(report)
