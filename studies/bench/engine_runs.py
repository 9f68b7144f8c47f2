"""Run physics engines on closed loops: reference motions, checks of the models, errors and times."""

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from references.engines.rigid import Motion, Prepared, Rigid, coordinates, largest_moment, rigid_of, states, tensor
from studies.bench.closed_loops import parallelogram, parallelogram_motion
from studies.bench.store import Array, Row
from twoloop import ConstraintWarning, solve_dae
from twoloop.audit.simulator import gaps
from twoloop.bodies.model_problem import ModelProblem

PARALLEL = parallelogram().name
INSTANTS = 50  # beside the start, at which motions are compared
TIGHT = 1e-12  # tolerance of both routes to a reference
LIMIT = 1.0  # s of CPU that the next finer run may be expected to take
# time of the gates, as a share of the span, and steps within it, of which one pair must do: Drake's loops take some
# steps to hold, and Exudyn's accelerations carry rounding over the square of the step
GATES = (1e-5, 1), (1e-5, 10), (1e-5, 200), (1e-3, 20)
SAME_POSE, SAME_INERTIA, SAME_ACCELERATION, SAME_PLACE = 1e-9, 1e-9, 5e-3, 1e-6
TIMED, ENOUGH = 3, 0.3  # calls of which the shortest counts, and s of CPU after which no further one is made


@dataclass(frozen=True)
class Loop:
    """A mechanism with its reference motion."""

    problem: ModelProblem

    @cached_property
    def rigid(self) -> Rigid:
        return rigid_of(self.problem)

    @property
    def t_end(self) -> float:
        return self.problem.t_span[1]

    @cached_property
    def times(self) -> Array:
        return np.linspace(0.0, self.t_end, INSTANTS + 1)

    def solve(self, tolerance: float, times: Array | None = None, t0: float = 0.0, **more: Any) -> Any:
        options: dict[str, Any] = {"rtol": tolerance, "atol": tolerance, "t_eval": times, **more}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConstraintWarning)
            problem = self.problem
            return solve_dae(problem.system, (t0, t0 + self.t_end), problem.q0, problem.v0, **options)

    @cached_property
    def reference(self) -> tuple[Motion, float]:
        """Return the motion, and the largest difference of a second, unlike solution at any instant.

        Raises RuntimeError if one of them fails.
        """
        if self.problem.name == PARALLEL:  # no method crosses its singular positions so tightly
            q, v, apart = parallelogram_motion(self.times)
            return self.motion(q, v), apart
        plain = partial(self.solve, TIGHT, self.times, compiled=False)  # references are no reason to compile
        runs = [plain(method=method) for method in ("DOP853", "RadauIIA9")]
        if not all(run.success for run in runs):
            raise RuntimeError(next(run.message for run in runs if not run.success))
        one, other = (self.motion(run.q, run.v, self.force(run)) for run in runs)
        return one, float(max(np.abs(one.x - other.x).max(), np.abs(one.R - other.R).max()))

    @cached_property
    def kinetic(self) -> float:
        """Return the largest kinetic energy of the reference, J."""
        known, bodies = self.reference[0], self.rigid.model.bodies
        J = np.array([tensor(body.inertia) for body in bodies])
        local = np.einsum("tkji,tkj->tki", known.R, known.w)
        m = np.array([body.inertia[0] for body in bodies])
        each = m * (known.v**2).sum(axis=2) + np.einsum("tki,kij,tkj->tk", local, J, local)
        return float(0.5 * each.sum(axis=1).max())

    def force(self, run: Any) -> Array:
        """Return the force of the first joint that closes a loop, as in `Motion`; NaN if it is not unique."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConstraintWarning)
            reaction = run.reactions(self.rigid.cut)
        if not reaction.unique:
            return np.full((run.t.size, 3), np.nan)
        return np.pad(reaction.force.T, ((0, 0), (0, 3 - len(reaction.force))))

    def motion(
        self, q: Array, v: Array, f: Array | None = None, call_s: float = 0.0, stepping_s: float = 0.0
    ) -> Motion:
        """Return the motion of coordinates of the model, at the instants."""
        f = np.full((q.shape[1], 3), np.nan) if f is None else f
        return Motion(self.times[: q.shape[1]], *states(self.rigid.planar, q, v), f, call_s, stepping_s)

    @cached_property
    def start_rates(self) -> dict[float, tuple[Array, Array]]:
        """Return the changes of v and w within the times of the checks, by these times."""
        spans = [0.0, *sorted({share * self.t_end for share, _ in GATES})]
        run = self.solve(TIGHT, np.array(spans), method="DOP853", compiled=False)
        _, _, v, w = states(self.rigid.planar, run.q, run.v)
        return {span: (v[k] - v[0], w[k] - w[0]) for k, span in enumerate(spans)}


def gate(loop: Loop, prepared: Prepared) -> str:
    """Say what is wrong with a model before anything is timed; an empty text if it is the mechanism."""
    rigid = loop.rigid
    bodies = rigid.model.bodies
    for what, own, given in (
        ("mass", prepared.masses, [body.inertia[0] for body in bodies]),
        ("largest moment of inertia", prepared.moments, [largest_moment(body.inertia) for body in bodies]),
    ):
        for body, one, other in zip(bodies, own, given, strict=True):
            if abs(one - other) > SAME_INERTIA * other:
                return f"the {what} of {body.name!r} is {one:.6g} instead of {other:.6g}"
    wrong = ""
    for share, n_steps in GATES:
        span = share * loop.t_end
        motion = prepared.run(span, n_steps, 1)
        if motion.message:
            wrong = f"the first steps fail: {motion.message}"
            continue
        pose = max(np.abs(motion.x[0] - rigid.x).max(), np.abs(motion.R[0] - rigid.R).max())
        if pose > SAME_POSE:
            return f"the pose at the start is off by {pose:.2g}"
        gap = gaps(rigid.model, motion.x, motion.R)[-1]
        wrong = _accelerated(loop, motion, span) or (
            f"joints gape by {gap:.2g} m at the start" if gap > SAME_PLACE else ""
        )
        if not wrong:
            return ""
    return wrong


def _accelerated(loop: Loop, motion: Motion, span: float) -> str:
    """Say by how much accelerations at the start are off; angular ones at the bodies' radii of gyration."""
    dv, dw = loop.start_rates[span]
    bodies = loop.rigid.model.bodies
    size = np.array([np.sqrt(np.trace(tensor(each.inertia)) / 2.0 / each.inertia[0]) for each in bodies])[:, None]
    changes = (motion.v[1] - motion.v[0], dv), (size * (motion.w[1] - motion.w[0]), size * dw)
    largest = max(float(np.abs(expected).max()) for _, expected in changes)
    for name, (change, expected) in zip(("", "angular "), changes, strict=True):
        off = np.abs(change - expected).max() / largest
        if off > SAME_ACCELERATION:
            return f"{name}accelerations at the start are off by {off:.2g} of the largest: a loop, an inertia, a motor?"
    return ""


def errors(loop: Loop, motion: Motion) -> Row:
    """Return the largest errors of a motion that reached its end, over the instants."""
    (known, _), rigid = loop.reference, loop.rigid
    off = max(np.abs(motion.x - known.x).max(), np.abs(motion.R - known.R).max())
    fastest = max(np.linalg.norm(known.v, axis=2).max(), 1e-12)
    energies = [loop.problem.energy(each.t, *coordinates(each, rigid.planar)) for each in (motion, known)]
    d = 2 if rigid.planar else 3  # what holds a mechanism in its plane is not unique
    f = np.abs(motion.f - known.f)[1:, :d].max() / np.abs(known.f[:, :d]).max()  # Drake's first step holds no loop
    values = {
        "error_f": f,
        "error_q": off,
        "error_v": np.abs(motion.v - known.v).max() / fastest,
        "gap": gaps(rigid.model, motion.x, motion.R).max(),
        "energy": np.abs(energies[0] - energies[1]).max() / loop.kinetic,
    }
    return {name: float(value) for name, value in values.items()}


def timed(run: Callable[[int], Motion]) -> tuple[float, float]:
    """Return the CPU time of the shortest of some calls, whole and stepping; run(k) makes the k-th."""
    calls: list[tuple[float, float]] = []
    began = time.process_time()
    while len(calls) < TIMED and (not calls or time.process_time() - began < ENOUGH):
        motion = run(len(calls))
        calls.append((motion.call_s, motion.stepping_s))
    return min(calls)
