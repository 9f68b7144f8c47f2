"""Small runs behind the claims: single steps, short runs and one long one, beside the rows of the other studies."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from references.four_bar_minimal import MinimalFourBar
from studies.claims_algebra import Row, motion, row
from studies.claims_sweeps import Step
from twoloop import ConstrainedSystem, Newmark, RungeKutta, paper_irk, solve_dae
from twoloop.mechanisms import Problem
from twoloop.plan import Method
from twoloop.tableaux import sun_radau_iib

Array = NDArray[np.float64]

TOL = 1e-5  # Atol = Rtol of the paper
LOOPS = 1e-9  # err_in = err_out of the paper
MAX_SWEEPS = 200  # as in the kernel
MAP_STEP, SHIFT = 0.1, 2e-4  # s; rad and kg m^2 / s: a step as a map, and its differences
SIZES = (0.06, 0.03)  # s, steps at which the local error is looked at
TRIED = (0.1, 0.15, 0.2, 0.3)  # s, steps at which (33) is


def _land(problem: Problem, method: Method, t_end: float, h: float, q: Array, v: Array) -> Array:
    """End (2 n_q,) of a run with fixed steps; the linkage knows no time, so every run begins at 0."""
    result = solve_dae(problem.system, (0.0, t_end), q, v, method=method, step_size=h, t_eval=[t_end])
    if not result.success:
        raise RuntimeError(f"{method.name} at h = {h:g}: {result.message}")
    return np.concatenate([result.q[:, -1], result.v[:, -1]])


def local_error(problem: Problem, phases: int) -> Iterator[Row]:
    """The estimate (26), (27) against the true error of the two half steps, at instants of a period."""
    method = RungeKutta(sun_radau_iib(3), inner_tol=1e-13)
    truth = MinimalFourBar.from_parameters(problem.parameters)
    for h in SIZES:
        estimates, errors = [], []
        for t, q, v in zip(*(x if x.ndim == 1 else x.T for x in motion(problem, phases)), strict=True):
            z = _land(problem, method, h, h, q, v)
            fine = _land(problem, method, h, 0.5 * h, q, v)
            true = np.concatenate(truth.states(t + h))[:, 0]
            scale = TOL + TOL * np.maximum(np.abs(np.concatenate([q, v])), np.abs(z))
            estimates.append(np.sqrt(np.mean(((z - fine) / scale) ** 2)))
            errors.append(np.sqrt(np.mean(((fine - true) / scale) ** 2)))
        name = problem.name
        yield row("(26), (27)", "median estimate", float(np.median(estimates)), h, name)
        yield row(
            "(26), (27)", "median of estimate over true error", float(np.median(np.divide(estimates, errors))), h, name
        )


def orders(problem: Problem) -> Iterator[Row]:
    """Errors at 1 s with fixed steps."""
    truth = MinimalFourBar.from_parameters(problem.parameters)
    exact = np.concatenate(truth.states(1.0))[:, 0]
    methods: dict[str, tuple[Method, tuple[float, ...]]] = {
        "Sun": (RungeKutta(sun_radau_iib(3)), (0.02, 0.01)),
        **{
            f"Newmark beta = {beta:g}, gamma = {gamma:g}": (Newmark(beta, gamma), (2e-3, 1e-3))
            for beta, gamma in ((0.5, 0.5), (0.25, 0.5), (0.25, 0.6))
        },
    }
    for case, (method, steps) in methods.items():
        for h in steps:
            error = np.abs(_land(problem, method, 1.0, h, problem.q0, problem.v0) - exact).max()
            yield row("fixed steps to 1 s", case, error, h, problem.name)


def embedding(problem: Problem) -> Iterator[Row]:
    """Errors at 0.4 s where (3), (4) are solved at every stage, and where y_d waits for the end of the step."""
    truth = MinimalFourBar.from_parameters(problem.parameters)
    exact = np.concatenate(truth.states(0.4))[:, 0]
    for case, frozen in (("embedded", False), ("y_d constant in a step", True)):
        for h in (0.04, 0.02):
            q, v = problem.q0, problem.v0
            for k in range(round(0.4 / h)):
                step = Step(problem.system, sun_radau_iib(3), k * h, h, q, v, frozen)
                if not step.converge(1e-12, MAX_SWEEPS)[0]:
                    raise RuntimeError(f"the sweeps of the step at {k * h:g} s did not converge ({case}, h = {h:g})")
                q, v = step.q1, step.v1
            yield row("embedding", case, np.abs(np.concatenate([q, v]) - exact).max(), h, problem.name)


def needless(problem: Problem, phases: int) -> Iterator[Row]:
    """Steps that (33) gives up, and those of them whose sweeps converge if they are let."""
    for h in TRIED:
        given_up = converging = 0
        for t, q, v in zip(*(x if x.ndim == 1 else x.T for x in motion(problem, phases)), strict=True):
            converged, refused = Step(problem.system, sun_radau_iib(3), t, h, q, v).converge(LOOPS, MAX_SWEEPS)
            given_up += refused or not converged
            converging += refused and converged
        yield row("(33)", "steps given up", given_up, h, problem.name)
        yield row("(33)", "of these, converging", converging, h, problem.name)


def _opaque(problem: Problem, calls: dict[str, int], gamma: bool) -> ConstrainedSystem:
    """The linkage given by values alone, every call of a function counted."""
    system = problem.system

    def counted(name, function):  # type: ignore[no-untyped-def]
        if name in ("force", "gamma"):

            def three(t, q, v):  # type: ignore[no-untyped-def]
                calls[name] += 1
                return function(t, q, v)

            return three

        def two(t, q):  # type: ignore[no-untyped-def]
            calls[name] += 1
            return function(t, q)

        return two

    names = ("mass", "force", "constraint", "jacobian", *(("gamma",) if gamma else ()))
    calls.update(dict.fromkeys(names, 0))
    functions = {name: counted(name, getattr(system, name)) for name in names}
    return ConstrainedSystem.from_python(n_q=system.n_q, n_c=system.n_c, **functions)


def values_alone(problem: Problem) -> Iterator[Row]:
    """What the procedure asks of a mechanism: calls of its functions for one evaluation of the accelerations."""
    ends = []
    for case, gamma in (("Q_d given", True), ("Q_d by differences", False)):
        calls: dict[str, int] = {}
        system = _opaque(problem, calls, gamma)
        seen = []
        for t_end in (0.5, 1.0):  # the difference of two runs leaves out what the checks at the start call
            for name in calls:
                calls[name] = 0
            result = solve_dae(system, (0.0, t_end), problem.q0, problem.v0, method=paper_irk(), rtol=TOL, atol=TOL)
            seen.append({**calls, "n": result.stats.n_evaluations or 0})
        ends.append(result.q[:, -1])
        for name in calls:
            ratio = (seen[1][name] - seen[0][name]) / (seen[1]["n"] - seen[0]["n"])
            yield row("values alone", f"{case}: calls of {name} an evaluation", ratio, problem=problem.name)
        yield row("values alone", f"{case}: reached its end", float(result.success), problem=problem.name)
    compiled = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, method=paper_irk(), rtol=TOL, atol=TOL)
    for case, end in zip(("Q_d given", "Q_d by differences"), ends, strict=True):
        difference = np.abs(end - compiled.q[:, -1]).max()
        yield row("values alone", f"{case}: difference from the compiled linkage", difference, problem=problem.name)


def stiff() -> Iterator[Row]:
    """Steps on springs so weakly excited that no error counts: h times the frequency, stiffer and stiffer."""
    method = paper_irk(LOOPS, LOOPS)
    for omega in (10.0, 1000.0):
        system = ConstrainedSystem.from_python(
            n_q=2,
            n_c=1,
            mass=np.eye(2),
            force=lambda t, q, v, w=omega: np.array([-(w**2) * q[0], 0.0]),  # type: ignore[misc]
            constraint=lambda t, q: q[1:],
            jacobian=lambda t, q: np.array([[0.0, 1.0]]),
            gamma=lambda t, q, v: np.zeros(1),
        )
        q0 = np.array([1e-3 / omega, 0.0])
        span = (0.0, 60.0 / omega)
        result = solve_dae(system, span, q0, np.zeros(2), method=method, rtol=1.0, atol=1.0)
        yield row("stiff spring", "largest h omega of an accepted step", result.h.max() * omega, omega, "spring")
        yield row("stiff spring", "rejected by the error", result.stats.n_rejected_error or 0, omega, "spring")
        yield row("stiff spring", "reached its end", float(result.success), omega, "spring")


def determinants(problem: Problem) -> Iterator[Row]:
    """One step of Sun's method as a map of the canonical (q_i, p_i): its determinant is 1 where it is symplectic."""
    _, q, v = motion(problem, 7)
    for variables in ("velocities", "momenta"):
        method = RungeKutta(sun_radau_iib(3), variables=variables, inner_tol=1e-13)  # type: ignore[arg-type]
        worst = max(abs(_area(problem, method, *state) - 1.0) for state in zip(q.T, v.T, strict=True))
        yield row("one step as a map", f"on {variables}: |det - 1| in (q_i, p_i)", worst, MAP_STEP, problem.name)


def _area(problem: Problem, method: RungeKutta, q: Array, v: Array) -> float:
    """Determinant of a step in the angle that LU takes and its momentum, by differences of order 4."""
    step = Step(problem.system, method.tableau, 0.0, MAP_STEP, q, v)
    i = step.independent[0]

    def inertia(q: Array) -> tuple[float, Array]:
        unit = np.zeros(problem.system.n_q)
        unit[i] = 1.0
        tangent = step.dependents(0.0, q, unit)[1]
        return float(tangent @ problem.system.mass(0.0, q) @ tangent), tangent

    def image(angle: float, p: float) -> Array:
        start = q.copy()
        start[i] = angle
        start, _ = step.dependents(0.0, start, v)
        mass, tangent = inertia(start)
        q1, v1 = np.split(_land(problem, method, MAP_STEP, MAP_STEP, start, p / mass * tangent), 2)
        return np.array([q1[i], inertia(q1)[0] * v1[i]])

    angle, p = q[i], inertia(q)[0] * v[i]
    columns = []
    for da, dp in ((SHIFT, 0.0), (0.0, SHIFT)):
        two, one, minus, minus2 = (image(angle + n * da, p + n * dp) for n in (2, 1, -1, -2))
        columns.append((minus2 - 8.0 * minus + 8.0 * one - two) / (12.0 * SHIFT))
    return float(np.linalg.det(np.array(columns).T))
