"""Find the forces of actuators that cause the same motion as drives in other joints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.linalg import null_space

from twoloop.bodies.coordinates import JointCoordinate
from twoloop.checks.arguments import Array
from twoloop.problem.system import ConstrainedSystem

SINGULAR = 1e-9  # singular values below this fraction of the largest count as zero
CANNOT = 1e-6  # largest part of the drives' forces, relative to them, that actuators may fail to replace


def actuator_forces(
    system: ConstrainedSystem, result: Any, drives: Sequence[int], actuators: Sequence[JointCoordinate]
) -> Array:
    """Return the forces u of actuators (n, n_t) that have the same effect as the drives; `drives`: their rows of C.

    In all motions that the other rows permit, actuators and drives have the same power: N^T B^T u = -N^T G^T lam. The
    columns of N span these motions; B and G are the gradients of the coordinates of the actuators and of the drives.
    At singular positions, where the actuators do not determine the motion, u is NaN.
    """
    forces = np.full((len(actuators), len(result.t)), np.nan)
    others = np.setdiff1d(np.arange(system.n_c + system.n_a), drives)
    unit = np.eye(system.n_q)
    for k, t in enumerate(result.t.tolist()):
        q, lam = result.q[:, k], result.lam[:, k]
        rows = system.rows(t, q)
        free = null_space(rows[others], rcond=SINGULAR)
        powers = np.reshape([each.rate(q, unit) for each in actuators], (-1, system.n_q)) @ free
        wanted = -lam[drives] @ rows[drives] @ free
        sizes = np.linalg.norm(powers, axis=1)
        if not (sizes > 0.0).all():
            continue
        u, _, rank, _ = np.linalg.lstsq((powers / sizes[:, None]).T, wanted, rcond=SINGULAR)
        if rank < len(actuators):
            continue
        left = np.abs(u @ (powers / sizes[:, None]) - wanted).max(initial=0.0)
        if left > CANNOT * np.abs(lam[drives, None] * rows[drives]).max(initial=0.0):
            names = ", ".join(repr(each.joint) for each in actuators)
            raise ValueError(
                f"actuators in {names or 'no joint'} cannot make the motion that the drives of {system.name!r} "
                f"prescribe, at t = {t:g}: bodies also move that they do not control. Give as many actuators as "
                "drives, in the same loops"
            )
        forces[:, k] = u / sizes
    return forces
