"""Problems from files of the user's own, named on a command line as FILE.py:FUNCTION."""

import importlib.util
import sys
from pathlib import Path

from twoloop.mechanisms.problem import Problem


def problem_from(where: str) -> Problem:
    """The problem that FILE.py:FUNCTION makes.

    Raises
    ------
    ValueError
        If there is no such file or function, or it does not return a `Problem`; an exception of the file itself comes
        through.
    """
    file, _, function = where.rpartition(":")
    path = Path(file)
    if not (file and function.isidentifier()):
        raise ValueError(f"give FILE.py:FUNCTION, such as crane.py:crane; given {where}")
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
        raise ValueError(f"{path} has no function {function}")
    problem = maker()
    if not isinstance(problem, Problem):
        raise ValueError(f"{where} must return a twoloop.mechanisms.Problem; it returned {type(problem).__name__}")
    return problem
