"""Steps of an implicit method are loaded when a run comes to them: it goes on as if they had been there before."""

import pytest

from tests.processes import run_python

RUN = """
import sys
from hashlib import sha256
from twoloop import Integrator, solve_dae
from twoloop.mechanisms import governor

problem = governor()
for kind in {kinds}:
    for _ in range(2):
        if kind == "Integrator":
            result = Integrator(problem.system, rtol={tol}, atol={tol}).run((0.0, 0.5), problem.q0, problem.v0)
        else:
            more = {{"t_eval": {{"t_eval": [0.2, 0.5]}}, "dense": {{"dense_output": True}}}}.get(kind, {{}})
            more |= {{"rtol": {tol}, "atol": {tol}, "compiled": {compiled}}}
            result = solve_dae(problem.system, (0.0, 0.5), problem.q0, problem.v0, **more)
        numbers = [each for each in (result.t, result.q, result.v, result.lam)]
        print(result.status.name, result.stats.n_jacobians, result.stats.n_evaluations)
        print(sha256(b"".join(each.tobytes() for each in numbers)).hexdigest())
print(*[name for name in ("newton_step", "diagonal_step") if f"twoloop.kernels.steps.{{name}}" in sys.modules])
"""
BEFORE = """
from twoloop.kernels.steps.named_step import NamedStep, loaded
loaded(NamedStep("diagonal_step", "DIAGONAL")), loaded(NamedStep("newton_step", "NEWTON"))
"""
KINDS = ("ends", "t_eval", "dense", "Integrator")


@pytest.mark.parametrize(
    ("tol", "compiled", "name"),
    [(1e-3, False, "diagonal_step"), (1e-5, False, "newton_step"), (1e-5, True, "newton_step")],
)
def test_a_run_that_loads_its_implicit_method_is_the_one_that_had_it(tol, compiled, name):
    source = RUN.format(tol=tol, compiled=compiled, kinds=KINDS)
    *lines, loaded = run_python(source).stdout.splitlines()
    assert loaded == name  # and no other
    assert all(line.startswith("REACHED_END") and line.split()[1] != "0" for line in lines[::2])
    assert lines == run_python(BEFORE + source).stdout.splitlines()[:-1]


def test_a_solution_between_steps_is_the_same_before_and_after_the_method_is_loaded():
    """Its pieces may come to the implicit method, too, as long as the solution lasts: a rod of 1e9 N/m."""
    source = """
import numpy as np
from twoloop import ConstrainedSystem, RungeKutta, solve_dae
from twoloop.methods.tableaux import gauss

def force(t, q, v):
    d = q[2:] - q[:2]
    pull = 1e9 * (np.hypot(*d) - 1.0) / np.hypot(*d) * d
    return np.concatenate([[0.0, -9.81] + pull, [0.0, -9.81] - pull])

system = ConstrainedSystem.from_python(
    n_q=4, n_c=1, mass=np.eye(4), force=force, constraint=lambda t, q: np.array([q[0] ** 2 + q[1] ** 2 - 1.0]),
    jacobian=lambda t, q: np.array([[2.0 * q[0], 2.0 * q[1], 0.0, 0.0]]),
)
length = 2.0 + 0.8 * 9.81 / 1e9
start = [0.6, -0.8, 0.6 * length, -0.8 * length], np.zeros(4)
for _ in range(2):
    method = RungeKutta(gauss(3), outer="auto")
    result = solve_dae(system, (0.0, 0.02), *start, method, rtol=0.1, atol=0.1, dense_output=True)
    print(result.status.name, result.sol(np.linspace(0.0, 0.02, 3001)).v.tobytes().hex()[-4000:])
"""
    first, second = run_python(source).stdout.splitlines()
    assert first == second and first.startswith("REACHED_END")
