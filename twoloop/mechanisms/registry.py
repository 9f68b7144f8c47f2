"""Assemble ready problems with their references, and find problems by name or in a file of the user.

The references are in `references.json`, written by `tests/mechanisms/make_references.py`. Each is the final state of a
motion in minimal coordinates, integrated in extended precision, independently of the callbacks of the mechanism. The
multipliers are computed from its own matrices at that state.
"""

import importlib.util
import inspect
import json
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from twoloop import mechanisms
from twoloop.checks.arguments import Array
from twoloop.problem.problem import Problem, Reference

if TYPE_CHECKING:
    from twoloop.bodies.model_problem import Model

REFERENCES = Path(__file__).with_name("references.json")


@cache
def _stored_references() -> dict[str, Any]:
    return dict(json.loads(REFERENCES.read_text(encoding="utf-8")))


def stored_reference(name: str) -> Reference | None:
    """Return the reference of a problem by name; None if there is none."""
    stored = _stored_references().get(name)
    if stored is None:
        return None
    q, v, lam = (np.array(stored[kind]) for kind in ("q", "v", "lam"))
    return Reference(
        t=stored["t"],
        q=q,
        v=v,
        lam=lam,
        source="computed for this project: few coordinates, extrapolation of order 18 in extended precision",
        digits=stored["digits"],
        verified=(
            "the mechanism's own equations at index 1, by SciPy's DOP853 at 1e-13, agree to "
            f"{stored['agrees']['q']:.1f} digits in q and {stored['agrees']['v']:.1f} in v"
        ),
    )


def ready(rows: Any, name: str, q0: Array, v0: Array, t_end: float, **attributes: Any) -> Problem:
    """Return the problem of the collected rows, starting at t = 0; `attributes` override theirs."""
    attributes = {"energy": rows.energy, "drawing": rows.drawing, **attributes}
    attributes.setdefault("reference", stored_reference(name))
    system = attributes.pop("system", None) or rows.system(name)
    return Problem(name=name, system=system, q0=q0, v0=v0, t_span=(0.0, t_end), **attributes)


def ready_model(model: "Model", t_end: float, **attributes: Any) -> Problem:
    """Return the problem of a model with further attributes, starting at t = 0."""
    problem = model.problem((0.0, t_end))
    parts = {name: getattr(problem, name) for name in ("name", "system", "q0", "v0", "t_span", "energy", "drawing")}
    return Problem(
        **{**parts, "coordinates": problem.coordinates, "reference": stored_reference(problem.name), **attributes}
    )


EXPECTED = "give FILE.py:FUNCTION, such as crane.py:crane, or a ready mechanism, such as four_bar"


def problem_from(where: str) -> Problem:
    """Return the problem made by FILE.py:FUNCTION, or the ready mechanism of that name.

    Raises
    ------
    ValueError
        If there is no such file, function or mechanism, or it takes arguments, or does not return a `Problem`.
        Exceptions of the file itself are passed on.
    """
    if where.replace("-", "_").isidentifier():
        names = [name for name in mechanisms.__all__ if inspect.isfunction(getattr(mechanisms, name))]
        if where not in names:
            raise ValueError(f"{EXPECTED}; there is no mechanism {where} among {', '.join(names)}")
        maker = getattr(mechanisms, where)
    else:
        maker = _function_of_a_file(where)
    arguments = _arguments(maker)
    if arguments:
        raise ValueError(
            f"{where} must be a function without arguments that returns a twoloop.mechanisms.Problem; it takes "
            f"{', '.join(arguments)}. If the problem needs these, write a function that calls it with their values"
        )
    problem = maker()
    if not isinstance(problem, Problem):
        raise ValueError(f"{where} must return a twoloop.mechanisms.Problem; it returned {type(problem).__name__}")
    return problem


def _function_of_a_file(where: str) -> Callable[..., Any]:
    file, _, function = where.rpartition(":")
    path = Path(file)
    if not (file and function.isidentifier()):
        raise ValueError(f"{EXPECTED}; given {where}")
    if not path.is_file():
        raise ValueError(f"there is no file {path.resolve()}")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None:
        raise ValueError(f"{path} is not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    sys.path.insert(0, str(path.parent.resolve()))  # for imports from the same folder
    spec.loader.exec_module(module)
    maker = getattr(module, function, None)
    if not callable(maker):
        available = (
            f"{function} is of type {type(maker).__name__}" if hasattr(module, function) else _candidates(module)
        )
        raise ValueError(f"{path} has no function {function}; {available}")
    return maker


def _candidates(module: ModuleType) -> str:
    """Return a text with the functions of a file that could make a problem."""
    names = [
        name
        for name, value in vars(module).items()
        if inspect.isfunction(value) and value.__module__ == module.__name__ and not _arguments(value)
    ]
    return f"functions without arguments are {', '.join(names)}" if names else "it has none without arguments"


def _arguments(maker: Callable[..., Any]) -> list[str]:
    """Return the required arguments of a function."""
    try:
        parameters = inspect.signature(maker).parameters.values()
    except ValueError:  # a built-in function without a signature
        return []
    variadic = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return [p.name for p in parameters if p.default is p.empty and p.kind not in variadic]
