"""Random mechanisms, each made twice: by `twoloop.bodies`, and by Newton's and Euler's laws in `newton_euler`."""

import numpy as np

from tests.bodies.newton_euler import Laws, turn, velocity
from twoloop.bodies import PlanarModel, SpatialModel

NONE = np.zeros(3)


class Both:
    """A model and its laws, in a plane (`planar`) or in space, to which parts are added together."""

    def __init__(self, seed, planar, n):
        self.random = random = np.random.default_rng(seed)
        self.planar, self.n = planar, n
        gravity = random.uniform(-5.0, 5.0, 3) * (1.0, 1.0, not planar)
        self.model = PlanarModel(gravity[:2]) if planar else SpatialModel(gravity)
        masses, J, self.handles = random.uniform(0.5, 3.0, n), [], []
        self.x, self.R = random.uniform(-1.0, 1.0, (n, 3)), np.empty((n, 3, 3))
        for k in range(n):
            moments = random.uniform(0.1, 1.0, 3)
            if planar:
                self.x[k, 2] = 0.0
                angle = random.uniform(-3.0, 3.0)
                self.R[k] = turn(np.array([0.0, 0.0, angle]))
                J.append(np.diag(moments))
                body = self.model.body(f"b{k}", mass=masses[k], inertia=moments[2], position=self.x[k, :2], angle=angle)
            else:
                self.R[k] = turn(random.uniform(-2.0, 2.0, 3))
                A = random.uniform(-0.3, 0.3, (3, 3))
                J.append(np.diag(moments) + A @ A.T)
                body = self.model.body(f"b{k}", mass=masses[k], inertia=J[k], position=self.x[k], rotation=self.R[k])
            self.handles.append(body)
        self.laws = Laws(masses, J, gravity)

    def handle(self, k):
        return self.model.ground if k is None else self.handles[k]

    def here(self, k, point):
        """A point of space in the axes of a body."""
        return point if k is None else self.R[k].T @ (point - self.x[k])

    def along(self, k, direction):
        return direction if k is None else self.R[k].T @ direction

    def cut(self, vector):
        return vector[:2] if self.planar else vector

    def point(self):
        return self.random.uniform(-1.5, 1.5, 3) * (1.0, 1.0, not self.planar)

    def axis(self):
        """A direction: in a plane within it."""
        axis = self.random.normal(size=3) * (1.0, 1.0, not self.planar)
        return axis / np.linalg.norm(axis)

    def _coincide(self, i, j, point):
        a, b = self.here(i, point), self.here(j, point)
        keep = [0, 1] if self.planar else [0, 1, 2]
        self.laws.rows.append(lambda t, bodies: (bodies.point(j, b) - bodies.point(i, a))[keep])

    def _dot(self, i, one, j, other, value=None):
        a, b = self.along(i, one), self.along(j, other)
        known = one @ other if value is None else value
        self.laws.rows.append(lambda t, bodies: bodies.direction(i, a) @ bodies.direction(j, b) - known)

    def _no_turn(self, i, j):
        """In a plane: one direction of each stays at its angle."""
        self._dot(i, np.array([1.0, 0.0, 0.0]), j, np.array([0.0, 1.0, 0.0]), 0.0)

    def plane_bound(self, k):
        """In a plane: nothing leaves it."""
        self.laws.rows.append(lambda t, bodies: bodies.x[k][2:])
        for direction in np.eye(3)[:2]:
            self._dot(k, direction, None, np.array([0.0, 0.0, 1.0]), 0.0)

    def revolute(self, i, j):
        point = self.point()
        axis = np.array([0.0, 0.0, 1.0]) if self.planar else self.axis()
        more = {} if self.planar else {"axis": 2.3 * axis}
        joint = self.model.revolute(self.handle(i), self.handle(j), at=self.cut(point), **more)
        self._coincide(i, j, point)
        if not self.planar:
            for across in np.linalg.svd(axis[None])[2][1:]:
                self._dot(i, across, j, axis, 0.0)
        return joint, axis, point

    def spherical(self, i, j):
        point = self.point()
        self._coincide(i, j, point)
        return self.model.spherical(self.handle(i), self.handle(j), at=point)

    def universal(self, i, j):
        point, one = self.point(), self.axis()
        other = np.linalg.svd(one[None])[2][1]
        self._coincide(i, j, point)
        self._dot(i, one, j, other, 0.0)
        return self.model.universal(self.handle(i), self.handle(j), at=point, axes=(one, other))

    def cylindrical(self, i, j, slide=False):
        point, axis = self.point(), self.axis()
        a, b = self.here(i, point), self.here(j, point)
        for across in np.linalg.svd(axis[None])[2][1:]:
            if self.planar and abs(across[2]) > 0.5:
                continue
            c = self.along(i, across)
            self.laws.rows.append(lambda t, at, c=c: at.direction(i, c) @ (at.point(j, b) - at.point(i, a)))
            if not self.planar:
                self._dot(i, across, j, axis, 0.0)
        make = self.model.prismatic if slide else self.model.cylindrical
        joint = make(self.handle(i), self.handle(j), at=self.cut(point), axis=self.cut(0.7 * axis))
        return joint, axis, point

    def table(self, i, j):
        point, axis = self.point(), self.axis()
        a, b, c = self.here(i, point), self.here(j, point), self.along(i, axis)
        self.laws.rows.append(lambda t, bodies: bodies.direction(i, c) @ (bodies.point(j, b) - bodies.point(i, a)))
        for across in np.linalg.svd(axis[None])[2][1:]:
            self._dot(i, across, j, axis, 0.0)
        return self.model.planar(self.handle(i), self.handle(j), at=point, axis=1.3 * axis)

    def prismatic(self, i, j):
        joint, axis, point = self.cylindrical(i, j, slide=True)
        if self.planar:
            self._no_turn(i, j)
        else:
            one, other = np.linalg.svd(axis[None])[2][1:]
            self._dot(i, one, j, other, 0.0)
        return joint, axis, point

    def fixed(self, i, j):
        joint = self.model.fixed(self.handle(i), self.handle(j))
        self._coincide(i, j, NONE)
        if self.planar:
            self._no_turn(i, j)
        else:
            for one, other in ((0, 1), (0, 2), (1, 2)):
                self._dot(i, np.eye(3)[one], j, np.eye(3)[other], 0.0)
        return joint

    def distance(self, i, j):
        one, other = self.point(), self.point()
        a, b, length = self.here(i, one), self.here(j, other), np.linalg.norm(one - other)

        def row(t, bodies):
            gap = bodies.point(j, b) - bodies.point(i, a)
            return gap @ gap - length**2

        self.laws.rows.append(row)
        return self.model.distance(self.handle(i), self.cut(one), self.handle(j), self.cut(other))

    def drive(self, i, j, joint, axis, point, motion):
        """`motion`: of t, complex t too."""
        self.model.drive(joint, motion)
        if joint.kind == "prismatic":
            a, b, c = self.here(i, point), self.here(j, point), self.along(i, axis)
            self.laws.rows.append(
                lambda t, bodies: bodies.direction(i, c) @ (bodies.point(j, b) - bodies.point(i, a)) - motion(t)
            )
            return
        one = np.linalg.svd(axis[None])[2][1]
        a, across, b = self.along(i, one), self.along(i, np.cross(axis, one)), self.along(j, one)

        def row(t, bodies):
            turned = bodies.direction(j, b)
            c, s = bodies.direction(i, a) @ turned, bodies.direction(i, across) @ turned
            return s * np.cos(motion(t)) - c * np.sin(motion(t))

        self.laws.rows.append(row)

    def spring(self, i, j, damped=True, stiff=True):
        one, other, random = self.point(), self.point(), self.random
        stiffness, damping, length = random.uniform(5.0, 50.0), random.uniform(0.0, 3.0), random.uniform(0.2, 2.0)
        stiffness, damping = stiffness * stiff, damping * damped
        given = {"stiffness": stiffness, "damping": damping, "length": length}
        self.model.spring(self.handle(i), self.cut(one), self.handle(j), self.cut(other), **given)
        a, b = self.here(i, one), self.here(j, other)

        def load(t, bodies, v, w):
            here, there = bodies.point(i, a), bodies.point(j, b)
            gap, rate = there - here, velocity(bodies, v, w, j, there) - velocity(bodies, v, w, i, here)
            now = np.linalg.norm(gap)
            pull = (stiffness * (now - length) + damping * (rate @ gap) / now) * gap / now
            return [(i, here, pull, NONE), (j, there, -pull, NONE)]

        load.has_potential = not damped
        self.laws.loads.append(load)

    def torsion(self, i, j, joint, axis, damped=True):
        stiffness, damping, rest = self.random.uniform(0.5, 5.0, 3) * (1.0, damped, 1.0)
        self.model.torsion_spring(joint, stiffness=stiffness, damping=damping, angle=rest - 2.0)
        rest -= 2.0
        one = np.linalg.svd(axis[None])[2][1]
        a, n, b = self.along(i, one), self.along(i, axis), self.along(j, one)

        def load(t, bodies, v, w):
            first, along, turned = bodies.direction(i, a), bodies.direction(i, n), bodies.direction(j, b)
            angle = np.arctan2(np.cross(first, turned) @ along, first @ turned)
            one_w, other_w = (NONE if each is None else w[each] for each in (i, j))
            torque = -stiffness * (angle - rest) - damping * (other_w - one_w) @ along
            return [(j, NONE, NONE, torque * along), (i, NONE, NONE, -torque * along)]

        load.has_potential = not damped
        self.laws.loads.append(load)

    def rail(self, i, j, joint, axis, point, damped=True):
        """A spring along a slide, damped by a dashpot and by friction; without, it has a potential."""
        stiffness, damping, rest, rub, speed = self.random.uniform(0.5, 5.0, 5) * (1.0, damped, 1.0, damped, 1.0)
        self.model.axial_spring(joint, stiffness=stiffness, damping=damping, length=rest)
        self.model.friction(joint, rub, speed=speed)
        a, n, b = self.here(i, point), self.along(i, axis), self.here(j, point)

        def load(t, bodies, v, w):
            along, here, there = bodies.direction(i, n), bodies.point(i, a), bodies.point(j, b)
            rate = along @ (velocity(bodies, v, w, j, there) - velocity(bodies, v, w, i, there))
            push = -stiffness * (along @ (there - here) - rest) - damping * rate - rub * np.tanh(rate / speed)
            return [(j, there, push * along, NONE), (i, there, -push * along, NONE)]

        load.has_potential = not damped
        self.laws.loads.append(load)

    def brake(self, i, j, joint, axis):
        most, speed = self.random.uniform(0.5, 5.0, 2)
        self.model.friction(joint, most, speed=speed)
        n = self.along(i, axis)

        def load(t, bodies, v, w):
            along = bodies.direction(i, n)
            one_w, other_w = (NONE if each is None else w[each] for each in (i, j))
            torque = -most * np.tanh((other_w - one_w) @ along / speed) * along
            return [(j, NONE, NONE, torque), (i, NONE, NONE, -torque)]

        self.laws.loads.append(load)

    def motor(self, i, j, joint, axis, point, f):
        self.model.motor(joint, f)
        n, b = self.along(i, axis), self.here(j, point)

        def load(t, bodies, v, w):
            along = bodies.direction(i, n) * f(t)
            if joint.kind == "revolute":
                return [(j, NONE, NONE, along), (i, NONE, NONE, -along)]
            there = bodies.point(j, b)
            return [(j, there, along, NONE), (i, there, -along, NONE)]

        self.laws.loads.append(load)

    def force(self, k, f):
        point = self.point()
        self.model.force(self.handle(k), self.cut(point), lambda t: self.cut(f(t)))
        b = self.here(k, point)
        self.laws.loads.append(lambda t, bodies, v, w: [(k, bodies.point(k, b), f(t), NONE)])

    def torque(self, k, value):
        torque = value * (np.array([0.0, 0.0, 1.0]) if self.planar else self.axis())
        self.model.torque(self.handle(k), torque[2] if self.planar else torque)
        self.laws.loads.append(lambda t, bodies, v, w: [(k, NONE, NONE, torque)])
