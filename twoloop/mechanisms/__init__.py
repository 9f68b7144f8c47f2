"""Provide ready problems, each with its invariants and, where one exists, a reference.

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
    from twoloop.mechanisms.four_bar import four_bar
    from twoloop.mechanisms.knife_edge import knife_edge
    from twoloop.mechanisms.n_four_bar import n_four_bar
    from twoloop.mechanisms.natural import bricard, closed_chain, double_pendulum, pendulum, projection_pendulum
    from twoloop.mechanisms.rolling_disc import rolling_disc
    from twoloop.mechanisms.slider_cranks import (
        driven_crank,
        driven_slider_crank,
        redundant_slider_crank,
        sundials_slider_crank,
    )
    from twoloop.mechanisms.spatial import governor, heavy_top, spatial_four_bar, spatial_slider_crank

_MODULES = {  # of mechanisms whose modules have other names
    "ancf_beam": ("moderately_stiff_beam", "very_flexible_beam"),
    "natural": ("bricard", "closed_chain", "double_pendulum", "pendulum", "projection_pendulum"),
    "slider_cranks": ("driven_crank", "driven_slider_crank", "redundant_slider_crank", "sundials_slider_crank"),
    "spatial": ("governor", "heavy_top", "spatial_four_bar", "spatial_slider_crank"),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}

__all__ = ["Condition", "Problem", "Reference", "ancf_beam", "andrews", "bricard", "closed_chain", "double_pendulum"]
__all__ += ["driven_crank", "driven_slider_crank", "four_bar", "governor", "heavy_top", "knife_edge"]
__all__ += ["moderately_stiff_beam", "n_four_bar", "pendulum", "projection_pendulum", "redundant_slider_crank"]
__all__ += ["rolling_disc", "spatial_four_bar", "spatial_slider_crank", "sundials_slider_crank", "very_flexible_beam"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_MODULE_OF.get(name, name)}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__


class _Package(ModuleType):
    """Keep `four_bar` the function; Python would replace it by the submodule of that name."""

    def __setattr__(self, name: str, value: Any) -> None:
        if isinstance(value, ModuleType) and name in __all__:
            value = getattr(value, name)
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
