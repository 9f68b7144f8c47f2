"""The mechanisms of the comparison: one file each, with a function `cases(quick)` that returns a list of `Case`."""

from importlib import import_module
from pkgutil import iter_modules

from studies.bench.collector import Case


def load(quick: bool) -> list[Case]:
    """All cases of all files in this folder, in the order of the files' names."""
    names = sorted(module.name for module in iter_modules(__path__))
    return [case for name in names for case in import_module(f"{__name__}.{name}").cases(quick)]
