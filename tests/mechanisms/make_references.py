"""Computes the references of the ready mechanisms: `python -m tests.mechanisms.make_references [NAME...]`.

Each is integrated by extrapolation in extended precision, with steps halved until the end no longer changes, and then
compared with the mechanism's own equations at index 1, which SciPy integrates.
"""

import json
import sys

import numpy as np

from tests.mechanisms.motions import known_motions
from tests.mechanisms.motions.integrate import by_extrapolation, by_scipy
from twoloop.mechanisms.registry import REFERENCES

BEST = 15.5  # digits of the numbers in the file
ENOUGH = 15.0


def digits(values, reference):
    """Decimals that agree, over max(1, largest value)."""
    scale = max(1.0, np.abs(reference).max(initial=0.0))
    difference = np.abs(np.asarray(values - reference)).max(initial=0.0) / scale
    return round(float(min(BEST, -np.log10(max(difference, 1e-30)))), 1)


def converged(motion, end, n=32):
    """The state at the end and digits of q and v, by halving the steps until rounding ends the gain."""
    rate, y0, known = motion
    coarse, before = known(np.longdouble(end), by_extrapolation(rate, y0, end, n)), 0.0
    while True:
        n *= 2
        with np.errstate(all="ignore"):
            fine = known(np.longdouble(end), by_extrapolation(rate, y0, end, n))
        finite = np.isfinite(np.concatenate([*coarse, *fine])).all()
        held = [digits(a, b) if finite else 0.0 for a, b in zip(coarse, fine, strict=True)]
        if min(held) >= ENOUGH or (min(held) > 12.0 and min(held) < before + 1.0):
            return fine, held
        coarse, before = fine, min(held)


def equations(system, t, q, v):
    """Whole matrix and right-hand side for acceleration and multipliers at a state."""
    J, M = system.rows(t, q), system.mass(t, q)
    kinds = [kind for kind, size in (("gamma", system.n_c), ("nonholonomic_gamma", system.n_a)) if size]
    matrix = np.block([[M, J.T], [J, np.zeros((len(J), len(J)))]])
    return matrix, np.concatenate([getattr(system, kind)(t, q, v) for kind in ("force", *kinds)])


def solution(system, t, q, v):
    """Acceleration and multipliers, of least norm."""
    matrix, right = equations(system, t, q, v)
    both = np.linalg.pinv(matrix, rcond=1e-11, hermitian=True) @ right
    return both[: q.size], both[q.size :]


def multipliers(system, t, q, v, held):
    """Multipliers of least norm, and their digits: as far as two factorisations agree, and no more than those of v."""
    lam = solution(system, t, q, v)[1]
    other = np.linalg.lstsq(*equations(system, t, q, v), rcond=1e-11)[0][q.size :]
    return lam, min(held, digits(other, lam))


def index_1(problem, end):
    """The end of the motion by the mechanism's own equations."""
    n, redundant = problem.system.n_q, "redundant" in problem.tags

    def rate(t, y):
        if redundant:
            return np.concatenate([y[n:], solution(problem.system, t, y[:n], y[n:])[0]])
        return np.concatenate([y[n:], np.linalg.solve(*equations(problem.system, t, y[:n], y[n:]))[:n]])

    return np.split(by_scipy(rate, np.concatenate([problem.q0, problem.v0]), end), 2)


def computed(problem, motion, end):
    (q, v), (held_q, held_v) = converged(motion, end)
    q, v = (np.array(each, dtype=float) for each in (q, v))
    other_q, other_v = index_1(problem, end)
    lam, held_lam = multipliers(problem.system, end, q, v, held_v)
    held, agrees = {"q": held_q, "v": held_v, "lam": held_lam}, {"q": digits(other_q, q), "v": digits(other_v, v)}
    return {"t": end, "q": q.tolist(), "v": v.tolist(), "lam": lam.tolist(), "digits": held, "agrees": agrees}


def main(names):
    for name, (problem, motion, end) in known_motions().items():
        if names and name not in names:
            continue
        new = computed(problem, motion, end)
        print(name, new["digits"], new["agrees"], flush=True)
        whole = json.loads(REFERENCES.read_text(encoding="utf-8")) if REFERENCES.exists() else {}
        whole[name] = new
        REFERENCES.write_text(json.dumps(whole, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
