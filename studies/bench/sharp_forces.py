"""Everyday forces that are sharp: drags, frictions, gusts, stops, brakes, switches, noise; compiled once for all.

A force acts along one coordinate x of a mechanism with the velocity v. What it is stands in the last places of the
parameters of the mechanism, so that one set of compiled callbacks serves all.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numba
import numpy as np

from studies.bench.store import Array

T_END = 3.0  # s of all runs with these forces
N_TABLE = 64
# the last places of the parameters: kind of the force, four numbers, its unit, where x is 0, units of x and v; kind of
# the drive and three numbers; values between which noise is interpolated
KIND, A, B, C, D, UNIT, ORIGIN, LENGTH, SPEED, DRIVE, DRIVE_A, DRIVE_B, DRIVE_C, TABLE = range(14)
SIZE = TABLE + N_TABLE


@numba.njit(cache=True)
def shape(p, first, t, x, v):  # type: ignore[no-untyped-def]
    """The force in its unit at x and v in theirs; `first`: where its parameters begin."""
    kind = int(p[first + KIND])
    a, b, c, d = p[first + A], p[first + B], p[first + C], p[first + D]
    if kind == 1:
        return -a * math.sqrt(v * v) * v
    if kind == 2:
        return -a * math.tanh(v / b)
    if kind == 3:
        return a * math.exp(-(((t - c) / b) ** 2))
    if kind == 4:
        return -a * b * math.log(1.0 + math.exp((x - c) / b))
    if kind == 5:
        return a * math.sin(b * t * t)
    if kind == 6:
        return a * math.tanh(c * math.sin(b * t))
    if kind == 7:
        return a if math.sin(b * t) > 0.0 else -a
    if kind == 8:
        place = min(max(t / b, 0.0), 62.0)
        i = int(place)
        low, high = p[first + TABLE + i], p[first + TABLE + 1 + i]
        return a * (low + (place - i) * (high - low))
    if kind == 9:
        return -a * max(0.0, x - c) ** 1.5
    if kind == 10:
        return -a * math.tanh(v / d) * 0.5 * (math.tanh((t - c) / b) - math.tanh((t - c - 0.6) / b))
    if kind == 11:
        return a if t > c else 0.0
    if kind == 12:
        return a * max(0.0, t - c)
    if kind == 13:
        return a if c < t < c + b else 0.0
    if kind == 14:
        return a / (1.0 + ((t - c) / b) ** 2)
    if kind == 15:
        return a * math.exp(-t / b)
    if kind == 16:
        return a * math.tanh((t - c) / b)
    if kind == 17:
        return a * math.sqrt(t)
    if kind == 18:
        return -a * x ** int(b)
    if kind == 19:
        return -(a + d * math.exp(-((v / c) ** 2))) * math.tanh(v / b)
    if kind == 20:
        return a * math.exp(-(((x - c) / b) ** 2))
    if kind == 21:
        return -a * v * math.exp(-(((v - c) / b) ** 2))
    if kind == 22:
        return a * math.cos(d * t) * math.exp(-(((t - c) / b) ** 2))
    if kind == 23:
        return a * math.exp(c * (math.cos(b * t) - 1.0))
    if kind == 24:
        return -a * (x - min(max(x, -b), b))
    if kind == 25:
        return a * abs(math.sin(b * t))
    return 0.0


@numba.njit(cache=True)
def force_along(t, x, v, p):  # type: ignore[no-untyped-def]
    """The force along a coordinate x whose velocity is v, in the units of the mechanism."""
    first = p.size - SIZE
    return p[first + UNIT] * shape(p, first, t, (x - p[first + ORIGIN]) / p[first + LENGTH], v / p[first + SPEED])


@numba.njit(cache=True)
def drive(t, p):  # type: ignore[no-untyped-def]
    """A given motion and its first two derivatives: none, a kink, a gust, a step or a sine."""
    first = p.size - SIZE
    kind = int(p[first + DRIVE])
    a, b, c = p[first + DRIVE_A], p[first + DRIVE_B], p[first + DRIVE_C]
    if kind == 1:
        return a * max(0.0, t - c), a if t > c else 0.0, 0.0
    if kind == 2:
        s = (t - c) / b
        e = a * math.exp(-s * s)
        return e, -2.0 * s / b * e, (4.0 * s * s - 2.0) / (b * b) * e
    if kind == 3:
        s = math.tanh((t - c) / b)
        return a * s, a / b * (1.0 - s * s), -2.0 * a / (b * b) * s * (1.0 - s * s)
    if kind == 4:
        return a * math.sin(b * t), a * b * math.cos(b * t), -b * b * a * math.sin(b * t)
    return 0.0, 0.0, 0.0


@dataclass(frozen=True)
class Sharp:
    """One force, or one drive, with its numbers."""

    family: str
    parameters: Array  # (SIZE,); those for the end of the parameters of a mechanism
    breaks: tuple[float, ...] = ()  # times at which it or a derivative jumps
    windows: tuple[tuple[float, float], ...] = ()  # between which times it does what it does
    follows_x: bool = False  # whether it is sharp where the mechanism is, not at a time

    @property
    def driven(self) -> bool:
        """Whether it is a given motion, not a force."""
        return self.parameters[DRIVE] > 0.0

    def on(self, unit: float, origin: float, length: float, speed: float) -> Array:
        """The parameters for a mechanism of these units of force, x and v."""
        made = self.parameters.copy()
        made[[UNIT, ORIGIN, LENGTH, SPEED]] = unit, origin, length, speed
        return made


def made(family: str, kind: int, numbers: tuple[float, ...], drives: bool = False, **more: object) -> Sharp:
    """A force (or a drive) of these numbers."""
    p = np.zeros(SIZE)
    p[UNIT] = p[LENGTH] = p[SPEED] = 1.0
    place = DRIVE if drives else KIND
    p[place] = kind
    p[place + 1 : place + 1 + len(numbers)] = numbers
    return Sharp(family, p, **more)  # type: ignore[arg-type]


Draw = Callable[[np.random.Generator], Sharp]
Number = Callable[[np.random.Generator], float]
Where = Callable[[float, float], dict[str, Any]]  # of b and c: breaks and windows
GUSTS = (3e-3, 1e-2, 3e-2, 0.1, 0.3)  # s
FRICTIONS = (0.1, 0.01, 0.001)  # of the unit of v


def between(low: float, high: float) -> Number:
    """An even number."""
    return lambda g: float(g.uniform(low, high))


def log_uniform(low: float, high: float, factor: float = 1.0) -> Number:
    """A number whose logarithm is even, times a factor."""
    return lambda g: factor * float(np.exp(g.uniform(np.log(low), np.log(high))))


def family(kind: int, where: Where = lambda b, c: {}, drives: bool = False, **numbers: Number) -> Callable[..., Sharp]:
    """draw(name, generator) of a force (or a drive), whose numbers, from a to d, are drawn in this order."""

    def draw(name: str, g: np.random.Generator) -> Sharp:
        drawn = dict.fromkeys("abc" if drives else "abcd", 0.0) | {each: number(g) for each, number in numbers.items()}
        return made(name, kind, tuple(drawn.values()), drives, **where(drawn["b"], drawn["c"]))

    return draw


def about(reach: float = 7.0, later: float = 0.0) -> Where:
    """Of what happens within so many widths b about a time c, and about a later one."""
    return lambda b, c: {"windows": tuple((at - reach * b, at + reach * b) for at in dict.fromkeys((c, c + later)))}


def at_zeros(b: float, c: float) -> dict[str, Any]:
    """Breaks at the zeros of sin(b t)."""
    return {"breaks": tuple(np.arange(1, int(T_END * b / np.pi) + 1) * np.pi / b)}


def noise(name: str, g: np.random.Generator) -> Sharp:
    """Random values, and lines between them."""
    b = 0.05
    force = made(name, 8, (log_uniform(3.0, 20.0)(g), b), breaks=tuple(b * np.arange(1, N_TABLE - 4)))
    force.parameters[TABLE:] = g.standard_normal(N_TABLE)
    return force


def gust(width: float) -> Callable[..., Sharp]:
    """draw(name, generator) of a gust of about this width (s) at a random time."""
    size = log_uniform(5.0, 50.0, (0.03 / width) ** 0.5)
    return family(3, about(), c=between(0.3, 2.3), b=log_uniform(0.7, 1.4, width), a=size)


def pulse(duration: float) -> Callable[..., Sharp]:
    """draw(name, generator) of a force that is constant for about this time (s), from a random time on."""
    size = log_uniform(5.0, 50.0, (0.03 / duration) ** 0.5)
    return family(
        13, lambda b, c: {"breaks": (c, c + b)}, c=between(0.3, 2.3), b=log_uniform(0.7, 1.4, duration), a=size
    )


def families() -> dict[str, Draw]:
    """Name to draw(generator), which returns a force of that family with random numbers."""
    when, size = between(0.3, 2.3), log_uniform(5.0, 50.0)

    def jumps(b: float, c: float) -> dict[str, Any]:
        return {"breaks": (c,)}

    def whole(b: float, c: float) -> dict[str, Any]:
        return {"windows": ((0.0, T_END),)}

    def in_x(b: float, c: float) -> dict[str, Any]:
        return {"follows_x": True}

    found = {
        "drag": family(1, a=log_uniform(0.05, 1.0)),
        **{
            f"tanh friction, width {b:g}": family(2, a=log_uniform(0.5, 5.0), b=log_uniform(0.7, 1.4, b))
            for b in FRICTIONS
        },
        **{f"gust of {1e3 * b:g} ms": gust(b) for b in GUSTS},
        "softplus stop": family(
            4, in_x, a=log_uniform(200.0, 5000.0), b=log_uniform(0.002, 0.05), c=between(-0.3, 0.4)
        ),
        "chirp": family(5, whole, a=log_uniform(3.0, 30.0), b=log_uniform(3.0, 60.0)),
        "switching drive": family(
            6, whole, a=log_uniform(2.0, 20.0), b=log_uniform(5.0, 40.0), c=log_uniform(10.0, 200.0)
        ),
        "square wave": family(7, at_zeros, b=log_uniform(2.0, 30.0), a=log_uniform(2.0, 20.0)),
        "noise by interpolation": noise,
        "brake": family(
            10, about(9.0, 0.6), b=log_uniform(0.003, 0.1), c=when, a=log_uniform(1.0, 10.0), d=lambda g: 0.02
        ),
        "Stribeck friction": family(
            19, a=log_uniform(0.5, 3.0), b=log_uniform(0.002, 0.05), c=log_uniform(0.02, 0.3), d=log_uniform(0.5, 3.0)
        ),
        "stop of power 3/2": family(9, in_x, a=log_uniform(500.0, 2e4), b=log_uniform(1.0, 2.0), c=between(-0.2, 0.4)),
        "jump of the force": family(11, jumps, c=when, a=log_uniform(3.0, 30.0)),
        "kinked force": family(12, jumps, c=when, a=log_uniform(3.0, 30.0)),
        "square pulse": family(13, lambda b, c: {"breaks": (c, c + b)}, b=log_uniform(0.02, 0.5), c=when, a=size),
        "fast decay": family(
            15, lambda b, c: {"windows": ((0.0, 30.0 * b),)}, b=log_uniform(3e-4, 0.03), a=log_uniform(10.0, 500.0)
        ),
        "square root of t": family(17, lambda b, c: {"windows": ((0.0, 1e-4), (1e-4, 1e-2))}, a=log_uniform(3.0, 30.0)),
        "wave packet": family(
            22, about(), c=when, b=log_uniform(0.01, 0.1), a=log_uniform(10.0, 100.0), d=log_uniform(30.0, 300.0)
        ),
        "Lorentz pulse": family(14, about(20.0), c=when, b=log_uniform(0.005, 0.1), a=size),
        "tanh step": family(16, about(12.0), c=when, b=log_uniform(5e-4, 0.1), a=size),
        "high power of x": family(18, in_x, a=log_uniform(10.0, 100.0), b=lambda g: 2.0 * g.integers(5, 33) + 1.0),
        "magnet": family(20, in_x, a=log_uniform(10.0, 100.0), b=log_uniform(0.03, 0.2), c=between(-0.4, 0.5)),
        "backlash": family(24, in_x, a=log_uniform(50.0, 2000.0), b=log_uniform(0.03, 0.3)),
        "resonance in v": family(21, a=log_uniform(3.0, 60.0), b=log_uniform(0.1, 0.5), c=between(-1.5, 1.5)),
        "spikes": family(23, whole, a=log_uniform(5.0, 60.0), b=log_uniform(3.0, 10.0), c=log_uniform(20.0, 200.0)),
        "rectified sine": family(25, at_zeros, b=log_uniform(2.0, 30.0), a=log_uniform(2.0, 20.0)),
        "drive with a kink": family(1, jumps, True, a=between(0.05, 0.5), b=log_uniform(1.0, 2.0), c=when),
        "drive with a gust": family(2, about(12.0), True, a=between(0.05, 0.5), b=log_uniform(0.01, 0.3), c=when),
        "drive with a step": family(3, about(12.0), True, a=between(0.05, 0.5), b=log_uniform(0.01, 0.2), c=when),
    }
    return {name: partial(draw, name) for name, draw in found.items()}
