"""The check of runge_kutta.py. Redundant rows are beyond it: off the constraints, as stages are, they contradict."""

from runge_kutta import simulate

from twoloop.testing import check_simulator

PROBLEMS = ["pendulum", "driven_crank", "out_of_reach"]


def test_it_is_right():
    report = check_simulator(simulate, PROBLEMS, steps=(100, 200), order=4)
    assert report.passed, str(report)


def test_redundant_rows_are_refused():
    report = check_simulator(simulate, "redundant_slider_crank", steps=(100, 200), order=4)
    assert [failure.property for failure in report.failures] == ["runs"]
