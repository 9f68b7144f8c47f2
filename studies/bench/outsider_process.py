"""The process in which a solver from a file runs: it calls the solver whenever it is asked, and times each call.

It is a fork of the process of the study: what the solver prints, imports or breaks stays here.
"""

import faulthandler
import importlib.util
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from references.driver import cpu_time
from references.equations.accelerations import compiled_gamma
from twoloop.mechanisms import Problem
from twoloop.mechanisms.registry import problem_from
from twoloop.rows.row_format import calibration_s
from twoloop.testing.problem import Array, KnownProblem
from twoloop.testing.runs import run_simulator


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
