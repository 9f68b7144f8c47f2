"""Random mechanisms under random forces, their motions by SciPy, and the rule by which a run is judged.

`python -m tests.differential_motions` writes differential_motions.json, the motions of `test_differential.py`.
"""

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from studies.bench.apart import heard
from studies.bench.sharp_forces import T_END, Sharp, families, force_along
from studies.bench.sharp_mechanisms import GRAVITY, TIMES, TINY, Mechanism, Motion, chain, motion, off, row, turning
from twoloop import ConstrainedSystem, Result, solve_dae
from twoloop.kernels.compile.callbacks import callback
from twoloop.problem.problem import Array

LOOSENESS = 1e3  # an answer is right within so many tolerances, times the growth of errors ...
JUMPS = 10  # ... and once more for as many jumps ...
LEAST = 3e-12  # ... a tolerance below which no more is asked
CHAOTIC = 1e3  # growth beyond which a motion is not used
RIGHT, SAID, SILENT = "right", "reported failure", "silently wrong"
SEED = 24
FAMILIES = tuple(families())
FILE = Path(__file__).with_suffix(".json")

# callbacks of a slider-crank of points, p = [crank, rod, two masses, ...]: x, y of the crank's end, x of the slider


@callback("mass")
def crank_mass(t, q, p, M):  # type: ignore[no-untyped-def]
    M[0, 0] = M[1, 1] = p[2]
    M[2, 2] = p[3]


@callback("force")
def crank_force(t, q, v, p, Q):  # type: ignore[no-untyped-def]
    Q[1] = -GRAVITY * p[2]
    Q[2] = force_along(t, q[2], v[2], p)


@callback("constraint")
def crank_constraint(t, q, p, C):  # type: ignore[no-untyped-def]
    C[0] = 0.5 * (q[0] * q[0] + q[1] * q[1] - p[0] * p[0])
    C[1] = 0.5 * ((q[2] - q[0]) ** 2 + q[1] * q[1] - p[1] * p[1])


@callback("jacobian")
def crank_jacobian(t, q, p, Cq):  # type: ignore[no-untyped-def]
    Cq[0, 0], Cq[0, 1] = q[0], q[1]
    Cq[1, 0], Cq[1, 1], Cq[1, 2] = q[0] - q[2], q[1], q[2] - q[0]


@callback("gamma")
def crank_gamma(t, q, v, p, Qd):  # type: ignore[no-untyped-def]
    Qd[0] = -(v[0] * v[0] + v[1] * v[1])
    Qd[1] = -((v[2] - v[0]) ** 2 + v[1] * v[1])


CRANK: dict[str, Any] = {"mass": crank_mass, "force": crank_force, "constraint": crank_constraint}
CRANK |= {"jacobian": crank_jacobian, "gamma": crank_gamma}


def slider_crank(sharp: Sharp, crank: float, rod: float, masses: Array, angle: float, speed: float) -> Mechanism:
    """A slider-crank of points; the force acts on the slider, with x = 0 where it is 1 m before its far end."""
    p = np.concatenate([[crank, rod], masses, sharp.on(float(masses[1]), crank + rod - 1.0, 1.0, 1.0)])

    def energies(s: Any) -> tuple[Any, Any, Any]:
        root = np.sqrt(rod * rod - (crank * np.sin(s)) ** 2)
        slope = -crank * np.sin(s) - crank * crank * np.sin(s) * np.cos(s) / root
        inertia = masses[0] * crank**2 + masses[1] * slope * slope
        return inertia, GRAVITY * masses[0] * crank * np.sin(s), crank * np.cos(s) + root

    def positions(t: float, y: Array) -> Array:
        return np.array([crank * np.cos(y[0]), crank * np.sin(y[0]), energies(y[0])[2]])

    about: dict[str, Any] = {"parameters": p, "constant_mass": True, "name": "slider-crank"}
    system = ConstrainedSystem(n_q=3, n_c=2, **CRANK, **about)
    slope = energies(complex(angle, TINY))[2].imag / TINY
    v0 = speed * np.array([-crank * np.sin(angle), crank * np.cos(angle), slope])
    return turning(
        system.name, system, (positions(0.0, np.array([angle])), v0), (angle, speed), (sharp, p), energies, positions
    )


KINDS = ("1", "2", "3", "row", "slider")


def drawn(sharp: Sharp, g: np.random.Generator) -> Mechanism:
    """A random mechanism: a chain of one to three points, a driven row or, under a force, a slider-crank."""
    kind = str(g.choice(KINDS[:-1] if sharp.driven else KINDS))
    masses = g.uniform(0.5, 2.0, 3)
    if kind == "row":
        return row(sharp, g.uniform(1.0, 20.0, 2), masses[:2], float(g.uniform(-0.5, 0.5)), float(g.uniform(-1, 1)))
    if kind == "slider":
        crank = float(g.uniform(0.3, 0.6))
        rod = crank * float(g.uniform(1.6, 3.0))
        return slider_crank(sharp, crank, rod, masses[:2], float(g.uniform(0.4, 2.6)), float(g.uniform(-6.0, 6.0)))
    n = int(kind)
    angles, rates = g.uniform(-1.3, 1.3, n), g.uniform(-2.0, 2.0, n)
    if (sharp.windows or sharp.breaks) and g.uniform() < 0.3:  # it hangs, and nothing happens before the force does
        angles, rates = np.zeros(n), np.zeros(n)
    return chain(sharp, g.uniform(0.5, 1.5, n), masses[:n], angles, rates)


def drawn_from(family: str, g: np.random.Generator, n_drawn: int = 1) -> Mechanism:
    """A random mechanism under a random force of a family, the last of so many draws."""
    for _ in range(n_drawn):
        mechanism = drawn(families()[family](g), g)
    return mechanism


def case(family: str, seed: list[int]) -> tuple[Mechanism, Motion, int]:
    """The same with its motion, and how often it was drawn until that was known well enough."""
    g, n_drawn = np.random.default_rng(seed), 0
    while True:
        mechanism, n_drawn = drawn_from(family, g), n_drawn + 1
        known = motion(mechanism)
        if known.growth <= CHAOTIC and known.apart <= 0.1 * allowed(known, 0.0):
            return mechanism, known, n_drawn


def allowed(known: Motion, tolerance: float, n_jumps: int = 0) -> float:
    """Error up to which an answer is right."""
    return LOOSENESS * (1.0 + n_jumps / JUMPS) * max(tolerance, LEAST) * known.growth


def judged(
    mechanism: Mechanism, known: Motion, method: str, tolerance: float, time_limit: float, **more: Any
) -> dict[str, Any]:
    """A run and its outcome."""
    limit = allowed(known, tolerance, len(mechanism.sharp.breaks))
    options: dict[str, Any] = {"rtol": tolerance, "atol": tolerance, "time_limit": time_limit, "t_eval": TIMES, **more}
    start = mechanism.system, (0.0, T_END), mechanism.q0, mechanism.v0
    return graded(lambda: solve_dae(*start, method, **options), lambda result: off(result.q.T, known.q), limit)


def graded(call: Callable[[], Result], error: Callable[[Result], float], allowed: float) -> dict[str, Any]:
    """A call and its outcome, by the error of its result and that which is allowed."""
    result, row = heard(call)
    row |= {"error": None, "allowed": allowed, "n_evaluations": None}
    if result is None or not result.success:
        return row | {"outcome": SAID}
    row |= {"error": error(result), "n_evaluations": result.stats.n_evaluations}
    return row | {"outcome": RIGHT if row["error"] <= allowed else SAID if row["warned"] else SILENT}


def mechanism_of(family, n_drawn):
    """The mechanism of a family: that of the last of so many draws."""
    return drawn_from(family, np.random.default_rng([SEED, FAMILIES.index(family)]), n_drawn)


def read():
    """Family to the number of draws and the motion."""
    kept = json.loads(FILE.read_text())
    return {
        name: (each["n_drawn"], Motion(np.array(each["q"]), each["apart"], each["growth"]))
        for name, each in kept.items()
    }


def main():
    made = {}
    for place, family in enumerate(FAMILIES):
        _, known, n_drawn = case(family, [SEED, place])
        made[family] = asdict(known) | {"q": known.q.round(13).tolist(), "n_drawn": n_drawn}
    FILE.write_text(json.dumps(made, indent=1))


if __name__ == "__main__":
    main()
