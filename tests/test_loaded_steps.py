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


def test_threads_may_come_to_it_at_once():
    source = """
from threading import Thread
from twoloop import solve_dae
from twoloop.mechanisms import governor

problem, ends = governor(), []
def run():
    result = solve_dae(problem.system, (0.0, 0.2), problem.q0, problem.v0, rtol=1e-5, atol=1e-5)
    ends.append((result.success, result.stats.n_jacobians > 0, result.q[:, -1].tobytes()))

threads = [Thread(target=run) for _ in range(4)]
for thread in threads: thread.start()
for thread in threads: thread.join()
print(len(ends), len(set(ends)), ends[0][:2])
"""
    assert run_python(source).stdout.split("\n")[0] == "4 1 (True, True)"


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


def test_loading_counts_neither_as_time_of_steps_nor_against_the_limit():
    """As compilation may take a minute: here three seconds, the limit being two; steps take some milliseconds."""
    source = """
import time
from twoloop import solve_dae
from twoloop.kernels.steps import named_step
from twoloop.mechanisms import governor

problem, original = governor(), named_step.import_module

def slow(name):
    began = time.process_time()
    while time.process_time() - began < 3.0:
        pass
    return original(name)

named_step.import_module = slow
for t1 in (1e-4, 1e-4, 0.3):  # the arrays of the first runs serve the last one
    result = solve_dae(problem.system, (0.0, t1), problem.q0, problem.v0, rtol=1e-5, atol=1e-5, **{more})
print(result.success, result.stats.n_jacobians > 0, result.stats.cpu_time < 1.5)
"""
    for more in ({}, {"time_limit": 2.0}):
        assert run_python(source.replace("{more}", str(more))).stdout.split() == ["True", "True", "True"]
