"""What the docstrings of all methods that add to a model end with, written once."""

import inspect
from typing import Any

NAME = "name : str, optional\n    For messages and results. None: made of the kind and the bodies.\n"
RAISES = "Raises\n------\nTypeError, ValueError\n    If an argument is wrong, or something of the model has this name."


def documented(cls: Any) -> Any:
    """Add the name, what is returned and what is raised to docstrings of methods that end with their parameters."""
    for method in vars(cls).values():
        text = inspect.cleandoc(getattr(method, "__doc__", None) or "")  # none by python -OO
        if inspect.isfunction(method) and "Parameters\n---" in text and "Raises\n---" not in text:
            optional = inspect.signature(method).parameters.get("name")
            named = NAME if optional is not None and optional.default is None else ""
            returns = f"\nReturns\n-------\n{method.__annotations__['return']}\n"
            method.__doc__ = f"{text}\n{named}{returns}\n{RAISES}"
    return cls
