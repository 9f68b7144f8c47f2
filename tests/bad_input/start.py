"""Starts of a run, and systems, that the checks at the start refuse."""

import numpy as np

from tests.bad_input.case import cases_of, linkage, solve
from tests.problems import functions_of, moving_pivot, moving_pivot_state, pendulum
from twoloop import ConstrainedSystem


def linkage_moved():
    q = linkage().q0.copy()
    q[4] += 0.01
    return solve(linkage().system, q0=q, v0=linkage().v0)


def forgotten_rate():
    functions = functions_of(moving_pivot())
    del functions["constraint_rate"], functions["gamma"]
    system = ConstrainedSystem.from_python(n_q=2, n_c=1, **functions, name="moving pivot")
    return solve(system, (0.0, 0.1), *moving_pivot_state(0.0))


def pushed_later(t, q):
    return np.array([q[1] - 0.01 * np.exp(-(((t - 1.03) / 0.003) ** 2))])


def rate_forgotten_of_a_push():
    system = ConstrainedSystem.from_python(**{"n_q": 2, "n_c": 1, "mass": np.eye(2), "force": lambda t, q, v: np.array([0.1, -1.0])}, **{"constraint": pushed_later, "jacobian": lambda t, q: np.array([[0.0, 1.0]]), "name": "push"})
    return solve(system, (0.0, 2.0), [0.0, 0.0], [0.0, 0.0])


def with_tangents(**changed):
    """A pendulum on a spring and a damper, with its tangents."""
    tangents = {"force_by_q": lambda t, q, v: np.diag([-4.0, 0.0]), "force_by_v": lambda t, q, v: np.diag([0.0, -0.5]), "reaction_by_q": lambda t, q, lam: lam[0] * np.eye(2)}
    return pendulum(force=lambda t, q, v: np.array([-4.0 * q[0], -9.81 - 0.5 * v[1]]), **{**tangents, **changed})


PROJECT = "project the guess with consistent_state"
FORMULA = "correct the formula, or the constraint that it belongs to"
of_start = cases_of("The start of a run")
START = [
    of_start("positions 0.1 m off the constraint", lambda: solve(q0=[-1.1, 0.0])).says(r"q0 is not consistent.*'pendulum'.*max\|C.*0.105.*consistent_state", PROJECT),
    of_start("a position where C_q is zero", lambda: solve(q0=[0.0, 0.0])).says("q0 is not consistent.*no small change puts it right", "take another guess, and project it"),
    of_start("a joint of a linkage that does not close", linkage_moved).says(r"q0 is not consistent.*0\.01 \(row 3\).*coordinate \d", PROJECT),
    of_start("velocities along the rod", lambda: solve(v0=[0.3, 0.0])).says(r"v0 is not consistent.*max\|C_q v.*0.3.*consistent_state", PROJECT),
    of_start("velocities that forget the drive").when(lambda: solve(moving_pivot(), (0.0, 0.1), moving_pivot_state(0.0)[0], moving_pivot_state(0.0)[1] - [0.9, 0.0])).says("v0 is not consistent", PROJECT),
    of_start("a constraint without gradient", lambda: solve(pendulum(constraint=lambda t, q: np.zeros(1), jacobian=lambda t, q: np.zeros((1, 2)), gamma=False))).says(r"row\(s\) \[0\] of the constraint Jacobian of .* are zero", "leave out the row named"),
    of_start("a mass matrix that is not symmetric").when(lambda: solve(pendulum(mass=lambda t, q: np.array([[1.0, 0.5], [0.0, 1.0]])))).says("mass of 'pendulum' must be symmetric.*0.5", "correct the mass matrix"),
    of_start("a mass matrix that is not positive definite", lambda: solve(pendulum(mass=np.diag([1.0, -2.0])))).says("mass of 'pendulum' must be positive definite", "correct the mass matrix"),
    *(
        of_start(f"`{kind}` returns NaN").when(lambda kind=kind, shape=shape: solve(pendulum(**{kind: lambda *arguments: np.full(shape, np.nan)}))).says(f"start.*{kind} of 'pendulum' returned values that are not finite", "find out where the NaN comes from")
        for kind, shape in {"mass": (2, 2), "force": (2,), "constraint": (1,), "jacobian": (1, 2), "gamma": (1,)}.items()
    ),
    *(
        of_start(f"`{kind}` returns an array of shape (3, 3)")
        .when(lambda kind=kind: solve(pendulum(**{kind: lambda *arguments: np.zeros((3, 3))})))
        .says(rf"{kind} of system 'pendulum' must return an array of shape .*it returned shape \(3, 3\)", "return an array of the shape named")
        for kind in ("mass", "force", "constraint", "jacobian", "gamma", "constraint_rate", "force_by_q")
    ),
    of_start("`force` returns a number", lambda: solve(pendulum(force=lambda *arguments: 0.0))).says(r"force of system 'pendulum' must return an array of shape \(2,\).*returned shape \(\)", "return an array of the shape named"),
    *(
        of_start(f"`force` returns {value!r}").when(lambda value=value: solve(pendulum(force=lambda *arguments: value))).says(r"force of system 'pendulum' must return a real array of shape \(2,\).*returned", "return an array of real numbers", TypeError)
        for value in (None, "text", [[1.0], [1.0, 2.0]], [1j, 0.0])
    ),
    of_start("`jacobian` of twice the right values").when(lambda: solve(pendulum(jacobian=lambda t, q: 2.0 * q[None, :]))).says(r"jacobian of 'pendulum' is not the derivative of constraint.*entry \(0, 0\) is -2, by differences it is -1", FORMULA),
    of_start("`jacobian` with one entry wrong by 1e-5").when(lambda: solve(pendulum(jacobian=lambda t, q: np.array([[q[0], q[1] + 1e-5 * q[0]]])))).says(r"jacobian of 'pendulum' is not the derivative of constraint.*entry \(0, 1\) is -1e-05", FORMULA),
    of_start("constraints that depend on time, without `constraint_rate`", forgotten_rate).says("constraint_rate of 'moving pivot' is not.*or give constraint_rate: the constraints depend on time", "give constraint_rate"),
    of_start("the same of constraints that rest at the start", rate_forgotten_of_a_push).says("constraint_rate of 'push' is not given, but constraint depends on t, though not near t = 0", "give constraint_rate"),
    of_start("`gamma` with the wrong sign", lambda: solve(pendulum(gamma=lambda t, q, v: np.array([v @ v])))).says("gamma of 'pendulum' is not .*entry 0 is", "correct the formula, or leave gamma out"),
    of_start("`force_by_q` with the wrong sign").when(lambda: solve(with_tangents(force_by_q=lambda t, q, v: np.diag([4.0, 0.0])))).says(r"force_by_q of 'pendulum' is not .*entry \(0, 0\) is 4", "correct the formula, or leave all tangents out"),
    of_start("`force_by_q` without `force_by_v`, for a force with damping").when(lambda: solve(with_tangents(force_by_v=None))).says(r"force_by_v of 'pendulum' is not .*give force_by_v", "give force_by_v too"),
    of_start("`reaction_by_q` of twice the right values").when(lambda: solve(with_tangents(reaction_by_q=lambda t, q, lam: 2.0 * lam[0] * np.eye(2)))).says(r"reaction_by_q of 'pendulum' is not .*entry \(0, 0\)", "correct the formula, or leave reaction_by_q out"),
]
