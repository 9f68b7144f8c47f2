"""Problems named on the command line: FILE.py:FUNCTION of the user, or a ready mechanism by name."""

import importlib.util
import inspect
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from twoloop import mechanisms
from twoloop.problem.problem import Problem

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
    wanted = _arguments(maker)
    if wanted:
        raise ValueError(
            f"{where} must be a function without arguments that returns a twoloop.mechanisms.Problem; it takes "
            f"{', '.join(wanted)}. If the problem needs these, write a function that calls it with their values"
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
        known = f"{function} is of type {type(maker).__name__}" if hasattr(module, function) else _candidates(module)
        raise ValueError(f"{path} has no function {function}; {known}")
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
    several = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return [each.name for each in parameters if each.default is each.empty and each.kind not in several]
