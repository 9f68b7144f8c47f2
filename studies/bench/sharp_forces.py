"""Everyday forces that are sharp: drags, frictions, gusts, stops, brakes, switches, noise.

A force acts along one coordinate x of a mechanism with the velocity v. The last parameters of the mechanism define it,
so that one set of compiled callbacks serves all forces.
"""

import math
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
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
    if kind == 8:
        place = min(max(t / b, 0.0), 62.0)
        i = int(place)
        low, high = p[first + TABLE + i], p[first + TABLE + 1 + i]
        return a * (low + (place - i) * (high - low))
    value = 0.0
    value = -a * math.sqrt(v * v) * v if kind == 1 else value
    value = -a * math.tanh(v / b) if kind == 2 else value
    value = a * math.exp(-(((t - c) / b) ** 2)) if kind == 3 else value
    value = -a * b * math.log(1.0 + math.exp((x - c) / b)) if kind == 4 else value
    value = a * math.sin(b * t * t) if kind == 5 else value
    value = a * math.tanh(c * math.sin(b * t)) if kind == 6 else value
    value = (a if math.sin(b * t) > 0.0 else -a) if kind == 7 else value
    value = -a * max(0.0, x - c) ** 1.5 if kind == 9 else value
    on = math.tanh((t - c) / b) - math.tanh((t - c - 0.6) / b) if kind == 10 else 0.0
    value = -a * math.tanh(v / d) * 0.5 * on if kind == 10 else value
    value = (a if t > c else 0.0) if kind == 11 else value
    value = a * max(0.0, t - c) if kind == 12 else value
    value = (a if c < t < c + b else 0.0) if kind == 13 else value
    value = a / (1.0 + ((t - c) / b) ** 2) if kind == 14 else value
    value = a * math.exp(-t / b) if kind == 15 else value
    value = a * math.tanh((t - c) / b) if kind == 16 else value
    value = a * math.sqrt(t) if kind == 17 else value
    value = -a * x ** int(b) if kind == 18 else value
    value = -(a + d * math.exp(-((v / c) ** 2))) * math.tanh(v / b) if kind == 19 else value
    value = a * math.exp(-(((x - c) / b) ** 2)) if kind == 20 else value
    value = -a * v * math.exp(-(((v - c) / b) ** 2)) if kind == 21 else value
    value = a * math.cos(d * t) * math.exp(-(((t - c) / b) ** 2)) if kind == 22 else value
    value = a * math.exp(c * (math.cos(b * t) - 1.0)) if kind == 23 else value
    value = -a * (x - min(max(x, -b), b)) if kind == 24 else value
    value = a * abs(math.sin(b * t)) if kind == 25 else value
    return value


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
GUSTS = (3e-3, 1e-2, 3e-2, 0.1, 0.3)  # s
FRICTIONS = (0.1, 0.01, 0.001)  # of the unit of v
FAMILIES = tomllib.loads(Path(__file__).with_suffix(".toml").read_text())


def about(reach: float, later: float = 0.0) -> Callable[[float, float], dict[str, Any]]:
    """Of what happens within so many widths b about a time c, and about a later one."""
    return lambda b, c: {"windows": tuple((at - reach * b, at + reach * b) for at in dict.fromkeys((c, c + later)))}


WHEN: dict[str, Callable[[float, float], dict[str, Any]]] = {  # breaks and windows, by b and c
    "": lambda b, c: {},
    "about": about(7.0),
    "well about": about(12.0),
    "far about": about(20.0),
    "twice": about(9.0, 0.6),
    "jump": lambda b, c: {"breaks": (c,)},
    "lasting": lambda b, c: {"breaks": (c, c + b)},
    "zeros": lambda b, c: {"breaks": tuple(np.arange(1, int(T_END * b / np.pi) + 1) * np.pi / b)},  # of sin(b t)
    "whole": lambda b, c: {"windows": ((0.0, T_END),)},
    "decay": lambda b, c: {"windows": ((0.0, 30.0 * b),)},
    "root": lambda b, c: {"windows": ((0.0, 1e-4), (1e-4, 1e-2))},
    "in x": lambda b, c: {"follows_x": True},
}


def number(spec: Any, g: np.random.Generator) -> float:
    """Draw a number of a family."""
    if isinstance(spec, dict):
        return float(g.uniform(*spec["even"])) if "even" in spec else 2.0 * g.integers(*spec["odd"]) + 1.0
    if not isinstance(spec, list):
        return float(spec)
    low, high, factor = [*spec, 1.0][:3]
    return factor * float(np.exp(g.uniform(np.log(low), np.log(high))))


def drawn(name: str, family: Mapping[str, Any], g: np.random.Generator) -> Sharp:
    """Draw a force (or a drive)."""
    if "gust" in family:
        return gust(family["gust"])(name, g)
    if "noise" in family:  # random values, and lines between them
        b = family["noise"]
        force = made(name, 8, (number([3.0, 20.0], g), b), breaks=tuple(b * np.arange(1, N_TABLE - 4)))
        force.parameters[TABLE:] = g.standard_normal(N_TABLE)
        return force
    drives = "drive" in family
    numbers = dict.fromkeys("abc" if drives else "abcd", 0.0)
    numbers |= {each: number(spec, g) for each, spec in family.items() if each in numbers}
    when = WHEN[family.get("when", "")](numbers["b"], numbers["c"])
    return made(name, family["drive" if drives else "kind"], tuple(numbers.values()), drives, **when)


def gust(width: float, kind: int = 3, when: str = "about") -> Callable[[str, np.random.Generator], Sharp]:
    """draw(name, generator) of a gust of about this width (s) at a random time."""
    numbers = {"c": {"even": [0.3, 2.3]}, "b": [0.7, 1.4, width], "a": [5.0, 50.0, (0.03 / width) ** 0.5]}
    return lambda name, g: drawn(name, {"kind": kind, "when": when, **numbers}, g)


def pulse(duration: float) -> Callable[[str, np.random.Generator], Sharp]:
    """draw(name, generator) of a force that is constant for about this time (s), from a random time on."""
    return gust(duration, 13, "lasting")


def families() -> dict[str, Draw]:
    """Name to draw(generator), which returns a force of that family with random numbers."""
    return {name: partial(drawn, name, family) for name, family in FAMILIES.items()}
