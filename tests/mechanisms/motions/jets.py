"""Numbers that carry their first two derivatives by one parameter, for mechanisms with one degree of freedom."""

import numpy as np


class Jet:
    """x, dx/ds and d2x/ds2."""

    __slots__ = ("u", "w", "x")

    def __init__(self, x, u=0, w=0):
        self.x, self.u, self.w = x, u, w

    def __add__(self, o):
        return Jet(self.x + o.x, self.u + o.u, self.w + o.w) if isinstance(o, Jet) else Jet(self.x + o, self.u, self.w)

    def __neg__(self):
        return Jet(-self.x, -self.u, -self.w)

    def __sub__(self, o):
        return self + (-o)

    def __rsub__(self, o):
        return -self + o

    def __mul__(self, o):
        if isinstance(o, Jet):
            return Jet(self.x * o.x, self.u * o.x + self.x * o.u, self.w * o.x + 2 * self.u * o.u + self.x * o.w)
        return Jet(self.x * o, self.u * o, self.w * o)

    __radd__, __rmul__ = __add__, __mul__

    def through(self, f, f1, f2):
        """A function of the number with its derivatives."""
        return Jet(f, f1 * self.u, f2 * self.u * self.u + f1 * self.w)

    def __truediv__(self, o):
        return self * (o.through(1 / o.x, -1 / o.x**2, 2 / o.x**3) if isinstance(o, Jet) else 1 / o)


def sin(a):
    return a.through(np.sin(a.x), np.cos(a.x), -np.sin(a.x))


def cos(a):
    return a.through(np.cos(a.x), -np.sin(a.x), -np.cos(a.x))


def sqrt(a):
    root = np.sqrt(a.x)
    return a.through(root, 1 / (2 * root), -1 / (4 * root * a.x))


def asin(a):
    c2 = 1 - a.x * a.x
    return a.through(np.arcsin(a.x), 1 / np.sqrt(c2), a.x / (c2 * np.sqrt(c2)))


def angle(x, y):
    """The angle of the vector (x, y): its derivative is (x y' - y x') / (x^2 + y^2)."""
    r = x.x**2 + y.x**2
    n, n1 = x.x * y.u - y.x * x.u, x.x * y.w - y.x * x.w
    r1 = 2 * (x.x * x.u + y.x * y.u)
    return Jet(np.arctan2(y.x, x.x), n / r, n1 / r - n * r1 / r**2)


def meet(P, p, Q, q, side):
    """The point at the distance p from P and q from Q, to the left of P -> Q for side = 1."""
    x, y = Q[0] - P[0], Q[1] - P[1]
    d2 = x * x + y * y
    along = (d2 + (p * p - q * q)) / (d2 * 2)
    across = side * sqrt(Jet(p * p) / d2 - along * along)
    return P[0] + along * x - across * y, P[1] + along * y + across * x


def cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def acceleration(kinetic, potential, speed, damping=0):
    """s'' from pairs (weight, jet) whose squared rates make twice the kinetic energy, and the potential as a jet."""
    inertia = sum(m * jet.u**2 for m, jet in kinetic)
    return -(potential.u + damping * speed + sum(m * jet.u * jet.w for m, jet in kinetic) * speed**2) / inertia


def state(coordinates, speed):
    """Coordinates and their velocities as arrays."""
    return np.array([jet.x for jet in coordinates]), np.array([jet.u * speed for jet in coordinates])
