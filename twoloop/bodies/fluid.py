"""Forces of a medium on bodies by MuJoCo's inertia model: drag and viscous resistance of the equivalent box.

The box has the mass and the principal moments of the body. With its half edges r along the principal axes, the velocity
v of its centre relative to the medium and its angular velocity w in these axes, density rho and viscosity beta:

    f_i = -2 rho r_j r_k |v_i| v_i - 6 pi beta r v_i,    g_i = -rho/2 r_i (r_j^4 + r_k^4) |w_i| w_i - 8 pi beta r^3 w_i

where r is the mean of the half edges (MuJoCo's documentation, Computation, Fluid forces, Inertia model).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from twoloop.bodies.file_parts import Lump
from twoloop.bodies.frames import vector_of
from twoloop.bodies.parts import Body
from twoloop.bodies.rotation import rate_of_vector, spin_of
from twoloop.bodies.tendons import smooth_size

ROUNDED = 1e-8  # below this rate, m/s or rad/s, |v| v is smoothed without a branch; it changes by less than 1e-16
LEAST_MOMENT = 1e-15  # kg m^2: MuJoCo's lower bound for the moment from which it computes an edge of the box


@dataclass(frozen=True)
class Medium:
    """Density, viscosity and velocity (wind) of the medium around a mechanism."""

    density: float = 0.0
    viscosity: float = 0.0
    wind: tuple[float, ...] = (0.0, 0.0, 0.0)

    def act(self, model: Any, body: Body, lump: Lump, names: list[str]) -> None:
        """Add force and torque on a mass given in the axes of a body; `names`: names of the force and the torque."""
        assert lump.axes is not None
        axes = lump.axes
        J = np.diag(axes.T @ lump.J @ axes)
        half = np.sqrt(1.5 / lump.mass * np.maximum(J.sum() - 2.0 * J, LEAST_MOMENT))
        others = [(half[i - 2], half[i - 1]) for i in range(3)]
        drag = [2.0 * self.density * a * b for a, b in others]
        twist = [0.5 * self.density * r * (a**4 + b**4) for r, (a, b) in zip(half, others, strict=True)]
        mean = float(half.mean())
        slow = 6.0 * np.pi * self.viscosity * mean, 8.0 * np.pi * self.viscosity * mean**3
        columns = tuple(map(tuple, axes.T))
        pairs = zip((tuple(lump.centre), None), (drag, twist), slow, (self.wind, (0.0,) * 3), strict=True)
        force, torque = (partial(_resistance, body, columns, at, tuple(map(float, c)), s, u) for at, c, s, u in pairs)
        model.force(body, body.point(*lump.centre), force, name=names[0])
        model.torque(body, torque, name=names[1])


def _resistance(
    body: Body, axes: Any, point: Any, quadratic: Any, linear: float, wind: Any, t: Any, q: Any, v: Any
) -> Any:
    """Return the force against the velocity of a body's point or, if `point` is None, the torque against its spin."""
    if point is None:
        speed = spin_of(q, v, body.number)
    else:
        turning = rate_of_vector(q, v, body.number, point)
        speed = [v[k] + x - w for k, x, w in zip(body.coordinates, turning, wind, strict=False)]
    total: list[Any] = [0.0, 0.0, 0.0]
    for axis, factor in zip(axes, quadratic, strict=True):
        n = vector_of(q, body.number, axis)
        u = sum(x * y for x, y in zip(n, speed, strict=True))
        size = u * (factor * smooth_size(u, ROUNDED) if factor else 0.0) + linear * u
        total = [x - size * y for x, y in zip(total, n, strict=True)]
    return total
