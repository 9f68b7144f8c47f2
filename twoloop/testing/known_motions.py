"""Reads the known motions of the wheel, which tests/testing/make_motions.py writes, and puts problems together."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from twoloop.testing.known_problem import Array, KnownProblem, Motion

FILE = Path(__file__).with_name("known_motions.npz")
N_TIMES = 101  # of a motion, at equal distances


@cache
def known_motion(name: str) -> Motion | None:
    """The motion of a problem, read-only; None where none is stored."""
    with np.load(FILE, allow_pickle=False) as file:
        if f"{name}/t" not in file:
            return None
        arrays = {key: file[f"{name}/{key}"] for key in ("t", "q", "v", "lam", "digits", "growth")}
    for array in arrays.values():
        array.flags.writeable = False
    digits = dict(zip(("q", "v", "lam"), arrays.pop("digits").astype(float), strict=True))
    return Motion(**arrays, digits=digits)


def posed(
    name: str,
    equations: Any,
    start: tuple[Array, Array],
    end: float,
    tags: str,
    kinds: str,
    powers: Any,
    begin: float = 0.0,
    **more: Any,
) -> KnownProblem:
    """A problem with its known motion; `tags` are divided by commas, `kinds`, of the coordinates, by blanks."""
    q0, v0 = (np.asarray(each, dtype=float) for each in start)
    more.setdefault("energy", equations.energy)
    names = ("mass", "force", "constraint", "jacobian", "constraint_rate", "gamma")
    return KnownProblem(
        name=name,
        **{each: getattr(equations, each) for each in names},
        q0=q0,
        v0=v0,
        t_span=(begin, end),
        tags=tuple(tags.split(", ")),
        coordinates=tuple(kinds.split()),
        row_powers=np.asarray(powers, dtype=float),
        reference=known_motion(name),
        **more,
    )
