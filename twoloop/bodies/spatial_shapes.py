"""Bodies of spatial models: mass, inertia and pose, given directly or by a shape."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from twoloop.bodies.documented import documented
from twoloop.bodies.parts import Body
from twoloop.bodies.rotation import euler_parameters, perpendiculars, rotation_matrix
from twoloop.bodies.spatial_gears import SpatialGears
from twoloop.bodies.tables import TENSOR
from twoloop.checks.arguments import Array, check_positive, check_real, check_vector, shown

SYMMETRIC = 1e-9  # relative tolerance of the symmetry of an inertia tensor


@documented
class SpatialShapes(SpatialGears):
    """Adds bodies to a spatial model."""

    dimension = 3

    def body(
        self,
        name: str,
        *,
        mass: float,
        inertia: ArrayLike,
        position: ArrayLike,
        rotation: ArrayLike | None = None,
        velocity: ArrayLike | None = None,
        angular_velocity: ArrayLike | None = None,
    ) -> Body:
        """Add a body.

        Parameters
        ----------
        name : str
        mass : float
            kg.
        inertia : array_like (3,) or (3, 3)
            Principal moments or inertia tensor about the centre of mass in body axes, kg m^2.
        position : array_like (3,)
            Of the centre of mass, m.
        rotation : array_like (3, 3), optional
            Rotation matrix whose columns are the body axes in space. None: the identity.
        velocity : array_like (3,), optional
            Initial velocity of the centre of mass, m/s. None: determined by the other velocities.
        angular_velocity : array_like (3,), optional
            Initial angular velocity in space, rad/s, or None as for `velocity`.
        """
        name, place, weight, speed = self._new_body(name, mass, position, velocity)
        moments = _moments(f"inertia of {name!r}", inertia)
        R = _rotation(f"rotation of {name!r}", np.eye(3) if rotation is None else rotation)
        spin = None
        if angular_velocity is not None:
            spin = check_vector(f"angular_velocity of {name!r}", angular_velocity, 3)
        return self._add_body(Body(name, len(self.bodies), place, R, np.append(weight, moments), speed, spin))

    def rod(self, name: str, start: ArrayLike, end: ArrayLike, *, radius: float, mass: float, **motion: Any) -> Body:
        """Add a uniform cylinder between two points of space; the first axis of the body points from start to end.

        Parameters
        ----------
        name : str
        start, end : array_like (3,)
            m.
        radius : float
            m.
        mass : float
            kg.
        **motion
            `velocity` and `angular_velocity`, as for `body`.
        """
        one, other = check_vector(f"start of {name!r}", start, 3), check_vector(f"end of {name!r}", end, 3)
        length = float(np.linalg.norm(other - one))
        check_positive(f"mass of {name!r}", mass)
        check_positive(f"radius of {name!r}", radius)
        check_positive(f"the length of {name!r}, from start to end,", length)
        along, across = (other - one) / length, mass * (length**2 / 12.0 + radius**2 / 4.0)
        moments = (0.5 * mass * radius**2, across, across)
        R = np.column_stack([along, *perpendiculars(along)])
        return self.body(name, mass=mass, inertia=moments, position=0.5 * (one + other), rotation=R, **motion)

    def box(self, name: str, size: ArrayLike, *, mass: float, position: ArrayLike, **pose: Any) -> Body:
        """Add a uniform box.

        Parameters
        ----------
        name : str
        size : array_like (3,)
            Its edges along the axes of the body, m.
        mass : float
            kg.
        position : array_like (3,)
            Of the centre, m.
        **pose
            `rotation`, `velocity` and `angular_velocity`, as for `body`.
        """
        squares = check_vector(f"size of {name!r}", size, 3) ** 2
        check_positive(f"mass of {name!r}", mass)
        for edge in np.asarray(size, dtype=float):
            check_positive(f"each edge of {name!r}", float(edge))
        return self.body(name, mass=mass, inertia=mass * (squares.sum() - squares) / 12.0, position=position, **pose)

    def sphere(self, name: str, radius: float, *, mass: float, position: ArrayLike, **pose: Any) -> Body:
        """Add a uniform ball.

        Parameters
        ----------
        name : str
        radius : float
            m.
        mass : float
            kg.
        position : array_like (3,)
            Of the centre, m.
        **pose
            `rotation`, `velocity` and `angular_velocity`, as for `body`.
        """
        check_positive(f"radius of {name!r}", radius)
        check_positive(f"mass of {name!r}", mass)
        return self.body(name, mass=mass, inertia=np.full(3, 0.4 * mass * radius**2), position=position, **pose)

    def _check_moments(self, name: str, moments: Array) -> None:
        _moments(f"inertia of {name}", moments[TENSOR].reshape(3, 3))


def _rotation(name: str, given: ArrayLike) -> Array:
    """Return a rotation matrix, orthonormal to rounding."""
    R = check_real(name, given)
    try:
        return rotation_matrix(euler_parameters(R))
    except ValueError:
        raise ValueError(
            f"{name} must be a rotation matrix (3, 3), orthonormal to 1e-9 and right-handed; given {shown(given)}"
        ) from None


def _moments(name: str, given: ArrayLike) -> Array:
    """Return J_xx, J_yy, J_zz, J_xy, J_xz, J_yz from three moments or a tensor."""
    J = check_real(name, given)
    if J.shape not in ((3,), (3, 3)) or not np.isfinite(J).all():
        raise ValueError(
            f"{name} must be three finite moments, shape (3,), or a tensor, shape (3, 3); given {shown(given)}"
        )
    J = np.diag(J) if J.ndim == 1 else J
    if np.abs(J - J.T).max() > SYMMETRIC * np.abs(J).max() or np.linalg.eigvalsh(J).min() <= 0.0:
        raise ValueError(
            f"{name} must be symmetric and positive definite, as a body that turns about an axis without a moment has "
            f"no inertia (give a thin rod a small one); given {shown(given)}"
        )
    J = 0.5 * (J + J.T)
    return np.array([J[0, 0], J[1, 1], J[2, 2], J[0, 1], J[0, 2], J[1, 2]])
