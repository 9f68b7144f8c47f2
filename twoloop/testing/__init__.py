"""Mechanisms with known motions, and a conformance check of any simulator against them; needs numpy only."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from twoloop.testing.conformance import check_simulator
    from twoloop.testing.mechanisms import problems
    from twoloop.testing.problem import KnownBody, KnownJoint, KnownProblem, Motion
    from twoloop.testing.properties import Finding, Report

_MODULES = {
    **dict.fromkeys(("KnownBody", "KnownJoint", "KnownProblem", "Motion"), "problem"),
    **dict.fromkeys(("Finding", "Report"), "properties"),
    "check_simulator": "conformance",
    "problems": "mechanisms",
}

__all__ = ["Finding", "KnownBody", "KnownJoint", "KnownProblem", "Motion", "Report", "check_simulator"]
__all__ += ["problems"]


def __getattr__(name: str) -> Any:  # lazy: pytest imports `plugin` in every run
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
