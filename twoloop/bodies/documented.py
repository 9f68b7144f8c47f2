"""Appends the common sections to the docstrings of all methods that add to a model."""

import inspect
from typing import Any

NAME = "name : str, optional\n    Used in messages and results. None: made of the kind and the bodies.\n"
RAISED = "Raises\n------\n"
RAISES = f"{RAISED}TypeError, ValueError\n    If an argument is invalid, or the name is taken."


def documented(cls: Any) -> Any:
    """Add the sections on name, return value and exceptions to docstrings of methods that add to a model."""
    for method in vars(cls).values():
        text = inspect.cleandoc(getattr(method, "__doc__", None) or "")  # python -OO removes docstrings
        adds = inspect.isfunction(method) and "Parameters\n---" in text and "Returns\n---" not in text
        if adds and method.__annotations__["return"] != "None":
            text, raised, which = text.partition(RAISED)
            optional = inspect.signature(method).parameters.get("name")
            named = NAME if optional is not None and optional.default is None else ""
            returns = f"\nReturns\n-------\n{method.__annotations__['return']}\n"
            method.__doc__ = f"{text.rstrip()}\n{named}{returns}\n{f'{RAISED}{which}' if raised else RAISES}"
    return cls
