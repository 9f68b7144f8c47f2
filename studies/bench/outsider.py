"""Solvers from files: `simulate(problem, times, tolerance)` of `twoloop.testing`, each in a process of its own."""

import hashlib
import multiprocessing
import os
import signal
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np

from references import as_shown
from references.driver import user_call
from studies.bench.cli import StudyError
from studies.bench.collector import FILE, Case, NotApplicable, Solver
from studies.bench.outsider_process import serve
from studies.bench.solvers import TOLERANCES
from twoloop import Result, Statistics, Status

SHOWN = Path(as_shown.__file__).parent
N_TIMES = 101  # states that a solver is asked for, the first of which is the start
START = 300.0  # s that the process may take to load twoloop, the mechanism and the solver


class Outsider:
    """A solver of a file on one mechanism, in a process that is started when it is asked, and again when it has died.

    `where`: FILE.py:FUNCTION, or a file of `references.as_shown` by its name. `mechanism`: as `problem_from` takes it.

    `name`: in rows. `digest`: of the file. `calibrated`: s of the calibration beside the last call
    (`twoloop.rows.row_format`).

    Raises StudyError if there is no such file.
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
        return Solver(self.name, FILE, "Python", True, "tol", self._run, TOLERANCES, own_accelerations=True)

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
        """The answer of the process; None where it does not come in time.

        Raises RuntimeError if the process ends instead.
        """
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
