"""Build mechanisms from bodies, joints and forces; a model becomes a `Problem` with its equations of motion.

A name is imported at its first use: what ready mechanisms need of this package imports next to nothing.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from twoloop.bodies.file_parts import IgnoredWarning
    from twoloop.bodies.mjcf_reader import from_mjcf
    from twoloop.bodies.planar.model import PlanarModel
    from twoloop.bodies.spatial.model import SpatialModel
    from twoloop.bodies.urdf_reader import Loop, from_urdf

_MODULES = {
    "IgnoredWarning": "file_parts",
    "Loop": "urdf_reader",
    "PlanarModel": "planar.model",
    "SpatialModel": "spatial.model",
    "from_mjcf": "mjcf_reader",
    "from_urdf": "urdf_reader",
}

__all__ = ["IgnoredWarning", "Loop", "PlanarModel", "SpatialModel", "from_mjcf", "from_urdf"]


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        globals()[name] = found = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
        return found
    if not name.startswith("_") and find_spec(f"{__name__}.{name}") is not None:
        return import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
