"""Newton's and Euler's laws of bodies in maximal coordinates, written apart from twoloop: positions and matrices.

A model is a list of parts, each a tuple; bodies are (x, R) with the velocities (v, w), w along the axes of space. What
a joint asks for is a function of these; its first derivatives are taken by complex steps, its second ones along the
motion by differences of order 8. In a plane all bodies have z = 0 and turn about z.
"""

import numpy as np

STEP = 1e-30
WEIGHTS = (-205.0 / 72.0, 8.0 / 5.0, -1.0 / 5.0, 8.0 / 315.0, -1.0 / 560.0)  # second derivative, of order 8
H = 3e-2


def skew(w):
    return np.array([[0.0 * w[0], -w[2], w[1]], [w[2], 0.0 * w[0], -w[0]], [-w[1], w[0], 0.0 * w[0]]])


def turn(w):
    """The rotation by the vector w: Rodrigues' formula; to first order where w is the size of a complex step."""
    angle = np.sqrt(np.sum(np.real(w) ** 2))
    K = skew(w)
    if angle == 0.0:
        return np.eye(3) + K
    return np.eye(3) + np.sin(angle) / angle * K + (1.0 - np.cos(angle)) / angle**2 * K @ K


class Bodies:
    """What is asked of bodies (ground: None) at positions x (n, 3) and rotations R (n, 3, 3)."""

    def __init__(self, x, R):
        self.x, self.R = x, R

    def point(self, body, place):
        return place if body is None else self.x[body] + self.R[body] @ place

    def direction(self, body, components):
        return components if body is None else self.R[body] @ components


class Laws:
    """A mechanism at its position: `masses`, tensors `J` along the axes of the bodies, and rows of constraints.

    `rows`: functions (t, bodies) -> array; `powers`: functions (t, bodies, v, w) -> list of (body, point, force) and
    (body, torque), forces in space.
    """

    def __init__(self, masses, J, gravity):
        self.masses, self.J, self.gravity = np.array(masses), np.array(J), np.array(gravity)
        self.rows, self.loads = [], []

    def constraint(self, t, x, R):
        bodies = Bodies(x, R)
        parts = [np.atleast_1d(row(t, bodies)) for row in self.rows]
        return np.concatenate(parts) if parts else np.zeros(0)

    def _moved(self, x, R, v, w, s):
        """Positions after a time s at constant velocities; s may be a complex step."""
        if np.iscomplexobj(s):
            return x + s * v, np.array([(np.eye(3) + skew(s * each)) @ at for each, at in zip(w, R, strict=True)])
        return x + s * v, np.array([turn(s * each) @ at for each, at in zip(w, R, strict=True)])

    def matrix(self, t, x, R):
        """Derivative of the rows by (v, w) of all bodies, (n_c, 6 n)."""
        n = len(x)
        columns = []
        for j in range(6 * n):
            u = np.zeros((n, 6))
            u.flat[j] = 1.0
            columns.append(np.imag(self.constraint(t, *self._moved(x, R, u[:, :3], u[:, 3:], 1j * STEP))) / STEP)
        return np.array(columns).T

    def rate(self, t, x, R):
        return np.imag(self.constraint(t + 1j * STEP, x.astype(complex), R)) / STEP

    def curvature(self, t, x, R, v, w):
        """Second derivative of the rows along the motion without acceleration."""
        total = WEIGHTS[0] * self.constraint(t, x, R)
        for k in range(1, 5):
            for s in (k * H, -k * H):
                total = total + WEIGHTS[k] * self.constraint(t + s, *self._moved(x, R, v, w, s))
        return total / H**2

    def accelerations(self, t, x, R, v, w):
        """Accelerations of the centres and angular ones in space, (n, 3) each."""
        n = len(x)
        M, F = np.zeros((6 * n, 6 * n)), np.zeros((n, 6))
        for k in range(n):
            J = R[k] @ self.J[k] @ R[k].T
            M[6 * k : 6 * k + 3, 6 * k : 6 * k + 3] = self.masses[k] * np.eye(3)
            M[6 * k + 3 : 6 * k + 6, 6 * k + 3 : 6 * k + 6] = J
            F[k, :3] = self.masses[k] * self.gravity
            F[k, 3:] = -np.cross(w[k], J @ w[k])
        bodies = Bodies(x, R)
        for body, point, force, torque in self.applied(t, bodies, v, w):
            F[body, :3] += force
            F[body, 3:] += np.cross(point - x[body], force) + torque
        B = self.matrix(t, x, R)
        m = len(B)
        K = np.block([[M, B.T], [B, np.zeros((m, m))]])
        right = np.concatenate([F.ravel(), -self.curvature(t, x, R, v, w)])
        a = np.linalg.lstsq(K, right, rcond=1e-11)[0][: 6 * n].reshape(n, 6)
        return a[:, :3], a[:, 3:]

    def applied(self, t, bodies, v, w, springs=True):
        """(body, point, force, torque) of all loads on bodies that move; or of those without a potential."""
        for load in self.loads:
            if not springs and getattr(load, "has_potential", False):
                continue
            for body, point, force, torque in load(t, bodies, v, w):
                if body is not None:
                    yield body, point, force, torque


def velocity(bodies, v, w, body, point):
    """Of the point in space of a body."""
    return np.zeros(3) if body is None else v[body] + np.cross(w[body], point - bodies.x[body])
