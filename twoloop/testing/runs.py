"""Run a simulator on a problem, or on a transformed version of it, within a time limit."""

import ctypes
import threading
from collections.abc import Callable
from contextvars import copy_context
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from twoloop.testing.problem import DIMENSIONS, GROUND, Array, KnownProblem, euler_parameters, skew

ROTATION, AXIS = 0.7, np.array([1.0, 2.0, -1.5]) / np.sqrt(7.25)  # rotation angle, rad, and its axis in space
TRANSLATION = np.array([1.7, -2.3, 0.9])  # relative to the largest length among the coordinates
Simulate = Callable[[KnownProblem, Array, float], Any]


@dataclass(frozen=True, eq=False)
class Transformed:
    """A problem in the coordinates T q + d, and the inverse transformation.

    Attributes
    ----------
    problem : KnownProblem
        The problem given to the simulator; without `reference`.
    T : ndarray (n_q, n_q)
    d : ndarray (n_q,)
    rows : ndarray (n_c,)
        Scale factors of the rows of C.
    work : float
        Scale factor of energies.
    """

    problem: KnownProblem
    T: Array
    d: Array
    rows: Array
    work: float

    def to_original(self, q: Array, v: Array | None, lam: Array | None) -> tuple[Array, Array | None, Array | None]:
        """Transform states, given as rows, back to the coordinates of the original problem."""
        inverse = np.linalg.inv(self.T)
        return (
            (q - self.d) @ inverse.T,
            None if v is None else v @ inverse.T,
            None if lam is None else lam * self.rows / self.work,
        )


def change_frame(problem: KnownProblem, angle: float = ROTATION, distance: float = 1.0) -> Transformed:
    """Return the problem in a frame rotated by `angle`, rad, and translated by `distance` times the default."""
    T, d = np.eye(problem.n_q), np.zeros(problem.n_q)
    kinds = problem.coordinates
    lengths = [abs(value) for kind, value in zip(kinds, problem.q0, strict=True) if kind in "xyz"]
    shift = distance * TRANSLATION * max(lengths, default=0.0)
    n = 3 if "z" in kinds else 2
    R, p = _rotation(angle, n == 3)
    for k, kind in enumerate(kinds):
        if kind == "x":
            T[k : k + n, k : k + n], d[k : k + n] = R[:n, :n], shift[:n]
        elif kind == "angle":
            d[k] = angle
        elif kind == "e0":  # the product of two quaternions is linear in each
            product = p[0] * np.eye(4)
            product[0, 1:], product[1:, 0] = -p[1:], p[1:]
            product[1:, 1:] += skew(p[1:])
            T[k : k + 4, k : k + 4] = product
    return _transform(problem, T, d, np.ones(problem.n_c), 1.0, _parts_in_frame(problem, R[:n, :n], shift[:n], angle))


def _parts_in_frame(problem: KnownProblem, R: Array, shift: Array, angle: float) -> dict[str, Any]:
    joints = []
    for joint in problem.joints:
        fields: dict[str, Any] = {}
        if joint.bodies[1] == GROUND:
            fields["points"] = joint.points[0], R @ joint.points[1] + shift
            fields["axis"] = None if joint.axis is None else R @ joint.axis
        if joint.motion is not None:
            drive, *rates = joint.motion
            fields["motion"] = (lambda t, drive=drive: drive(t) + angle, *rates)
        joints.append(replace(joint, **fields))
    parameters = dict(problem.parameters)
    if "gravity" in parameters:
        parameters["gravity"] = R @ parameters["gravity"]
    gravity = None if problem.gravity is None else R @ problem.gravity
    return {"joints": tuple(joints), "gravity": gravity, "parameters": parameters}


def _rotation(angle: float, spatial: bool) -> tuple[Array, Array]:
    """Return a rotation matrix (3, 3) and its Euler parameters (4,); in the plane about z."""
    axis = AXIS if spatial else np.array([0.0, 0.0, 1.0])
    R = np.eye(3) + np.sin(angle) * skew(axis) + (1.0 - np.cos(angle)) * skew(axis) @ skew(axis)
    return R, euler_parameters(R)


def change_units(problem: KnownProblem) -> Transformed:
    """Return the problem with lengths in mm and masses in g; the unit of time stays s."""
    T = np.diag([1e3 if kind in "xyz" else 1.0 for kind in problem.coordinates])
    parts: dict[str, Any] = {
        "bodies": tuple(replace(body, mass=1e3 * body.mass, inertia=1e9 * body.inertia) for body in problem.bodies),
        "joints": tuple(
            replace(joint, points=(1e3 * a, 1e3 * b), length=length and 1e3 * length)
            for joint in problem.joints
            for (a, b), length in [(joint.points, joint.length)]
        ),
        "gravity": None if problem.gravity is None else 1e3 * problem.gravity,
        # a metre is 1e3 mm, and a kilogram 1e3 g
        "parameters": {name: value * 1e3 ** sum(DIMENSIONS[name]) for name, value in problem.parameters.items()},
    }
    return _transform(problem, T, np.zeros(problem.n_q), 1e3**problem.row_powers, 1e3 * 1e3**2, parts)


def _transform(
    problem: KnownProblem, T: Array, d: Array, rows: Array, work: float, parts: dict[str, Any]
) -> Transformed:
    inverse = np.linalg.inv(T)

    def original(q: Array) -> Array:
        return inverse @ (np.asarray(q, dtype=float) - d)

    fields: dict[str, Any] = parts | {
        "mass": lambda t, q: work * inverse.T @ problem.mass(t, original(q)) @ inverse,
        "force": lambda t, q, v: work * inverse.T @ problem.force(t, original(q), inverse @ v),
        "constraint": lambda t, q: rows * problem.constraint(t, original(q)),
        "jacobian": lambda t, q: rows[:, None] * problem.jacobian(t, original(q)) @ inverse,
        "constraint_rate": lambda t, q: rows * problem.constraint_rate(t, original(q)),
        "gamma": lambda t, q, v: rows * problem.gamma(t, original(q), inverse @ v),
    }
    energy = problem.energy
    if energy is not None:
        fields["energy"] = lambda t, q, v: work * energy(t, original(q), inverse @ v)
    fields |= {"q0": T @ problem.q0 + d, "v0": T @ problem.v0, "reference": None, "invariants": {}}
    return Transformed(replace(problem, **fields), T, d, rows, work)


def restart_at(problem: KnownProblem, k: int, n_intervals: int) -> KnownProblem:
    """Return the problem started at the k-th state of its known motion, for some intervals between its times."""
    motion = problem.reference
    assert motion is not None
    span = float(motion.t[k]), float(motion.t[k] + n_intervals * (motion.t[1] - motion.t[0]))
    return replace(problem, q0=motion.q[k], v0=motion.v[k], t_span=span, reference=None)


class TimeLimitExceeded(Exception):
    """A run that passed the time limit."""


class _Stop(SystemExit):
    """Raised within a run that has passed the limit; no `except Exception` of a simulator catches it."""


class TimeLimitedSimulator:
    """A simulator whose runs raise `TimeLimitExceeded` after some seconds; it is not run again after that."""

    def __init__(self, simulate: Any, seconds: float | None):
        self._simulate, self._seconds, self.timeout_message = simulate, seconds, ""

    def __call__(self, problem: KnownProblem, times: Array, setting: float) -> Any:
        """Return what the simulator returns, or raise what it raises."""
        if self._seconds is None:
            return self._simulate(problem, times, setting)
        if self.timeout_message:
            raise TimeLimitExceeded(self.timeout_message)
        output: list[Any] = []
        errors: list[BaseException] = []

        def run() -> None:
            try:
                output.append(self._simulate(problem, times, setting))
            except BaseException as error:  # also what pytest.skip raises: it belongs to the caller
                errors.append(error)

        thread = threading.Thread(target=copy_context().run, args=(run,), daemon=True)
        thread.start()
        try:
            thread.join(self._seconds)
        finally:  # also at Ctrl-C
            still_running = thread.is_alive()
            if still_running:
                _stop(thread)
        if still_running:
            self.timeout_message = f"did not end within {self._seconds:g} s"
            raise TimeLimitExceeded(self.timeout_message)
        if errors:
            raise errors[0]
        return output[0]


def _stop(thread: threading.Thread) -> None:
    """Raise `_Stop` in a thread, which ends it once it is back in Python code."""
    assert thread.ident is not None
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread.ident), ctypes.py_object(_Stop))
    thread.join(0.1)


@dataclass(frozen=True, eq=False)
class SimulatorRun:
    """Output of a simulator: states (n_t, n_q), multipliers (n_t, n_c), or the error message."""

    t: Array
    q: Array
    v: Array | None
    lam: Array | None
    error: str = ""
    timed_out: bool = False  # passed the time limit

    @property
    def complete(self) -> bool:
        """True if all numbers are finite."""
        arrays = [array for array in (self.q, self.v, self.lam) if array is not None]
        return not self.error and all(np.isfinite(array).all() for array in arrays)


def run_simulator(simulate: Simulate, problem: KnownProblem, times: Array, setting: float) -> SimulatorRun:
    """Run a simulator on a problem. An exception of the simulator is a failed run; a wrong shape raises."""
    try:
        output = simulate(problem, times.copy(), setting)
    except Exception as error:
        timed_out, nan_states = isinstance(error, TimeLimitExceeded), np.full((times.size, problem.n_q), np.nan)
        message = f"{'' if timed_out else f'{type(error).__name__}: '}{error}".strip().rstrip(":")
        return SimulatorRun(times, nan_states, None, None, message, timed_out)
    parts = output if isinstance(output, tuple) else (output,)
    if not 1 <= len(parts) <= 3:
        raise TypeError(
            f"simulate must return q, (q, v) or (q, v, lam); on {problem.name!r} it returned a tuple of {len(parts)}"
        )
    widths = (problem.n_q, problem.n_q, problem.n_c)
    arrays = [
        _check_array(problem, name, part, (times.size, width))
        for name, part, width in zip(("q", "v", "lam"), parts, widths, strict=False)
    ]
    q, v, lam = [*arrays, None, None][:3]
    if q is None:
        raise TypeError(f"simulate must return at least q; on {problem.name!r} it returned None")
    return SimulatorRun(times, q, v, lam)


def to_original(run: SimulatorRun, transformed: Transformed) -> SimulatorRun:
    """Return a run of a transformed problem in the coordinates of the original."""
    return SimulatorRun(run.t, *transformed.to_original(run.q, run.v, run.lam), run.error)


def _check_array(problem: KnownProblem, name: str, part: Any, shape: tuple[int, int]) -> Array | None:
    """Return an array of the expected shape; None for None."""
    if part is None:
        return None
    try:
        if np.iscomplexobj(part):
            raise TypeError("complex numbers")
        array = np.asarray(part, dtype=float)
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"simulate must return arrays of numbers; on {problem.name!r} {name} is {type(part).__name__}: {error}"
        ) from None
    if array.shape != shape:
        advice = " (transpose it)" if array.shape == shape[::-1] else ""
        raise ValueError(
            f"simulate must return {name} with a row for each time, of shape {shape} on {problem.name!r}; "
            f"it returned shape {array.shape}{advice}"
        )
    return array
