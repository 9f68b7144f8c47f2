"""Shapes of bodies for the pictures of joints: polygons in a plane or in space, and how they are seen."""

import itertools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Shape = list[Array]  # polygons (n, 2 or 3)

VIEW = np.array([0.75, -1.0, 0.65])  # towards the eye


def circle(x: float, y: float, radius: float, teeth: int = 0) -> Array:
    """A disc with a mark towards x, or a wheel with teeth."""
    angle = np.linspace(0.0, 2.0 * np.pi, 41 + 12 * teeth)
    r = radius * (1.0 + 0.07 * np.clip(3.0 * np.sin(teeth * angle), -1.0, 1.0)) if teeth else radius
    return np.column_stack([x + r * np.cos(angle), y + r * np.sin(angle)])


def bar(start: Any, end: Any, width: float = 0.07) -> Array:
    """A bar with round ends."""
    one, other = np.array(start, dtype=float), np.array(end, dtype=float)
    angle = np.arctan2(*(other - one)[::-1])
    arc = np.linspace(0.5 * np.pi, 1.5 * np.pi, 15) + angle
    ends = [p + width * np.column_stack([np.cos(a), np.sin(a)]) for p, a in ((one, arc), (other, arc + np.pi))]
    return np.vstack(ends)


def rectangle(x: float, y: float, width: float, height: float) -> Array:
    """A rectangle about a point."""
    return np.array([[x, y]]) + 0.5 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [width, height]


def box(centre: Any, size: Any, R: Array | None = None) -> Shape:
    """The faces of a box."""
    turn = np.eye(3) if R is None else R
    faces = []
    for axis, side in itertools.product(range(3), (-0.5, 0.5)):
        corners = np.insert(0.5 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]), axis, side, axis=1)
        faces.append(np.array(centre) + corners * np.array(size) @ turn.T)
    return faces


def tube(start: Any, end: Any, radius: float, n: int = 20) -> Shape:
    """The sides and ends of a cylinder."""
    one, other = np.array(start, dtype=float), np.array(end, dtype=float)
    _, _, across = np.linalg.svd((other - one)[None])
    angle = np.linspace(0.0, 2.0 * np.pi, n + 1)
    rim = radius * (np.outer(np.cos(angle), across[1]) + np.outer(np.sin(angle), across[2]))
    sides = [np.array([one + a, one + b, other + b, other + a]) for a, b in itertools.pairwise(rim)]
    return [*sides, one + rim, other + rim]


def ball(centre: Any, radius: float, n: int = 10) -> Shape:
    """The faces of a ball."""
    u, w = np.linspace(0.0, np.pi, n), np.linspace(0.0, 2.0 * np.pi, 2 * n)
    at = [[(np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)) for b in w] for a in u]
    quads = itertools.product(range(n - 1), range(2 * n - 1))
    return [
        np.array(centre) + radius * np.array([at[i][j], at[i][j + 1], at[i + 1][j + 1], at[i + 1][j]]) for i, j in quads
    ]


class Face(NamedTuple):
    """What is drawn: when (layer, then distance), where, in which colours."""

    order: tuple[float, float]
    outline: Array
    fill: tuple[float, ...]
    edge: tuple[float, ...]


def face(layer: float, polygon: Array, colour: tuple[float, ...], alpha: float) -> Face:
    """A polygon in space, or in the plane, as it is seen."""
    outline, near = seen(polygon)
    light = shaded(colour, polygon)
    edge = (*(0.45 * np.array(light)), alpha * (0.9 if polygon.shape[1] == 2 else 0.35))
    return Face((layer, near), outline, (*light, alpha), edge)


def seen(polygon: Array) -> tuple[Array, float]:
    """A polygon as the eye sees it, (n, 2), and how near it is."""
    if polygon.shape[1] == 2:
        return polygon, 0.0
    eye = VIEW / np.linalg.norm(VIEW)
    right = np.cross((0.0, 0.0, 1.0), eye)
    right /= np.linalg.norm(right)
    return polygon @ np.column_stack([right, np.cross(eye, right)]), float((polygon @ eye).mean())


def shaded(colour: tuple[float, ...], polygon: Array) -> tuple[float, ...]:
    """A colour, lighter where a face looks upwards."""
    if polygon.shape[1] == 2:
        return colour
    normal = np.cross(polygon[1] - polygon[0], polygon[2] - polygon[0])
    if len(polygon) > 6:
        normal = np.cross(polygon[0] - polygon.mean(axis=0), polygon[len(polygon) // 4] - polygon.mean(axis=0))
    normal = normal / max(float(np.linalg.norm(normal)), 1e-12)
    normal = normal if normal @ VIEW > 0.0 else -normal
    light = 0.78 + 0.3 * float(normal @ np.array([0.1, -0.35, 0.93]))
    return tuple(min(1.0, light * part) for part in colour)
