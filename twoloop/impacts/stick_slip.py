"""solve_with_friction: arcs of a motion in which joints slide, and stick, under dry friction."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import lsq_linear

from twoloop.checks.arguments import check_positive, check_span, check_times, check_tolerance, shown
from twoloop.impacts.contact import Accelerations
from twoloop.impacts.joined import joined
from twoloop.impacts.laws import NEGLIGIBLE, responses
from twoloop.impacts.motion import CORRECTIONS, MOST_STANDING, OF_A_RUN, STANDS, terminal
from twoloop.methods.plan import Method
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result
from twoloop.run.record import Status
from twoloop.solve import solve_dae

if TYPE_CHECKING:
    from twoloop.bodies.model_problem import ModelProblem

Array = NDArray[np.float64]

REST = 1e-10  # of the largest velocities of the last arc: rates of joints that count as zero
INDEPENDENT = 1e-9  # of how a joint yields alone, over the same of a free body
AT_MOST = 1e-9  # relative: friction that holds with all that it has


def solve_with_friction(
    problem: ModelProblem,
    t_span: tuple[float, float] | None = None,
    method: str | Method = "auto",
    rtol: float = 1e-8,
    atol: ArrayLike = 1e-8,
    *,
    t_eval: ArrayLike | None = None,
    **options: Any,
) -> Result:
    """Integrate a model with dry friction: joints slide, stop, stick, and are released.

    While a joint slides, its friction is a constant force; while it sticks, a row of the constraints, which is released
    when its force exceeds the static friction. Where joints come to rest, those stick whose friction suffices, together
    (the box-constrained minimum of F^T D F / 2 + c^T F, with c the accelerations of the joints without friction).

    Parameters
    ----------
    problem : ModelProblem
        Of a model that has `dry_friction`; begins at its q0 and v0.
    t_span : (float, float), optional
        None: that of the problem.
    method, rtol, atol
        As for `solve_dae`.
    t_eval : array_like, optional
        Times at which to store the states. None: the ends of steps.
    **options
        Further keyword arguments of `solve_dae`: max_step, compiled, time_limit (of each arc), ...

    Returns
    -------
    Result
        `.arcs` are the runs between changes; the names of their systems say which joints stick.

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong, the model has no dry friction, or a joint with it cannot slide by itself.

    Notes
    -----
    Changes are found as events are: a joint that stops and slides on the other way within a quarter of a step is
    missed; `max_step` helps.
    """
    from twoloop.bodies.model_problem import ModelProblem  # which imports much that other motions do without

    if not isinstance(problem, ModelProblem):
        raise TypeError(f"problem must be that of a model, what model.problem() returned; given {shown(problem)}")
    if problem.model is None:
        raise ValueError(f"{problem.name!r} came from another process without its model: make it again there")
    if not problem.model.dry:
        raise ValueError(
            f"{problem.name!r} has no dry friction: add some with model.dry_friction(...), or use solve_dae"
        )
    t0, t1 = problem.t_span if t_span is None else check_span(t_span)
    known = inspect.signature(solve_dae).parameters.keys() - OF_A_RUN
    wrong = [name for name in options if name not in known]
    if wrong:
        raise TypeError(f"solve_with_friction has no option {wrong[0]!r}; those of runs are {', '.join(sorted(known))}")
    check_positive("rtol", rtol)
    options |= {"method": method, "rtol": rtol, "atol": check_tolerance("atol", atol, problem.system.n_q)}
    times = None if t_eval is None else check_times(t_eval, t0, t1, None)
    return _Motion(problem, t0, options).to(t1, times)


class _Motion:
    """What is known of a motion: its state, and what has just stopped or was released."""

    def __init__(self, problem: ModelProblem, t: float, options: dict[str, Any]):
        assert problem.model is not None
        self.problem, self.model, self.options = problem, problem.model, options
        self.t, self.q, self.v = t, problem.q0.copy(), problem.v0.copy()
        self.rubs = self.model.dry
        self._pulls = [self.model.pull(rub, problem.parameters) for rub in self.rubs]
        self._check_independent(problem)
        self.speeds = np.abs(self.v)  # the largest of the last arc
        self.still: set[int] = set()  # joints that have stopped, or stick
        self.released: dict[int, int] = {}  # the direction in which those begin to slide that were held
        self.arcs: list[Result] = []

    def to(self, t1: float, times: Array | None) -> Result:
        """Go on to the end."""
        standing = 0
        while True:
            before = self.t
            self._arc(self._directions(), t1)
            last, system = self.arcs[-1], self.problem.system
            tale = f"{len(self.arcs) - 1} changes between sliding and sticking."
            if last.status != Status.EVENT or self.t >= t1:
                return joined(system, self.arcs, (), times, "", tale)
            standing = standing + 1 if self.t - before <= STANDS * max(1.0, abs(self.t)) else 0
            if standing == MOST_STANDING:
                said = f"Stopped at t = {self.t:.10g}: {standing} changes in a row at this time. Loosen atol"
                return joined(system, self.arcs, (), times, said, tale)

    def _check_independent(self, problem: ModelProblem) -> None:
        """Raise unless each joint can slide while the others stick: else their shares are not determined."""
        W = np.array([self._along(k, self.q) for k in range(len(self.rubs))])
        D = W @ responses(problem.system, self.t, self.q, W)
        scale = (W**2).sum(axis=1) / float(np.abs(problem.system.mass(self.t, self.q)).max())
        for k, rub in enumerate(self.rubs):
            before = D[:k, :k]
            left = D[k, k] - D[k, :k] @ np.linalg.lstsq(before, D[:k, k], rcond=NEGLIGIBLE)[0]
            if not left > INDEPENDENT * scale[k]:
                others = ", ".join(repr(each.name) for each in self.rubs[:k])
                raise ValueError(
                    f"the joint of {rub.name!r} cannot slide by itself: drives or other joints hold it"
                    f"{f', or it moves as those of {others} do' if k else ''}, so that its friction is not determined "
                    "while it sticks; leave it out, and give another joint all of the friction"
                )

    def _along(self, k: int, q: Array) -> Array:
        """By how much a joint slides with the coordinates, (n_q,)."""
        return self._pulls[k].force(0.0, q, np.zeros_like(q))

    def _directions(self) -> list[int]:
        """In which direction each joint slides; 0: it sticks."""
        W = np.array([self._along(k, self.q) for k in range(len(self.rubs))])
        u = W @ self.v
        moves = np.abs(u) > REST * (np.abs(W) @ self.speeds)
        signs = [self.released.get(k, int(np.sign(u[k])) * bool(moves[k])) for k in range(len(u))]
        slow = [k for k in range(len(u)) if k not in self.released and (k in self.still or not moves[k])]
        if not slow:
            return signs
        for k in slow:
            signs[k] = 0
        held, rows = self._mode(signs)
        free = self.model.mode(self.problem.name, self.problem.parameters, self._forces(signs), {}, self.t, self.q)[0]
        a = Accelerations(free, self.t, self.q, self.v, self.options["atol"]).at(self.t, self.q, self.v)[0]
        of = [rows[self.rubs[k].name][0] for k in slow]
        R, W = held.jacobian(self.t, self.q)[of], W[slow]
        c = _turned(R, W) * (R @ a - held.gamma(self.t, self.q, self.v)[of])
        most = np.array([self.rubs[k].static for k in slow])
        D = W @ responses(free, self.t, self.q, W)
        left = D @ (F := _held(D, c, most)) + c  # how the joints accelerate
        terms = np.abs(D) @ np.abs(F) + np.abs(c)
        for k, sign, slides in zip(slow, np.sign(left), np.abs(left) > AT_MOST * terms, strict=True):
            signs[k] = int(sign) * bool(slides)
        return signs

    def _forces(self, signs: list[int]) -> dict[str, float]:
        return {rub.name: -sign * rub.kinetic for rub, sign in zip(self.rubs, signs, strict=True)}

    def _mode(self, signs: list[int]) -> tuple[ConstrainedSystem, dict[str, tuple[int, ...]]]:
        """The system while some joints slide, and those of the sign 0 stick where they are."""
        names = [rub.name for rub, sign in zip(self.rubs, signs, strict=True) if sign == 0]
        known = self.problem.parameters, self._forces(signs)
        gauge, rows = self.model.mode("gauge", *known, dict.fromkeys(names, np.nan), self.t, self.q)
        first, other = (gauge.constraint(t, self.q) for t in (0.0, 0.5 * np.pi)) if names else ((), ())
        held = {}
        for rub in self.rubs:
            if rub.name in names:
                (row,) = rows[rub.name]
                turns = self.model.dimension == 3 and rub.joint.kind == "revolute"  # whose row is A cos t + B sin t
                held[rub.name] = float(np.arctan2(-first[row], other[row]) if turns else first[row])
        said = f"{self.problem.name}, {', '.join(names)} sticks" if names else self.problem.name
        return self.model.mode(said, *known, held, self.t, self.q)

    def _arc(self, signs: list[int], t1: float) -> None:
        """A run until a joint stops, or one that sticks is released."""
        system, rows = self._mode(signs)
        if system.n_c:
            self._close(system)
        holds = Accelerations(system, self.t, self.q, self.v, self.options["atol"])

        def force(k: int, t: float, q: Array, v: Array) -> float:
            (row,) = rows[self.rubs[k].name]
            W = self._along(k, q)
            return float(-holds.at(t, q, v)[1][row] * _turned(system.jacobian(t, q)[[row]], W[None])[0])

        events = [terminal(self._stops(k, sign) if sign else self._lets_go(k, force)) for k, sign in enumerate(signs)]
        options = {**self.options, "check_derivatives": self.options.get("check_derivatives", True) and not self.arcs}
        arc = solve_dae(system, (self.t, t1), self.q, self.v, events=events, dense_output=True, **options)
        self.arcs.append(arc)
        if arc.t.size:
            self.speeds = np.abs(arc.v).max(axis=1)
            self.t, self.q, self.v = float(arc.t[-1]), arc.q[:, -1].copy(), arc.v[:, -1].copy()
        over = {k for k in range(len(signs)) if arc.t_events is not None and arc.t_events[k].size}
        self.released = {k: -int(np.sign(force(k, self.t, self.q, self.v))) for k in over if signs[k] == 0}
        self.still = {k for k in range(len(signs)) if (signs[k] == 0) != (k in over)}

    def _stops(self, k: int, sign: int) -> Any:
        """The event of a joint that comes to rest; one that begins to slide is at rest at first."""
        t0, u0 = self.t, sign * float(self._along(k, self.q) @ self.v)
        begins = k in self.still or k in self.released

        def stops(t: float, q: Array, v: Array) -> float:
            u = sign * float(self._along(k, q) @ v)
            if begins:
                return (u - u0) / (t - t0) if t > t0 else 1.0
            return u

        return stops

    def _lets_go(self, k: int, force: Any) -> Any:
        """The event of a joint that needs more than its friction; one that needs all of it may do so at once."""
        most = self.rubs[k].static
        if abs(force(k, self.t, self.q, self.v)) > (1.0 - AT_MOST) * most:
            most *= 1.0 + AT_MOST
        return lambda t, q, v: most - abs(force(k, t, q, v))

    def _close(self, system: ConstrainedSystem) -> None:
        """Put the state on the constraints of a mode, from which it is off by less than the tolerances."""
        for _ in range(CORRECTIONS):
            off = system.constraint(self.t, self.q)
            self.q = self.q - np.linalg.lstsq(system.jacobian(self.t, self.q), off, rcond=NEGLIGIBLE)[0]
        rows, off = system.rows(self.t, self.q), system.velocity_constraint(self.t, self.q, self.v)
        self.v = self.v - np.linalg.lstsq(rows, off, rcond=NEGLIGIBLE)[0]


def _turned(R: Array, W: Array) -> Array:
    """Signs of rows of constraints against the directions in which joints slide."""
    return np.asarray(np.sign(np.einsum("ij,ij->i", R, W)))


def _held(D: Array, c: Array, most: Array) -> Array:
    """Friction |F| <= most that minimises F^T D F / 2 + c^T F: a joint whose friction is less stays at rest."""
    values, vectors = np.linalg.eigh(0.5 * (D + D.T))
    kept = values > NEGLIGIBLE * values.max(initial=0.0)
    roots = np.sqrt(values[kept])
    B, y = roots[:, None] * vectors[:, kept].T, -(vectors[:, kept].T @ c) / roots
    bound = np.maximum(most, np.finfo(np.float64).tiny)
    return np.asarray(lsq_linear(B, y, (-bound, bound), method="bvls", tol=1e-14).x)
