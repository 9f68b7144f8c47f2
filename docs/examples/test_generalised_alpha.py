"""The check of generalised_alpha.py."""

from generalised_alpha import simulate

from twoloop.testing import check_simulator


def test_it_is_right():
    report = check_simulator(simulate, "smoke", steps=(100, 200), order=2)
    assert report.passed, str(report)
