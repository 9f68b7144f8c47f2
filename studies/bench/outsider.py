"""Run solvers from files, `simulate(problem, times, tolerance)` of `twoloop.testing`, each in its own process.

The process is a fork of the study's process, which sends the calls and times them: what the solver prints, imports or
breaks stays in its process.
"""

import faulthandler
import hashlib
import importlib.util
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np

from references import as_shown
from references.driver import cpu_time, user_call
from references.equations.accelerations import compiled_gamma
from studies.bench.cli import StudyError
from studies.bench.collector import FILE, Case, NotApplicable, Solver
from studies.bench.solvers import TOLERANCES
from twoloop import Result, Statistics, Status
from twoloop.mechanisms import Problem
from twoloop.mechanisms.registry import problem_from
from twoloop.rows.row_format import calibration_s
from twoloop.testing.problem import Array, KnownProblem, run_simulator


def known_problem(problem: Problem, t0: float, q0: Array, v0: Array, t_end: float) -> KnownProblem:
    """A mechanism as `simulate` of `twoloop.testing` takes it, without what is known of its motion."""
    system = problem.system
    gamma_into, p = compiled_gamma(system), system.functions.p

    def gamma(t: float, q: Array, v: Array) -> Array:
        right = np.zeros(system.n_c)
        gamma_into(t, np.array(q, dtype=float), np.array(v, dtype=float), p, right)
        return right

    functions: Any = system.mass, system.force, system.constraint, system.jacobian, system.constraint_rate, gamma
    energy, coordinates = problem.energy if problem.conserved else None, tuple(map(str, problem.coordinates))
    about: Any = energy, q0, v0, (t0, t0 + t_end), problem.tags, coordinates, np.ones(system.n_c)
    return KnownProblem(problem.name, *functions, *about, note=problem.note)  # type: ignore[misc]


def loaded(path: Path, function: str) -> Callable[..., Any]:
    """The function of a file. Raises AttributeError if there is none; an exception of the file itself comes through."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules.setdefault(path.stem, module)
    sys.path.insert(0, str(path.parent))
    spec.loader.exec_module(module)
    found = getattr(module, function, None)
    if not callable(found):
        raise AttributeError(f"{path.name} has no function {function}")
    return found  # type: ignore[no-any-return]


def run(simulate: Callable[..., Any], problem: Problem, ask: dict[str, Any]) -> dict[str, Any]:
    """What a call returned, and what it took."""
    posed = known_problem(problem, ask["t0"], ask["q0"], ask["v0"], ask["t_end"])
    n_forces, force, seconds = 0, posed.force, 0.0

    def counted(t: float, q: Array, v: Array) -> Array:
        nonlocal n_forces
        n_forces += 1
        return force(t, q, v)

    def clocked(*given: Any) -> Any:
        nonlocal seconds
        began = cpu_time()
        try:
            return simulate(*given)
        finally:
            seconds = cpu_time() - began

    times = np.linspace(*posed.t_span, ask["n_times"])
    calibration = calibration_s()
    try:
        found = run_simulator(clocked, replace(posed, force=counted), times, ask["value"])
    except (TypeError, ValueError) as error:  # of another shape
        return {"failure": str(error)}
    if found.error or not found.complete:
        return {"failure": found.error or "numbers that are not finite"}
    seconds_of_calibration = min(calibration, calibration_s())
    counts = {"seconds": seconds, "calibration_s": seconds_of_calibration, "n_forces": n_forces}
    return {"q": found.q, "v": found.v, "lam": found.lam, **counts}


def serve(connection: Connection, parent: Connection, errors: int, path: Path, function: str, mechanism: str) -> None:
    """Load a solver and answer calls until the study ends; `parent`: the end of the pipe that is the study's."""
    parent.close()
    faulthandler.disable()  # a crash is a row, not a traceback of the study
    os.setsid()  # a group of its own, so that what it starts ends with it
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream, target in ((0, nothing), (1, nothing), (2, errors)):
        os.dup2(target, stream)
    sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)  # pytest's are others
    os.chdir(path.parent)
    try:
        problem, simulate = problem_from(mechanism), loaded(path, function)
        failure = ""
    except BaseException as error:  # whatever a file does when it is imported
        failure = f"{type(error).__name__}: {error}"
    os.dup2(nothing, 2)  # what runs print is dropped
    connection.send({"failure": failure})
    while not failure:
        try:
            ask = connection.recv()
        except EOFError:
            return
        connection.send(run(simulate, problem, ask))


SHOWN = Path(as_shown.__file__).parent
N_TIMES = 101  # states that a solver is asked for, the first of which is the start
START = 300.0  # s that the process may take to load twoloop, the mechanism and the solver


class Outsider:
    """Solver from a file for one mechanism, in a process that is started at a call, and again after it has died.

    `where`: FILE.py:FUNCTION, or the name of a file of `references.as_shown`. `mechanism`: as `problem_from` takes it.
    `name`: name in rows. `digest`: digest of the file. `calibrated`: time of the calibration beside the last call, s
    (`twoloop.rows.row_format`). Raises StudyError if there is no such file.
    """

    def __init__(self, where: str, mechanism: str):
        shown = SHOWN / f"{where}.py"
        file, _, self.function = (f"{shown}:simulate" if where.isidentifier() else where).rpartition(":")
        self.path = Path(file).resolve()
        if not self.function.isidentifier() or not self.path.is_file():
            known = ", ".join(sorted(each.stem for each in SHOWN.glob("[!_]*.py")))
            raise StudyError(f"--solver takes FILE.py:FUNCTION, a file that there is, or one of {known}; given {where}")
        self.name = f"{self.path.name}:{self.function}"
        self.digest = hashlib.sha256(self.path.read_bytes()).hexdigest()[:10]
        model, _, maker = mechanism.rpartition(":")  # a file, as it is found from another folder
        self.mechanism, self.calibrated = f"{Path(model).resolve()}:{maker}" if model else mechanism, float("nan")
        self._process: Any = None
        self._pipe: Connection | None = None
        self._spent, self._said = "", list[str]()  # the last line of its errors

    def solver(self) -> Solver:
        """Its entry in a catalogue."""
        return Solver(self.name, FILE, "Python", True, "tol", self._run, TOLERANCES)

    def start(self) -> None:
        """Start the process, which loads the file. Raises StudyError if it cannot."""
        context = multiprocessing.get_context("fork")  # which has twoloop loaded
        self._pipe, there = context.Pipe()
        self._errors = TemporaryFile()  # noqa: SIM115  # until the file is loaded; `end` closes it
        given = there, self._pipe, self._errors.fileno(), self.path, self.function, self.mechanism
        self._process = context.Process(target=serve, args=given)
        self._process.start()
        there.close()
        try:
            said = self._asked({}, START) or {"failure": f"not loaded in {START:g} s"}
        except RuntimeError as error:
            said = {"failure": ": ".join([str(error), *self._said])}
        if said["failure"]:
            self.end()
            raise StudyError(f"{self.path} is no solver: {said['failure']}")

    def _run(self, case: Case, tolerance: float, repeat: int) -> Result:
        """A run, as solvers of the catalogue are run."""
        system, (t0, _), q0, v0 = case.start
        if system.n_a:
            raise NotApplicable("a solver from a file gets no constraints of velocities alone")
        ask = {"t0": t0, "t_end": case.t_end, "q0": q0, "v0": v0, "value": tolerance, "n_times": N_TIMES}
        if self._spent:
            return _failed(case, self._spent)
        answer = self._asked(ask, case.time_limit)
        if answer is None:
            limit = f"time_limit = {case.time_limit:g} s"
            self._spent = f"Not back by {limit} at the tolerance {tolerance:g}, and asked no more."
            return _failed(case, self._spent)
        if "failure" in answer:
            return _failed(case, answer["failure"])
        if answer["v"] is None:
            raise RuntimeError("it returns positions alone; return (q, v)")
        user_call.seconds = answer["seconds"]
        self.calibrated = answer["calibration_s"]
        q, v = answer["q"].T, answer["v"].T
        none = np.full_like(q, np.nan)
        lam = np.full((system.n_c, N_TIMES), np.nan) if answer["lam"] is None else answer["lam"].T
        times, counts = np.linspace(t0, t0 + case.t_end, N_TIMES), {"n_evaluations": answer["n_forces"] or None}
        stats = Statistics(**counts, cpu_time=answer["seconds"])
        return Result(times, q, v, none, lam, np.empty(0), Status.REACHED_END, f"{self.name} returned.", stats)

    def _asked(self, ask: dict[str, Any], limit: float) -> dict[str, Any] | None:
        """Return the answer of the process, or None after `limit` s; raise RuntimeError if the process ends."""
        if self._pipe is None:
            self.start()
        assert self._pipe is not None and self._process is not None
        try:
            if ask:
                self._pipe.send(ask)
            if not self._pipe.poll(limit):
                self.end()
                return None
            return dict(self._pipe.recv())
        except (EOFError, OSError):  # it has died
            process = self._process
            self.end()
            code = process.exitcode
            why = f"by {signal.Signals(-code).name}" if code < 0 else f"with status {code}"
            raise RuntimeError(f"the process of the solver ended {why}") from None

    def end(self) -> None:
        """End the process, if there is one, and what it has started."""
        if self._process is None or self._pipe is None:
            return
        self._pipe.close()
        self._process.join(0.2)  # it ends by itself where it has died, or listens
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.join()
        with self._errors:
            self._errors.seek(0)
            self._said = self._errors.read().decode("utf-8", "replace").strip().splitlines()[-1:]
        self._process = self._pipe = None


def _failed(case: Case, message: str) -> Result:
    """A result of the start alone."""
    _, (t0, _), q0, v0 = case.start
    start = (np.array([t0]), q0[:, None], v0[:, None], 0.0 * q0[:, None], np.zeros((case.problem.system.n_c, 1)))
    return Result(*start, np.empty(0), Status.SOLVER_FAILED, message, Statistics(cpu_time=0.0))
