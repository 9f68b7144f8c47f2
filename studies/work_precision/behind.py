"""Where the time of the default's calls goes where a rival is faster. A part of `studies.work_precision`."""

from collections.abc import Sequence
from typing import Any

import pandas as pd

from studies.bench import headline, tables

AT = 1e-6  # the error at which mechanisms are listed


def findings_of(mechanisms: Sequence[dict[str, Any]], rows: pd.DataFrame) -> dict[str, Any]:
    """The pairs in which the default is behind, by what takes longer than the rival, and the mechanisms at one error.

    `mechanisms`: as `rivals.findings_of` lists them; `rows`: the medians of which it does.
    """
    pairs = [
        pair
        for each in mechanisms
        for at in each["at"]
        if at["standing"][headline.GIVEN]["verdict"] == "behind"
        and (pair := _pair(rows[rows["case"] == each["case"]], at)) is not None
    ]
    steps = [pair["steps_s"] >= pair["rival_s"] for pair in pairs]
    outside = [pair["call_s"] - pair["steps_s"] >= pair["rival_s"] for pair in pairs]
    either = list(zip(steps, outside, strict=True))
    parts = {"steps": sum(steps), "each": either.count((True, True)), "outside": either.count((False, True))}
    parts["together"] = either.count((False, False))
    return {"n": len(pairs), "parts": parts, "error": AT, "at": [pair for pair in pairs if pair["error"] == AT]}


def _pair(rows: pd.DataFrame, at: dict[str, Any]) -> dict[str, Any] | None:
    """The cheapest run of the default and of its fastest rival that are accurate enough; None: the rival has none."""
    given = at["standing"][headline.GIVEN]
    own = tables.run_for(rows[rows["solver"] == given["solver"]], at["error"])
    of_rival = rows[rows["solver"] == given["rival"]["solver"]]
    if not tables.costs_at(of_rival, at["error"]) or pd.isna(own["inside_s"]):
        return None
    rival = tables.run_for(of_rival, at["error"])
    found = {"case": str(own["case"]), "error": at["error"], "call_s": float(own["call_s"])}
    found |= {"steps_s": float(own["inside_s"]), "n_steps": int(own["n_steps"])}
    steps = None if pd.isna(rival["n_steps"]) else int(rival["n_steps"])
    return found | {"rival": str(rival["solver"]), "rival_s": float(rival["call_s"]), "rival_steps": steps}
