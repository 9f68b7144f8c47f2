"""Series in lanes: operations that nothing depends on, or that others have made, are not there."""

import numpy as np
import pytest

from twoloop import ConstrainedSystem, ensemble, mechanisms, solve_dae
from twoloop.generate.choices import Choice
from twoloop.generate.lane_code import LaneCode
from twoloop.generate.series import series_program


def recurrences_of(problem):
    system = problem.system
    choice = Choice.at(system, 0.0, problem.q0)
    return choice, LaneCode(system, choice, system.parameters, True).recurrences


def test_rows_that_do_not_count_take_no_operations():
    problem = mechanisms.redundant_slider_crank()
    whole, (choice, found) = series_program(problem.system), recurrences_of(problem)
    assert 2 * (len(found.early) + len(found.late)) <= whole.n_operations
    assert {place for place, _ in found.rows} <= set(choice.rows)


def test_rates_of_sines_share_the_sums_of_these():
    _, found = recurrences_of(mechanisms.andrews())
    assert len(found._carried) == 14 == len(found.sums_ahead)  # all of C_q v


@pytest.mark.parametrize("n_redundant", [0, 1])
@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
def test_massless_coordinates_and_rows_that_depend_on_others(n_redundant, monkeypatch):
    """Rows that M is made definite with are in the series, whether they count or not."""
    monkeypatch.setattr("twoloop.ensembles.in_turn.CALL", 1e9)
    parameters = np.column_stack([np.linspace(0.7, 1.3, 9), np.linspace(12.0, 5.0, 9)])
    angle = np.linspace(0.3, 1.2, 9)
    q = np.column_stack([parameters[:, 0] * np.sin(angle), -parameters[:, 0] * np.cos(angle), angle])

    def constraint(t, q, p):
        first, second = q[0] - p[0] * np.sin(q[2]), q[1] + p[0] * np.cos(q[2])
        return np.array([2.0 * first - second, first, second][1 - n_redundant :])

    def jacobian(t, q, p):
        nothing = 0.0 * q[0]
        first, second = [1.0 + nothing, nothing, -p[0] * np.cos(q[2])], [nothing, 1.0 + nothing, -p[0] * np.sin(q[2])]
        both = [2.0 * x - y for x, y in zip(first, second, strict=True)]
        return np.array([both, first, second][1 - n_redundant :])

    system = ConstrainedSystem.from_python(
        n_q=3,
        n_c=2 + n_redundant,
        mass=np.diag([1.0, 1.0, 0.0]),
        force=lambda t, q, v, p: np.array([0.0 * q[0], -p[1] + 0.0 * q[0], -0.05 * v[2]]),
        constraint=constraint,
        jacobian=jacobian,
        parameters=parameters[0],
    )
    runs = ensemble(system, (0.0, 1.0), q, np.zeros(3), parameters=parameters)
    assert runs.singly.sum() == 1 and "8 in lanes by Taylor" in runs.message
    known = solve_dae(system.with_parameters(parameters[5]), (0.0, 1.0), q[5], np.zeros(3), method="DOP853", rtol=1e-10)
    assert np.abs(runs.q[5, :, -1] - known.q[:, -1]).max() < 1e-6
