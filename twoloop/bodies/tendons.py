"""Measure tendons, and pull along them: linear combinations of joint coordinates, and paths through points of bodies.

A tendon of length x(q) with the tension T acts on the coordinates by -T dx/dq.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from twoloop.bodies.coordinates import JointCoordinate, velocity_apart
from twoloop.bodies.frames import point_of
from twoloop.bodies.parts import Body, ModelJoint, Numbers
from twoloop.checks.arguments import Array

Tension = Callable[[Any, Any, Any], Any]  # tension(t, length, rate), positive if it shortens the tendon
AT_REST = 1e-8  # below this rate, m/s or rad/s, |v| v is smoothed without a branch; it changes by less than 1e-16
CORNER = 1e-7  # limited forces have corners rounded without a branch; width of a corner, relative to the range


@dataclass(frozen=True)
class Tendon(JointCoordinate):
    """Measure a linear combination of joint coordinates, and its rate; made by `model.tendon(...)`.

    Attributes
    ----------
    joint : str
        Name of the tendon.
    which : str
        "angle" if all its joints turn, else "displacement".

    Examples
    --------
    >>> from twoloop.bodies import PlanarModel
    >>> model = PlanarModel(name="finger")
    >>> for k in range(2):
    ...     part = model.rod(f"part {k}", (k, 0.0), (k + 1, 0.0), mass=1.0)
    >>> pins = [model.revolute(f"part {k - 1}" if k else "ground", f"part {k}", at=(k, 0.0)) for k in range(2)]
    >>> tendon = model.tendon({pins[0]: 1.0, pins[1]: 0.5}, stiffness=30.0, name="flexor")
    >>> problem = model.problem(positions={pins[1]: 0.4})
    >>> tendon.name, round(tendon.position(problem.q0), 12)
    ('angle of flexor', 0.2)
    """

    parts: tuple[tuple[JointCoordinate, float], ...] = ()
    joints: tuple[ModelJoint, ...] = field(default=(), repr=False)
    constant: float = 0.0  # length in the position given

    @property
    def ends(self) -> tuple[Body, Body, Numbers, Numbers]:
        """Return the bodies and points of its first joint."""
        first = self.joints[0]
        return first.a, first.b, first.point_a, first.point_b

    @property
    def bodies(self) -> list[Body]:
        """Return the bodies of its joints."""
        return [body for joint in self.joints for body in (joint.a, joint.b)]

    def position(self, q: Any) -> Any:
        """Return the length."""
        return self.constant + sum(factor * each.position(q) for each, factor in self.parts)

    def rate(self, q: Any, v: Any) -> Any:
        """Return its rate."""
        return sum(factor * each.rate(q, v) for each, factor in self.parts)

    def pull(self, model: Any, tension: Tension, name: str) -> None:
        """Add the forces of a tension on the joints to the model."""
        for (each, factor), joint in zip(self.parts, self.joints, strict=True):
            own = name if len(self.parts) == 1 else model._new_name(f"{name} in {each.joint}", None)
            leads = joint is self.joints[0] and each is self.parts[0][0]
            model.motor(joint, _Share(self, -factor, tension, leads), coordinate=each.which, name=own)


@dataclass(frozen=True)
class SitePath(JointCoordinate):
    """Measure the length of a path through points of bodies, and its rate; the length of each part has a weight."""

    points: tuple[tuple[Body, Array], ...] = ()
    weights: tuple[float, ...] = ()  # weights of the parts between neighbouring points; zero: a gap in the path

    @property
    def ends(self) -> tuple[Body, Body, Numbers, Numbers]:
        """Return the ends of the path."""
        (a, at_a), (b, at_b) = self.points[0], self.points[-1]
        return a, b, Numbers(tuple(at_a)), Numbers(tuple(at_b))

    @property
    def bodies(self) -> list[Body]:
        """Return the bodies of the points."""
        return [body for body, _ in self.points]

    @property
    def parts(self) -> list[tuple[float, Body, Array, Body, Array]]:
        """Return weight, body, point, next body and next point of each part."""
        pairs = zip(self.weights, self.points, self.points[1:], strict=False)
        return [(weight, *one, *other) for weight, one, other in pairs if weight]

    def position(self, q: Any) -> Any:
        """Return the length."""
        total: Any = 0.0
        for weight, a, at_a, b, at_b in self.parts:
            if a is b:
                total = total + weight * float(np.linalg.norm(at_a - at_b))
            else:
                ends = zip(point_of(q, a.number, at_a), point_of(q, b.number, at_b), strict=True)
                total = total + weight * np.sqrt(sum((x - y) * (x - y) for x, y in ends))
        return total

    def rate(self, q: Any, v: Any) -> Any:
        """Return its rate."""
        total: Any = 0.0
        for weight, a, at_a, b, at_b in self.parts:
            if a is not b:
                along = direction(q, a, at_a, b, at_b)
                apart = velocity_apart(q, v, a.number, at_a, b.number, at_b)
                total = total + weight * sum(x * y for x, y in zip(along, apart, strict=True))
        return total

    def pull(self, model: Any, tension: Tension, name: str) -> None:
        """Add the forces of a tension on the points to the model."""
        leads = True
        for weight, a, at_a, b, at_b in self.parts:
            for body, at, sign in ((a, at_a, weight), (b, at_b, -weight)):
                if a is not b and body is not model.ground:
                    force = _SpanForce(self, sign, tension, leads, (a, at_a, b, at_b))
                    leads = False
                    model.force(body, body.point(*at), force, name=model._new_name(f"{name} on {body.name}", None))


def direction(q: Any, a: Body, at_a: Array, b: Body, at_b: Array) -> list[Any]:
    """Return the unit vector from a point of a to a point of b."""
    ends = zip(point_of(q, a.number, at_a), point_of(q, b.number, at_b), strict=True)
    apart = [y - x for x, y in ends]
    length = np.sqrt(sum(x * x for x in apart))
    return [x / length for x in apart]


@dataclass(frozen=True, eq=False)
class _Share:
    """Evaluate a multiple of a tension; of a tendon's shares, only the one with `leads` has its potential energy."""

    tendon: Any
    factor: float
    tension: Tension
    leads: bool

    def __call__(self, t: Any, q: Any, v: Any) -> Any:
        return self.factor * self.tension(t, self.tendon.position(q), self.tendon.rate(q, v))

    def potential(self, q: Any) -> Any:
        """Return the potential energy of the tendon's spring, for one state or many; zero without a spring."""
        return self.tension.energy(self.tendon.position(q)) if self.leads and hasattr(self.tension, "energy") else 0.0


@dataclass(frozen=True, eq=False)
class _SpanForce(_Share):
    """Evaluate the force of a tension along one part of a path."""

    span: tuple[Body, Array, Body, Array]

    def __call__(self, t: Any, q: Any, v: Any) -> Any:
        size = super().__call__(t, q, v)
        return [size * x for x in direction(q, *self.span)]


@dataclass(frozen=True, eq=False)
class SpringTension:
    """Evaluate the tension of a damper and a spring; the spring has no force between two lengths.

    The tension is k_0 s + k_1 s^2 + ... of the stretch s, and c_0 v + c_1 |v| v + c_2 v^3 + ... of the rate v.
    """

    stiffness: Sequence[float]
    damping: Sequence[float]
    shortest: float
    longest: float

    def __call__(self, t: Any, length: Any, rate: Any) -> Any:
        """Return the tension, for numbers or symbols."""
        stretch, tension = self._stretch(length), 0.0
        for k, factor in enumerate(self.stiffness):
            tension = tension + factor * stretch ** (k + 1) if factor else tension
        for k, factor in enumerate(self.damping):
            size = smooth_size(rate, AT_REST) if k % 2 else 1.0
            tension = tension + factor * rate ** (k + 1 - k % 2) * size if factor else tension
        return tension

    def energy(self, length: Any) -> Any:
        """Return the potential energy."""
        stretch = self._stretch(length)
        return sum(factor * stretch ** (k + 2) / (k + 2) for k, factor in enumerate(self.stiffness))

    def _stretch(self, length: Any) -> Any:
        if self.longest > self.shortest:
            return length - bounded(length, self.shortest, self.longest)
        return length - self.longest


def prescribed_tension(force: Any, n_arguments: int, t: Any, length: Any, rate: Any) -> Any:
    """Return a tension that is a number or a function of t, or of t, length and rate, for numbers or symbols."""
    return force(*(t, length, rate)[:n_arguments]) if n_arguments else force


def bounded(x: Any, low: float, high: float) -> Any:
    """Limit a number or symbol to a range, with corners rounded by `CORNER` of the range."""
    width = CORNER * (high - low)
    return 0.5 * (low + high + smooth_size(x - low, width) - smooth_size(x - high, width))


def smooth_size(x: Any, width: float) -> Any:
    """Return the absolute value of a number or symbol, with its corner rounded over `width`."""
    return np.sqrt(x * x + width * width)
