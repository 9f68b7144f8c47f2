"""Problems named on a command line: FILE.py:FUNCTION of the user's own, or a ready mechanism by its name."""

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
    """The problem that FILE.py:FUNCTION makes, or the ready mechanism of that name.

    Raises
    ------
    ValueError
        If there is no such file, function or mechanism, or it takes arguments, or does not return a `Problem`; an
        exception of the file itself comes through.
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
    sys.path.insert(0, str(path.parent.resolve()))  # for files beside it
    spec.loader.exec_module(module)
    maker = getattr(module, function, None)
    if not callable(maker):
        known = f"{function} is of type {type(maker).__name__}" if hasattr(module, function) else _candidates(module)
        raise ValueError(f"{path} has no function {function}; {known}")
    return maker


def _candidates(module: ModuleType) -> str:
    """The functions of a file that could make a problem."""
    names = [
        name
        for name, value in vars(module).items()
        if inspect.isfunction(value) and value.__module__ == module.__name__ and not _arguments(value)
    ]
    return f"functions without arguments are {', '.join(names)}" if names else "it has none without arguments"


def _arguments(maker: Callable[..., Any]) -> list[str]:
    """What a function cannot be called without."""
    try:
        parameters = inspect.signature(maker).parameters.values()
    except ValueError:  # a built-in that does not say
        return []
    several = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return [each.name for each in parameters if each.default is each.empty and each.kind not in several]
