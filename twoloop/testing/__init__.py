"""Mechanisms with known motions, and a conformance check of any simulator against them; needs numpy only."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from twoloop.testing.conformance import check_simulator
    from twoloop.testing.findings import Failure, Finding, Report
    from twoloop.testing.known_parts import KnownBody, KnownJoint
    from twoloop.testing.known_problem import KnownProblem, Motion
    from twoloop.testing.known_problems import problems

_MODULES = {
    "Failure": "findings",
    "Finding": "findings",
    "KnownBody": "known_parts",
    "KnownJoint": "known_parts",
    "KnownProblem": "known_problem",
    "Motion": "known_problem",
    "Report": "findings",
    "check_simulator": "conformance",
    "problems": "known_problems",
}

__all__ = ["Failure", "Finding", "KnownBody", "KnownJoint", "KnownProblem", "Motion", "Report", "check_simulator"]
__all__ += ["problems"]


def __getattr__(name: str) -> Any:  # lazy: pytest imports `plugin` in every run
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
