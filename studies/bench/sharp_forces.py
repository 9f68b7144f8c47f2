"""Everyday forces that are sharp: drags, frictions, gusts, stops, brakes, switches, noise; compiled once for all.

A force acts along one coordinate x of a mechanism with the velocity v. What it is stands in the last places of the
parameters of the mechanism, so that one set of compiled callbacks serves all.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numba
import numpy as np

from studies.bench.store import Array

T_END = 3.0  # s of all runs with these forces
N_TABLE = 64
# the last places of the parameters: kind of the force, four numbers, its unit, where x is 0, units of x and v; kind of
# the drive and three numbers; values between which noise is interpolated
KIND, A, B, C, D, UNIT, ORIGIN, LENGTH, SPEED, DRIVE, DRIVE_A, DRIVE_B, DRIVE_C, TABLE = range(14)
SIZE = TABLE + N_TABLE
FRICTION = ("drag", "tanh friction", "brake", "Stribeck friction")


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
    """A given motion and its first two derivatives: none, a kink, a gust or a step."""
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
    return 0.0, 0.0, 0.0


@dataclass(frozen=True)
class Sharp:
    """One force, or one drive, with its numbers.

    Attributes
    ----------
    family : str
    parameters : ndarray (SIZE,)
        Those for the end of the parameters of a mechanism.
    breaks : tuple of float
        Times at which it or a derivative jumps.
    windows : tuple of (float, float)
        Between which times it does what it does.
    follows_x : bool
        Whether it is sharp where the mechanism is, not at a time.
    """

    family: str
    parameters: Array
    breaks: tuple[float, ...] = ()
    windows: tuple[tuple[float, float], ...] = ()
    follows_x: bool = False

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


def about(time: float, width: float, times: float = 7.0) -> tuple[tuple[float, float], ...]:
    """The window of what happens within so many widths about a time."""
    return ((time - times * width, time + times * width),)


Draw = Callable[[np.random.Generator], Sharp]
WHOLE = ((0.0, T_END),)
GUSTS = (3e-3, 1e-2, 3e-2, 0.1, 0.3)  # s
FRICTIONS = (0.1, 0.01, 0.001)  # of the unit of v


def families() -> dict[str, Draw]:
    """Name to draw(generator), which returns a force of that family with random numbers."""

    def log(g: np.random.Generator, low: float, high: float) -> float:
        return float(np.exp(g.uniform(np.log(low), np.log(high))))

    def when(g: np.random.Generator) -> float:
        return float(g.uniform(0.3, 2.3))

    def gust(name: str, width: float) -> Draw:
        def draw(g: np.random.Generator) -> Sharp:
            c, b = when(g), width * log(g, 0.7, 1.4)
            return made(name, 3, (log(g, 5.0, 50.0) * (0.03 / width) ** 0.5, b, c), windows=about(c, b))

        return draw

    def tanh(name: str, width: float) -> Draw:
        return lambda g: made(name, 2, (log(g, 0.5, 5.0), width * log(g, 0.7, 1.4)))

    def zeros(rate: float) -> tuple[float, ...]:
        return tuple(np.arange(1, int(T_END * rate / np.pi) + 1) * np.pi / rate)

    def timed(name: str, kind: int, low: float, high: float, reach: float = 7.0, more: float = 0.0) -> Draw:
        def draw(g: np.random.Generator) -> Sharp:
            c, b = when(g), log(g, low, high)
            return made(name, kind, (log(g, 5.0, 50.0), b, c, more), windows=about(c, b, reach))

        return draw

    def square(g: np.random.Generator) -> Sharp:
        b = log(g, 2.0, 30.0)
        return made("square wave", 7, (log(g, 2.0, 20.0), b), breaks=zeros(b))

    def rectified(g: np.random.Generator) -> Sharp:
        b = log(g, 2.0, 30.0)
        return made("rectified sine", 25, (log(g, 2.0, 20.0), b), breaks=zeros(b))

    def noise(g: np.random.Generator) -> Sharp:
        b = 0.05
        force = made("noise by interpolation", 8, (log(g, 3.0, 20.0), b), breaks=tuple(b * np.arange(1, N_TABLE - 4)))
        force.parameters[TABLE:] = g.standard_normal(N_TABLE)
        return force

    def at(name: str, kind: int, low: float, high: float) -> Draw:
        def draw(g: np.random.Generator) -> Sharp:
            c = when(g)
            return made(name, kind, (log(g, low, high), 0.0, c), breaks=(c,))

        return draw

    def pulse(g: np.random.Generator) -> Sharp:
        b, c = log(g, 0.02, 0.5), when(g)
        return made("square pulse", 13, (log(g, 5.0, 50.0), b, c), breaks=(c, c + b))

    def brake(g: np.random.Generator) -> Sharp:
        b, c = log(g, 0.003, 0.1), when(g)
        windows = (*about(c, b, 9.0), *about(c + 0.6, b, 9.0))
        return made("brake", 10, (log(g, 1.0, 10.0), b, c, 0.02), windows=windows)

    def stribeck(g: np.random.Generator) -> Sharp:
        numbers = (log(g, 0.5, 3.0), log(g, 0.002, 0.05), log(g, 0.02, 0.3), log(g, 0.5, 3.0))
        return made("Stribeck friction", 19, numbers)

    def follows(name: str, kind: int, *numbers: Callable[[np.random.Generator], float]) -> Draw:
        return lambda g: made(name, kind, tuple(number(g) for number in numbers), follows_x=True)

    def between(low: float, high: float) -> Callable[[np.random.Generator], float]:
        return lambda g: float(g.uniform(low, high))

    def decades(low: float, high: float) -> Callable[[np.random.Generator], float]:
        return lambda g: log(g, low, high)

    def whole(name: str, kind: int, *numbers: Callable[[np.random.Generator], float]) -> Draw:
        return lambda g: made(name, kind, tuple(number(g) for number in numbers), windows=WHOLE)

    def decay(g: np.random.Generator) -> Sharp:
        b = log(g, 3e-4, 0.03)
        return made("fast decay", 15, (log(g, 10.0, 500.0), b), windows=((0.0, 30.0 * b),))

    def root(g: np.random.Generator) -> Sharp:
        return made("square root of t", 17, (log(g, 3.0, 30.0),), windows=((0.0, 1e-4), (1e-4, 1e-2)))

    def packet(g: np.random.Generator) -> Sharp:
        c, b = when(g), log(g, 0.01, 0.1)
        return made("wave packet", 22, (log(g, 10.0, 100.0), b, c, log(g, 30.0, 300.0)), windows=about(c, b))

    def driven(name: str, kind: int, low: float, high: float) -> Draw:
        def draw(g: np.random.Generator) -> Sharp:
            a, b, c = float(g.uniform(0.05, 0.5)), log(g, low, high), when(g)
            where: dict[str, object] = {"breaks": (c,)} if kind == 1 else {"windows": about(c, b, 12.0)}
            return made(name, kind, (a, b, c), True, **where)

        return draw

    found: dict[str, Draw] = {"drag": lambda g: made("drag", 1, (log(g, 0.05, 1.0),))}
    for width in FRICTIONS:
        name = f"tanh friction, width {width:g}"
        found[name] = tanh(name, width)
    for width in GUSTS:
        name = f"gust of {1e3 * width:g} ms"
        found[name] = gust(name, width)
    found["softplus stop"] = follows(
        "softplus stop", 4, decades(200.0, 5000.0), decades(0.002, 0.05), between(-0.3, 0.4)
    )
    found["chirp"] = whole("chirp", 5, decades(3.0, 30.0), decades(3.0, 60.0))
    found["switching drive"] = whole("switching drive", 6, decades(2.0, 20.0), decades(5.0, 40.0), decades(10.0, 200.0))
    found |= {"square wave": square, "noise by interpolation": noise, "brake": brake, "Stribeck friction": stribeck}
    found["stop of power 3/2"] = follows(
        "stop of power 3/2", 9, decades(500.0, 2e4), decades(1.0, 2.0), between(-0.2, 0.4)
    )
    found["jump of the force"] = at("jump of the force", 11, 3.0, 30.0)
    found["kinked force"] = at("kinked force", 12, 3.0, 30.0)
    found |= {"square pulse": pulse, "fast decay": decay, "square root of t": root, "wave packet": packet}
    found["Lorentz pulse"] = timed("Lorentz pulse", 14, 0.005, 0.1, 20.0)
    found["tanh step"] = timed("tanh step", 16, 5e-4, 0.1, 12.0)
    found["high power of x"] = follows(
        "high power of x", 18, decades(10.0, 100.0), lambda g: 2.0 * g.integers(5, 33) + 1.0
    )
    found["magnet"] = follows("magnet", 20, decades(10.0, 100.0), decades(0.03, 0.2), between(-0.4, 0.5))
    found["backlash"] = follows("backlash", 24, decades(50.0, 2000.0), decades(0.03, 0.3))
    found["resonance in v"] = lambda g: made(
        "resonance in v", 21, (log(g, 3.0, 60.0), log(g, 0.1, 0.5), float(g.uniform(-1.5, 1.5)))
    )
    found["spikes"] = whole("spikes", 23, decades(5.0, 60.0), decades(3.0, 10.0), decades(20.0, 200.0))
    found["rectified sine"] = rectified
    found["drive with a kink"] = driven("drive with a kink", 1, 1.0, 2.0)
    found["drive with a gust"] = driven("drive with a gust", 2, 0.01, 0.3)
    found["drive with a step"] = driven("drive with a step", 3, 0.01, 0.2)
    return found
