"""Mechanisms built from bodies, joints and forces; a model becomes a `Problem` with its equations of motion."""

from twoloop.bodies.mjcf_geometry import IgnoredWarning
from twoloop.bodies.mjcf_reader import from_mjcf
from twoloop.bodies.planar_model import PlanarModel
from twoloop.bodies.spatial_model import SpatialModel
from twoloop.bodies.urdf_reader import Loop, from_urdf

__all__ = ["IgnoredWarning", "Loop", "PlanarModel", "SpatialModel", "from_mjcf", "from_urdf"]
