"""Linkages whose bars fold onto each other, and their motion by Lagrange's equations in one or two angles."""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from studies.bench.store import Array
from twoloop.bodies import PlanarModel

MASS, INERTIA, GRAVITY = 1.0, 0.1, 9.81  # of each bar and of the slider; the rhombus lies flat: it would be chaotic
FOLD_END, GROWN, NUDGE = 3.0, 10.0, 1e-5  # s; how much an error may grow, by which neighbour (rad, rad/s) it is found
CIRCLE, RADIUS = np.exp(2j * np.pi * np.arange(16) / 16), 0.08  # complex angles about one, which give derivatives
Joints = tuple[dict[str, Any], tuple[Any, ...], Any]  # places, angles of the bars, what is a multiple of pi at a fold


def e(angle: Any) -> Any:
    """Return the unit vector at an angle."""
    return np.array([np.cos(angle), np.sin(angle)])


def _four_bar(x: Any, base: float, coupler: float, angles: tuple[Any, Any], fold: Any) -> Joints:
    foot = base * e(0.0 * x)
    return {"O": 0.0 * foot, "A": e(x), "B": e(x) + coupler * e(angles[0]), "D": foot}, (x, *angles), fold


def _antiparallelogram(x: Any) -> Joints:
    s, c, k = np.sin(0.5 * x), np.cos(0.5 * x), 2.7 / 0.7  # (coupler + crank) / (coupler - crank)
    rocker = -x - 2.0 * np.arctan((k - 1.0) * s * c / (c * c + k * s * s))
    return _four_bar(x, 1.7, 1.7, (x + rocker, rocker), x)


def _deltoid(x: Any) -> Joints:
    half = np.arcsin(np.sin(0.5 * x) / 1.4)  # of the angle between coupler and rocker
    return _four_bar(x, 1.0, 1.4, (0.5 * x - half, 0.5 * x + half), 0.5 * x)


FOLDS: dict[str, tuple[int, Callable[..., Joints], str]] = {  # angles, joints, and bars by their ends; BB: the slider
    "rhombus": (
        *(2, lambda a, b: ({"O": 0.0 * e(a), "A": e(a), "B": e(b), "C": e(a) + e(b)}, (a, b, b, a), a - b)),
        "OA OB AC BC",
    ),
    "parallelogram": (1, lambda x: _four_bar(x, 2.0, 2.0, (0.0 * x, x), x), "OA AB DB"),
    "antiparallelogram": (1, _antiparallelogram, "OA AB DB"),
    "deltoid": (1, _deltoid, "OA AB DB"),
    "slider-crank": (
        *(1, lambda x: ({"O": 0.0 * e(x), "A": e(x), "B": e(x) + e(-x)}, (x, -x, 0.0 * x), x + 0.5 * np.pi)),
        "OA AB BB",
    ),
}


@lru_cache
def folding(name: str, seed: tuple[int, ...]) -> dict[str, Any]:
    """Draw starts until a linkage folds on the way; return what a trap needs, with the end by SciPy's DOP853."""
    (n, of, names), generator, n_drawn, growth = FOLDS[name], np.random.default_rng(seed), 0, np.inf
    bars, gravity = names.split(), GRAVITY if n == 1 else 0.0
    mass, force = (np.tile(each, len(bars)) for each in ([MASS, MASS, INERTIA], [0.0, -MASS * gravity, 0.0]))

    def positions(x: Array) -> Array:
        at, angles, _ = of(*x)
        return np.array([y for bar, a in zip(bars, angles, strict=True) for y in (*0.5 * (at[bar[0]] + at[bar[1]]), a)])

    def along(x: Array, directions: Array) -> tuple[Array, Array]:  # derivatives of the positions, first and second
        values = positions(x[:, None, None] + RADIUS * directions.T[:, :, None] * CIRCLE) / len(CIRCLE)
        return (values @ CIRCLE**-1).real / RADIUS, 2.0 * (values @ CIRCLE**-2).real / RADIUS**2

    def rates(t: float, y: Array) -> Array:
        (x, w), speed = np.split(y, 2), np.linalg.norm(y[n:])
        first, second = along(x, np.vstack([np.eye(n), w / speed]))
        J, bent = first[:, :n], speed**2 * second[:, n]
        return np.append(w, np.linalg.solve(J.T * mass @ J, J.T @ (force - mass * bent)))

    def end(y: Array, tolerance: float = 1e-9) -> Array:
        return solve_ivp(rates, (0.0, FOLD_END), y, "DOP853", rtol=tolerance, atol=tolerance).y[:n, -1]

    while growth > GROWN:
        x, w = generator.uniform(-np.pi, np.pi, n), generator.choice([-1.0, 1.0], n) * generator.uniform(1.0, 6.0, n)
        y, n_drawn = np.append(x, w), n_drawn + 1
        last = end(y)
        if np.floor(of(*x)[2] / np.pi) != np.floor(of(*last)[2] / np.pi):
            errors = [positions(end(y + d)) - positions(last) for d in NUDGE * np.eye(2 * n)]
            growth = float(np.abs(errors).max()) / NUDGE
    q0, q, model = positions(x), positions(end(y, 1e-13)), PlanarModel(name=name, gravity=(0.0, -gravity))
    for bar, (*place, angle) in zip(bars, q0.reshape(-1, 3), strict=True):
        model.body(bar, mass=MASS, inertia=INERTIA, position=place, angle=angle)
    for joint, at in of(*x)[0].items():
        first, *others = [*(["ground"] if joint in "OD" else []), *(bar for bar in bars if joint in bar)]
        for other in others:
            model.revolute(first, other, at=at)
        if (joint + joint) in bars:
            model.prismatic("ground", joint + joint, at=at, axis=(1.0, 0.0))
    system, v0 = model.problem((0.0, FOLD_END)).system, along(x, np.eye(n))[0] @ w
    known = {"system": system, "sane": system, "q0": q0, "v0": v0, "t_end": FOLD_END, "positions": lambda t: q}
    return known | {"sensitivity": max(1.0, growth), "n_drawn": n_drawn}
