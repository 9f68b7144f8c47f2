"""Compute joint forces and torques from the multipliers of a result."""

from dataclasses import dataclass

import numpy as np

from twoloop.checks.arguments import Array, check_text
from twoloop.checks.sparse_rows import SparseRows
from twoloop.problem.description import Joint
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.record import Record

NEGLIGIBLE = 1e-6  # a reaction is unique if unit lam with C_q^T lam = 0 change it by at most this, relative to rows


@dataclass(frozen=True)
class Reaction:
    """Force and torque of a joint on its body; on the other body, or the ground, the opposite acts.

    Components are along the axes of space, with one column per time of `Result.t`.

    Attributes
    ----------
    force : ndarray (2 or 3, n_t)
        Force on the body, N.
    torque : ndarray (n_t,) or (3, n_t)
        Torque on the body about `point`, N m; in the plane positive from x to y. Zero for a point mass.
    point : ndarray (2 or 3, n_t)
        Position of the joint in space, m.
    unique : bool
        True if the reaction is uniquely determined. False where rows of the joint depend on other rows, so that joints
        may share the load in any proportion: `force` and `torque` are then those of the multipliers of minimum norm.
        The sum C_q^T lam, hence the sum of all reactions on a body, is unique in any case. Determined at the first
        time of the result; later losses of rank are not detected.

    Examples
    --------
    >>> from twoloop import solve_dae
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> result = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0)
    >>> pin = result.reactions("1-2")
    >>> pin.force.shape == (2, result.t.size), pin.unique
    (True, True)
    """

    force: Array
    torque: Array
    point: Array
    unique: bool


def reactions(result: Record, name: str) -> Reaction:
    """Return force and torque of a joint on its body at the times `t`.

    They are equivalent to the generalised reaction -C_q^T lam (or -A^T mu) of the rows of the joint and act on the
    body named by the joint, with components along the axes of space; e.g. a bob hanging from a link is pulled
    upwards. The other body gets the opposite. Where rows are linearly dependent, the multipliers, and hence the
    reactions of single joints, may not be unique: see `Reaction.unique`.

    Parameters
    ----------
    name : str
        Name of a joint of the system (`problem.joints` of a ready mechanism).

    Returns
    -------
    Reaction
        `.force` (2 or 3, n_t), N, and `.torque` (n_t,) or (3, n_t), N m, about `.point` (2 or 3, n_t), m;
        `.unique`.

    Raises
    ------
    ValueError
        If there is no joint of this name, the system has no joints, or the result was read without its system.
    """
    check_text("name", name)
    if result.system is None or not result.system.joints:
        raise ValueError(
            "reactions need joints, and this result has none. Name them in the system, joints=[twoloop.Joint(...)] "
            "(ready mechanisms have theirs in problem.joints); to a result in a file give the system: "
            "twoloop.load(path, system)"
        )
    system = result.system
    joints = {joint.name: joint for joint in system.joints}
    if name not in joints:
        raise ValueError(f"name must be a joint of {system.name!r}: {', '.join(map(repr, joints))}; given {name!r}")
    joint = joints[name]
    multipliers = result.lam if joint.equations is None else np.linalg.solve(joint.equations.T, result.lam)
    generalized = np.empty((len(joint.translation + joint.rotation), result.t.size))
    for k, t in enumerate(result.t):
        generalized[:, k] = -_rows(system, joint, t, result.q[:, k]).T @ multipliers[list(joint.rows), k]
    point = _point(joint, result.q)
    force, torque = _force_and_torque(joint, result.q, point, generalized)
    return Reaction(force, torque, point, _is_unique(result, system, joint))


def _rows(system: ConstrainedSystem, joint: Joint, t: float, q: Array) -> Array:
    """Return the entries of the joint's constraint rows in the columns of the coordinates of its body."""
    columns = joint.translation + joint.rotation
    if joint.equations is not None:
        return (joint.equations @ system.rows(t, q))[np.ix_(joint.rows, columns)]
    rows = system.sparse_rows(t, q)
    return rows.part(joint.rows, columns) if isinstance(rows, SparseRows) else rows[np.ix_(joint.rows, columns)]


def _point(joint: Joint, q: Array) -> Array:
    """Return the position of the joint in space, (2 or 3, n_t)."""
    origin, angles = q[list(joint.translation)], q[list(joint.rotation)]
    if joint.point is None:
        return origin
    point = np.repeat(np.array(joint.point)[:, None], q.shape[1], axis=1)
    if joint.in_space:
        return point
    if len(angles) == 1:
        s, c = np.sin(angles[0]), np.cos(angles[0])
        point = np.stack([c * point[0] - s * point[1], s * point[0] + c * point[1]])
    elif len(angles) == 4:
        from twoloop.bodies.rotation import rotated  # compiled on import

        point = np.stack(rotated.py_func(*angles, *point))
    elif len(angles) == 9:
        point = np.einsum("kit,kt->it", angles.reshape(3, 3, -1), point)
    return origin + point


def _force_and_torque(joint: Joint, q: Array, point: Array, generalized: Array) -> tuple[Array, Array]:
    """Return the force, and the torque about `point`, that a generalised force (n, n_t) exerts on the joint's body."""
    dimension = len(joint.translation)
    force, moments = generalized[:dimension], generalized[dimension:]
    angles, arm = q[list(joint.rotation)], point - q[list(joint.translation)]
    if len(moments) == 0:
        return force, np.zeros(force.shape[1:] if dimension == 2 else force.shape)
    if dimension == 2:
        return force, moments[0] - (arm[0] * force[1] - arm[1] * force[0])
    if len(moments) == 4:  # e' = G^T w / 2 with angular velocity w, so the torque in body axes is G moments / 2
        from twoloop.bodies.rotation import half_spin, rotated  # compiled on import

        torque = 0.5 * np.stack(rotated.py_func(*angles, *half_spin.py_func(*angles, *moments)))
    else:  # each column of the rotation matrix moves like a lever arm
        torque = np.cross(angles.reshape(3, 3, -1), moments.reshape(3, 3, -1), axis=1).sum(axis=0)
    return force, torque - np.cross(arm, force, axis=0)


def _is_unique(result: Record, system: ConstrainedSystem, joint: Joint) -> bool:
    """Return True if no multipliers with C_q^T lam = 0 change the reaction, at the first time of the result."""
    n_rows = len(result.lam)
    if result.t.size == 0 or result.rank == n_rows:
        return True
    t, q = result.t[0], result.q[:, 0]
    all_rows = system.rows(t, q)
    rank = np.linalg.matrix_rank(all_rows) if result.rank is None else result.rank
    null_space = np.linalg.svd(all_rows)[0][:, rank:]
    if joint.equations is not None:
        null_space = np.linalg.solve(joint.equations.T, null_space)
    rows = _rows(system, joint, t, q)
    generalized = rows.T @ null_space[list(joint.rows)]
    q = np.repeat(q[:, None], null_space.shape[1], axis=1)
    force, torque = _force_and_torque(joint, q, _point(joint, q), generalized)
    return bool(max(np.abs(force).max(initial=0.0), np.abs(torque).max(initial=0.0)) <= NEGLIGIBLE * np.abs(rows).max())
