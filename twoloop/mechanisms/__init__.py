"""Ready problems, each with its invariants and, where one exists, a reference.

A mechanism is imported on first access, because its first import compiles its callbacks.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from twoloop.problem.problem import Condition, Problem, Reference

if TYPE_CHECKING:
    from twoloop.mechanisms.ancf_beam import ancf_beam, moderately_stiff_beam, very_flexible_beam
    from twoloop.mechanisms.andrews import andrews
    from twoloop.mechanisms.bricard import bricard
    from twoloop.mechanisms.chain import closed_chain, double_pendulum
    from twoloop.mechanisms.driven_crank import driven_crank
    from twoloop.mechanisms.four_bar import four_bar
    from twoloop.mechanisms.governor import governor
    from twoloop.mechanisms.heavy_top import heavy_top
    from twoloop.mechanisms.knife_edge import knife_edge
    from twoloop.mechanisms.n_four_bar import n_four_bar
    from twoloop.mechanisms.pendulum import pendulum, projection_pendulum
    from twoloop.mechanisms.rolling_disc import rolling_disc
    from twoloop.mechanisms.slider_crank import driven_slider_crank, redundant_slider_crank
    from twoloop.mechanisms.spatial_four_bar import spatial_four_bar
    from twoloop.mechanisms.spatial_slider_crank import spatial_slider_crank
    from twoloop.mechanisms.sundials_slider_crank import sundials_slider_crank

_ELSEWHERE = {  # functions whose modules have other names
    "closed_chain": "chain",
    "double_pendulum": "chain",
    "driven_slider_crank": "slider_crank",
    "moderately_stiff_beam": "ancf_beam",
    "projection_pendulum": "pendulum",
    "redundant_slider_crank": "slider_crank",
    "very_flexible_beam": "ancf_beam",
}

__all__ = ["Condition", "Problem", "Reference", "ancf_beam", "andrews", "bricard", "closed_chain", "double_pendulum"]
__all__ += ["driven_crank", "driven_slider_crank", "four_bar", "governor", "heavy_top", "knife_edge"]
__all__ += ["moderately_stiff_beam", "n_four_bar", "pendulum", "projection_pendulum", "redundant_slider_crank"]
__all__ += ["rolling_disc", "spatial_four_bar", "spatial_slider_crank", "sundials_slider_crank", "very_flexible_beam"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_ELSEWHERE.get(name, name)}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__


class _Package(ModuleType):
    """A package in which `four_bar` is the function; Python would replace it by the submodule of that name."""

    def __setattr__(self, name: str, value: Any) -> None:
        if isinstance(value, ModuleType) and name in __all__:
            value = getattr(value, name)
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
