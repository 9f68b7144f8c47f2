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
from twoloop.kernels.steps.stages import LazyStep, load_step
load_step(LazyStep("steps.diagonal_step", "DIAGONAL")), load_step(LazyStep("steps.newton_step", "NEWTON"))
"""
KINDS = ("ends", "t_eval", "dense", "Integrator")


@pytest.mark.slow  # each runs two processes
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
