"""What the docstrings of all methods that add to a model end with, written once."""

import inspect
from typing import Any

NAME = "name : str, optional\n    For messages and results. None: made of the kind and the bodies.\n"
RAISED = "Raises\n------\n"
RAISES = f"{RAISED}TypeError, ValueError\n    If an argument is wrong, or something of the model has this name."


def documented(cls: Any) -> Any:
    """Add name, return and, unless it is there, what is raised to docstrings of methods that add to a model."""
    for method in vars(cls).values():
        text = inspect.cleandoc(getattr(method, "__doc__", None) or "")  # none by python -OO
        adds = inspect.isfunction(method) and "Parameters\n---" in text and "Returns\n---" not in text
        if adds and method.__annotations__["return"] != "None":
            text, raised, which = text.partition(RAISED)
            optional = inspect.signature(method).parameters.get("name")
            named = NAME if optional is not None and optional.default is None else ""
            returns = f"\nReturns\n-------\n{method.__annotations__['return']}\n"
            method.__doc__ = f"{text.rstrip()}\n{named}{returns}\n{f'{RAISED}{which}' if raised else RAISES}"
    return cls
