"""References computed for this project by `tests/mechanisms/make_references.py`, stored in `references.json`.

Each is the final state of a motion in minimal coordinates, integrated in extended precision, independently of the
callbacks of the mechanism. The multipliers are computed from its own matrices at that state.
"""

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from twoloop.problem.problem import Reference

FILE = Path(__file__).with_name("references.json")


@cache
def _all() -> dict[str, Any]:
    return dict(json.loads(FILE.read_text(encoding="utf-8")))


def computed(name: str) -> Reference | None:
    """Return the reference of a problem by name; None if there is none."""
    known = _all().get(name)
    if known is None:
        return None
    q, v, lam = (np.array(known[kind]) for kind in ("q", "v", "lam"))
    return Reference(
        t=known["t"],
        q=q,
        v=v,
        lam=lam,
        source="computed for this project: few coordinates, extrapolation of order 18 in extended precision",
        digits=known["digits"],
        verified=(
            "the mechanism's own equations at index 1, by SciPy's DOP853 at 1e-13, agree to "
            f"{known['agrees']['q']:.1f} digits in q and {known['agrees']['v']:.1f} in v"
        ),
    )
