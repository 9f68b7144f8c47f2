"""Runs of random mechanisms under sharp forces, judged by their motion in independent coordinates, and their counts."""

import re
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pandas as pd

from studies.bench.sharp_forces import FRICTION, families
from studies.bench.sharp_motion import JUMPS, RIGHT, SAID, SILENT, Mechanism, Motion, case, judged
from studies.bench.solvers import DEFAULT
from studies.bench.store import Row
from studies.honesty.study import REFUSALS

METHODS = (  # all presets but the paper's, and code made for the mechanism
    *("auto", "auto, compiled", "Taylor", "Taylor, compiled", "Adams", "DOP853", "Gauss4", "Gauss6", "Gauss8"),
    *("Gauss10", "Gauss12", "Gauss14", "Gauss16", "SunRadau5", "RadauIIA5", "RadauIIA9", "RadauIIA13", "TRBDF2"),
    *("ESDIRK4", "BDF", "Newmark"),
)
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
LARGE = 1e-2  # m or rad: an error that a user would not expect at the loosest tolerance, though it counts as right
SEED, N_MECHANISMS = 25, 144  # every other one with friction: about 3,000 runs
TIME_LIMIT = 10.0  # s
THOUSAND = 1e3  # tolerances, whatever the sensitivity of the motion
SHARP = "sharp"  # group of these rows

Part = tuple[str, Callable[[], list[Row]]]


def run(mechanism: Mechanism, known: Motion, method: str, tolerance: float) -> Row:
    """One run as a user gets it, or with code of its own where the name says so."""
    name, _, code = method.partition(", ")
    row: Row = {"group": SHARP, "what": mechanism.sharp.family, "name": mechanism.name, "method": method}
    compiled = True if code else "auto"
    return row | {"tol": tolerance} | judged(mechanism, known, name, tolerance, TIME_LIMIT, compiled=compiled)


def random_mechanisms(quick: bool) -> Iterator[Part]:
    """Key and rows of each: every method, at a tolerance that goes round."""
    every = list(families())
    rubbing = [family for family in every if family.split(",")[0] in FRICTION]
    others = [family for family in every if family not in rubbing]

    def rows(k: int, family: str) -> list[Row]:
        mechanism, known, _ = case(family, [SEED, k])
        methods = METHODS[::6] if quick else METHODS
        return [
            run(mechanism, known, method, TOLERANCES[(k + place) % len(TOLERANCES)]) | {"value": float(k)}
            for place, method in enumerate(methods)
        ]

    for k in range(4 if quick else N_MECHANISMS):
        kinds = others if k % 2 else rubbing
        family = kinds[k // 2 % len(kinds)]
        yield f"sharp {k} {family}", partial(rows, k, family)


def counts(rows: pd.DataFrame) -> dict[str, Any]:
    """Outcomes, and those of each method; every run that is wrong and silent by its name. What is refused is no run."""
    refused = rows["message"].fillna("").str.contains("|".join(map(re.escape, REFUSALS)))
    silent = rows[rows["outcome"] == SILENT]

    def of(own: pd.DataFrame) -> dict[str, int]:
        ran = own["outcome"][~refused[own.index]]
        counts = {what: int((ran == what).sum()) for what in (RIGHT, SAID, SILENT)}
        return {"n": len(ran), "refused": len(own) - len(ran)} | counts

    found: dict[str, Any] = of(rows) | {"n_mechanisms": len(rows.groupby(["what", "name", "value"], dropna=False))}
    found["methods"] = [{"method": str(name)} | of(own) for name, own in rows.groupby("method", sort=False)]
    loose = rows[(rows["tol"] == max(TOLERANCES)) & (rows["outcome"] == RIGHT)]
    n_loose = int((loose["error"].astype(float) > LARGE).sum())
    found["loose"] = {"tolerance": max(TOLERANCES), "error": LARGE, "n": n_loose}
    groups = silent.groupby(["method", "what"], sort=False)
    found["silent"] = [{"method": str(name), "what": str(what), "n": len(own)} for (name, what), own in groups]
    by_tolerance = rows.groupby("tol")["allowed"].agg(["median", "max"]).sort_index(ascending=False)
    found["allowed"] = by_tolerance.reset_index().rename(columns={"max": "most"}).to_dict("records")
    misled = silent[silent["method"] == DEFAULT].sort_values("error", ascending=False)
    own = rows[(rows["method"] == DEFAULT) & ~refused]
    wrong = misled[["what", "name", "tol", "error"]].to_dict("records")
    found |= {"default": {"method": DEFAULT, "n": len(own), "wrong": wrong}, "within_thousand": within_thousand(own)}
    return found | {"jumps": JUMPS}


def within_thousand(runs: pd.DataFrame) -> dict[str, Any]:
    """How many tolerances runs end off, whatever the sensitivity; how many within 1000, report failure, do neither."""
    failed = runs["outcome"] == SAID
    over = (runs["error"].astype(float) / runs["tol"].astype(float))[~failed]
    near = ~failed & (over <= THOUSAND).reindex(runs.index, fill_value=False)
    counted = {"within": int(near.sum()), "failed": int(failed.sum()), "beyond": int((~failed & ~near).sum())}
    sizes = {"median": float(over.median()), "most": float(over.max())} if over.notna().any() else {}
    return {"tolerances": THOUSAND, "n": len(runs)} | counted | sizes
