"""Systems whose derivatives are right, at many scales, and the single errors that are planted into them."""

import math
from dataclasses import dataclass, field

import numpy as np

from twoloop import ConstrainedSystem
from twoloop.mechanisms import four_bar

UNITS = {"km": 1e3, "m": 1.0, "mm": 1e-3, "um": 1e-6}


@dataclass
class Case:
    """Plain functions of a system, and a position that it is looked at."""

    name: str
    n_q: int
    functions: dict
    q: list
    t: float = 0.0
    compiled: ConstrainedSystem | None = field(default=None)

    def system(self, **changed):
        if self.compiled is not None and not changed:
            return self.compiled
        functions = {"mass": np.eye(self.n_q), "force": lambda t, q, v: np.zeros(self.n_q), **self.functions, **changed}
        n_c = len(functions["constraint"](self.t, np.array(self.q)))
        return ConstrainedSystem.from_python(n_q=self.n_q, n_c=n_c, name=self.name, **functions)

    def planted(self, kind, entry, change):
        """The system with one entry of what one callback returns changed."""
        right = self.functions[kind]

        def wrong(t, *arguments):
            value = np.array(right(t, *arguments), dtype=float)
            value[entry] = change(value[entry])
            return value

        return self.system(**{kind: wrong})


def slider_crank(unit, offset=0.0, crank=0.7, offset_of_guide=0.2):
    """Angles of crank and rod, and the slider, whose coordinate may begin far away."""
    r, l, e = 1.0 * unit, 2.7 * unit, offset_of_guide * unit
    a, b = crank, -math.asin((r * math.sin(crank) - e) / l)

    def constraint(t, q):
        x, y = r * math.cos(q[0]) + l * math.cos(q[1]), r * math.sin(q[0]) + l * math.sin(q[1])
        return np.array([x - (q[2] - offset), y - e])

    def jacobian(t, q):
        by_x = [-r * math.sin(q[0]), -l * math.sin(q[1]), -1.0]
        return np.array([by_x, [r * math.cos(q[0]), l * math.cos(q[1]), 0.0]])

    def gamma(t, q, v):
        c, s = r * v[0] ** 2, l * v[1] ** 2
        return np.array([c * math.cos(q[0]) + s * math.cos(q[1]), c * math.sin(q[0]) + s * math.sin(q[1])])

    x = r * math.cos(a) + l * math.cos(b)
    functions = {"constraint": constraint, "jacobian": jacobian, "gamma": gamma}
    return Case(f"slider-crank of {unit:g} m at {offset:g} m", 3, functions, [a, b, x + offset])


def shaken_pendulum(unit, omega=3.0, amplitude=0.1, t=0.0, offset=0.0, only_after_start=False):
    """A rod on a pivot that is shaken along x."""

    def pivot(t):
        if only_after_start:
            math.sqrt(t)  # raises before the start
        return offset + amplitude * unit * math.sin(omega * t + 0.4)

    def rate(t):
        return amplitude * unit * omega * math.cos(omega * t + 0.4)

    def constraint(t, q):
        d = q[0] - pivot(t)
        return np.array([0.5 * (d * d + q[1] * q[1] - unit * unit)])

    def gamma(t, q, v):
        u, a = v[0] - rate(t), -amplitude * unit * omega**2 * math.sin(omega * t + 0.4)
        return np.array([(q[0] - pivot(t)) * a - u * u - v[1] * v[1]])

    functions = {
        "constraint": constraint,
        "jacobian": lambda t, q: np.array([[q[0] - pivot(t), q[1]]]),
        "constraint_rate": lambda t, q: np.array([-(q[0] - pivot(t)) * rate(t)]),
        "gamma": gamma,
    }
    q = [pivot(t) + 0.6 * unit, -0.8 * unit]
    return Case(f"rod of {unit:g} m shaken at {omega:g} rad/s from {offset:g} m, t = {t:g} s", 2, functions, q, t)


def linkage(unit):
    """The four-bar linkage, compiled callbacks behind plain functions."""
    problem = four_bar((unit, 2.0 * unit, 1.5 * unit), 3.0 * unit, theta3=0.1)
    system = problem.system
    plain = {
        "constraint": lambda t, q: system.constraint(t, q),
        "jacobian": lambda t, q: system.jacobian(t, q),
        "gamma": lambda t, q, v: system.gamma(t, q, v),
    }
    return Case(f"four-bar of {unit:g} m", 9, plain, problem.q0.tolist(), 0.0)


def lever(small, large):
    """A lever with a tip of one unit and an arm of another: coordinates that differ by their ratio, in one row too."""
    total = math.sin(0.3) + math.cos(0.3) + 0.5 * 0.7**2

    def constraint(t, q):
        sine, cosine = small * math.sin(q[2]), large * math.cos(q[2])
        return np.array([q[0] - sine, q[1] - cosine, q[0] / small + q[1] / large + 0.5 * q[3] ** 2 - total])

    def jacobian(t, q):
        first = [[1.0, 0.0, -small * math.cos(q[2]), 0.0], [0.0, 1.0, large * math.sin(q[2]), 0.0]]
        return np.array([*first, [1.0 / small, 1.0 / large, 0.0, q[3]]])

    def gamma(t, q, v):
        w = v[2] ** 2
        return np.array([-small * math.sin(q[2]) * w, -large * math.cos(q[2]) * w, -(v[3] ** 2)])

    q = [small * math.sin(0.3), large * math.cos(0.3), 0.3, -0.7]
    functions = {"constraint": constraint, "jacobian": jacobian, "gamma": gamma}
    return Case(f"lever of {small:g} m and {large:g} m", 4, functions, q)


def sprung_rod(unit, stiffness=1e4):
    """A rod that turns against a spring and a damper, with all tangents."""

    def force(t, q, v):
        d = q - np.array([2.0 * unit, 0.5 * unit])
        k = stiffness * (1.0 + 0.3 * d[0] / unit)
        return np.array([-k * d[0] - 0.2 * v[0], -stiffness * d[1] - 0.1 * v[1] * q[0] / unit])

    def force_by_q(t, q, v):
        d = q[0] - 2.0 * unit
        return np.array([[-stiffness * (1.0 + 0.6 * d / unit), 0.0], [-0.1 * v[1] / unit, -stiffness]])

    functions = {
        "force": force,
        "constraint": lambda t, q: np.array([0.5 * (q @ q - unit * unit) + 0.1 * q[0] * q[1]]),
        "jacobian": lambda t, q: np.array([[q[0] + 0.1 * q[1], q[1] + 0.1 * q[0]]]),
        "gamma": lambda t, q, v: np.array([-(v @ v) - 0.2 * v[0] * v[1]]),
        "force_by_q": force_by_q,
        "force_by_v": lambda t, q, v: np.array([[-0.2, 0.0], [0.0, -0.1 * q[0] / unit]]),
        "reaction_by_q": lambda t, q, lam: lam[0] * np.array([[1.0, 0.1], [0.1, 1.0]]),
    }
    return Case(f"sprung rod of {unit:g} m", 2, functions, [0.6 * unit, 0.8 * unit])
