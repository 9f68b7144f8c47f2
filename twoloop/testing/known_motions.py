"""Reads the known motions in the wheel, written by tests/testing/make_motions.py, and assembles problems."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from twoloop.testing.known_problem import KnownProblem, Motion

FILE = Path(__file__).with_name("known_motions.npz")
N_TIMES = 101  # equidistant times of a motion


@cache
def known_motion(name: str) -> Motion | None:
    """Return the motion of a problem, read-only; None if none is stored."""
    with np.load(FILE, allow_pickle=False) as file:
        if f"{name}/t" not in file:
            return None
        arrays = {key: file[f"{name}/{key}"] for key in ("t", "q", "v", "lam", "digits", "growth")}
    for array in arrays.values():
        array.flags.writeable = False
    digits = dict(zip(("q", "v", "lam"), arrays.pop("digits").astype(float), strict=True))
    return Motion(**arrays, digits=digits)


def posed(
    name: str, equations: Any, start: tuple[Any, Any], end: float, tags: str, begin: float = 0.0, **more: Any
) -> KnownProblem:
    """Return a problem with its known motion; `tags` are separated by commas."""
    told = ("mass", "force", "constraint", "jacobian", "constraint_rate", "gamma", "energy", "coordinates")
    known: dict[str, Any] = {each: getattr(equations, each) for each in told} | {"reference": known_motion(name)}
    known |= {"t_span": (begin, end), "tags": tuple(tags.split(", ")), "row_powers": np.array(equations.row_powers)}
    known["parameters"] = {key: np.array(value, dtype=float) for key, value in equations.parameters.items()}
    return KnownProblem(name=name, q0=start[0], v0=start[1], **known | equations.parts | more)
