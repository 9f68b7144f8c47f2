"""Packages that twoloop does without until something asks for them."""

from importlib import import_module
from typing import Any


def needed(module: str, package: str, what: str) -> Any:
    """Import a module of a package that is not among the dependencies.

    Raises
    ------
    ImportError
        If it is not installed; says what needs it and how to install it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise ImportError(f"{what} needs the package {package}: pip install {package}") from error
