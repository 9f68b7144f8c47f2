"""Energy over long times: which methods let it drift, what a run without drift costs, and why."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from studies import cli, figures, tables
from studies.bench import collect
from studies.cli import StudyError
from studies.energy_drift import (
    BDF_LOOP,
    CALM,
    CRANK,
    DRIFTS,
    GAUSS,
    IRREGULAR,
    LOBATTO,
    MIDPOINT,
    MOMENTA_LASTING,
    MOMENTA_SYMMETRIC,
    NEWMARK_HALF,
    NEWMARK_QUARTER,
    NO_DRIFT,
    ONE,
    PAPER_IRK,
    RADAU,
    SLOWLY,
    SUN,
    SWITCHING,
    VELOCITIES_LASTING,
    VELOCITIES_SYMMETRIC,
    Variant,
    bound,
    name_of,
    verdict,
)
from studies.energy_figures import Series, cost_figure, time_figure
from studies.energy_runs import (
    ALPHA,
    EARLY,
    GEOMETRIES,
    LADDER,
    LADDERED,
    LSODA,
    PROJECTED,
    TRAPEZOIDAL,
    H,
    measure,
    runs,
)
from studies.index import write_index
from studies.render import number, power, render, table
from studies.solvers import IDA_C, OWN_EXPLICIT
from studies.store import Output

__all__ = ["GEOMETRIES", "findings_of", "judged", "main", "report"]

NUMBERS = ("cpu_s", "energy", "kinetic", "slope", "slope_error", "swing", "t_reached", "violation_q", "n_evaluations")
SHARES = (1e-3, 1e-5, 1e-7)  # of the largest kinetic energy: energy errors at which costs are compared
NEAR = 0.3  # of an order about the expected one
EXPECTED = {(ONE, SUN): 7.0, (ONE, RADAU): 5.0, (SWITCHING, SUN): 5.0}
VARIANTS = (VELOCITIES_LASTING, VELOCITIES_SYMMETRIC, MOMENTA_LASTING, MOMENTA_SYMMETRIC)
SYMMETRIC = (GAUSS, LOBATTO, MIDPOINT)  # tableaux
ALTERNATIVES = (IDA_C, LSODA, PROJECTED, ALPHA, TRAPEZOIDAL, OWN_EXPLICIT, "Gauss12", PAPER_IRK, SUN, BDF_LOOP)


def judged(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows with the verdict on each run; `geometry` is the name under which the claims look for a case."""
    rows = rows.astype(dict.fromkeys(NUMBERS, float))  # a run that could not be made has None
    return rows.assign(geometry=rows["case"], verdict=[verdict(row) for _, row in rows.iterrows()])


def pick(rows: pd.DataFrame, geometry: str, solver: str, variant: Variant, setting: str = "h") -> pd.Series:
    """The long run of a method with fixed steps (setting "h") or step-size control ("tol")."""
    chosen = rows[(rows["case"] == geometry) & (rows["solver"] == solver) & rows["group"].isin(("fixed", "controlled"))]
    chosen = chosen[(chosen["variables"] == variant[0]) & (chosen["partition"] == variant[1])]
    chosen = chosen[chosen[setting].notna()]
    if chosen.empty:
        raise StudyError(f"the rows have no run of {solver} on {geometry}; make them again by python -m studies.energy")
    return chosen.iloc[0]


def _text(value: object) -> str | None:
    return value if isinstance(value, str) else None


def told(row: pd.Series) -> dict[str, Any]:
    """A run as a finding."""
    found = {key: row[key] for key in ("solver", "family", "called_from", "cpu_s", "n_evaluations", "violation_q")}
    found |= {key: row[key] for key in ("verdict", "swing", "kinetic", "error_early", "slope_error", "status")}
    found |= {"variables": _text(row["variables"]), "partition": _text(row["partition"]), "name": name_of(row)}
    found |= {"setting": "h" if pd.notna(row["h"]) else "tol", "value": row["h"] if pd.notna(row["h"]) else row["tol"]}
    found |= {"drift": row["slope"] * row["t_end"], "bound": bound(row), "energy": abs(row["energy"])}
    found |= {"calm": row["verdict"] in CALM, "drifts": row["verdict"] in (DRIFTS, SLOWLY)}
    return found | {"keeps": bool(row["keeps_constraints"])}


def cheapest(rows: pd.DataFrame) -> dict[str, Any]:
    """The cheapest run of ours and of others."""
    own = rows["family"] == "two-loop"
    return {name: _least(rows[which]) for name, which in (("ours", own), ("others", ~own))}


def _least(rows: pd.DataFrame) -> dict[str, Any] | None:
    return None if rows.empty else told(rows.loc[rows["cpu_s"].astype(float).idxmin()])


def long_of(rows: pd.DataFrame) -> dict[str, Any]:
    """The class "long and conservative": what no drift costs, what a small error costs, what the alternatives do."""
    reached = rows[(rows["status"] == "REACHED_END") & ~rows["lost"].astype(bool)]
    calm = reached["verdict"].isin(CALM)
    kinetic = float(reached["kinetic"].iloc[0])
    at = []
    for share in SHARES:
        good = reached["energy"].abs() <= share * kinetic
        best = _least(reached[good])
        level = {"no_drift": cheapest(reached[good & calm]), "drift": cheapest(reached[good & ~calm])}
        at.append({"share": share, "energy": share * kinetic, **level, "no_drift_pays": bool(best and best["calm"])})
    free = cheapest(reached[calm])
    own = free["ours"]
    good = reached[reached["energy"].abs() <= own["energy"]] if own else reached.iloc[:0]
    plain = rows["variables"].isna() | ((rows["variables"] == "velocities") & (rows["partition"] == "lasting"))
    listed = rows[plain & rows["group"].isin(("other", "controlled"))]
    return {
        "case": SWITCHING,
        "problem": rows["problem"].iloc[0],
        "t_end": float(rows["t_end"].iloc[0]),
        "kinetic": kinetic,
        "no_drift": free,
        "as_good": _least(good),
        "at": at,
        "n_no_drift_pays": sum(level["no_drift_pays"] for level in at),
        "alternatives": [told(row) for name in ALTERNATIVES for _, row in listed[listed["solver"] == name].iterrows()],
    }


def orders_of(rows: pd.DataFrame) -> list[dict[str, Any]]:
    """How the drift falls with the step, beside the order that theory expects."""
    found = []
    for geometry, solver, variant in LADDERED:
        group = rows[(rows["group"] == "order") & (rows["case"] == geometry) & (rows["solver"] == solver)]
        group = group[(group["variables"] == variant[0]) & (group["partition"] == variant[1]) & group["slope"].notna()]
        steps, slopes = group["h"].to_numpy(float), np.abs(group["slope"].to_numpy(float))
        resolved = len(steps) == len(LADDER) and bool((slopes > 0.0).all())
        order = float(np.polyfit(np.log(steps), np.log(slopes), 1)[0]) if resolved else None
        expected = EXPECTED[geometry, solver]
        line = {"name": name_of(group.iloc[0]) if len(group) else solver, "geometry": geometry, "order": order}
        line |= {"steps": steps.tolist(), "slopes": (1000.0 * group["slope"]).tolist(), "expected": expected}
        found.append(line | {"as_expected": order is not None and abs(order - expected) < NEAR})
    return found


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """What the report and the first screen say."""
    sun, gauss, radau = (told(pick(rows, ONE, name, VELOCITIES_LASTING)) for name in (SUN, GAUSS, RADAU))
    canonical = told(pick(rows, ONE, SUN, MOMENTA_LASTING))
    fixed = rows[(rows["group"] == "fixed") & (rows["case"] == SWITCHING)]
    lasting = fixed[fixed["partition"] == "lasting"]
    even = fixed[(fixed["partition"] == "symmetric") & fixed["solver"].isin(SYMMETRIC)]
    uneven = fixed[(fixed["partition"] == "symmetric") & (fixed["solver"] == SUN)]
    controlled = rows[(rows["group"] == "controlled") & rows["case"].isin((ONE, SWITCHING))]
    newmark = {
        key: [told(pick(rows, geometry, name, VELOCITIES_LASTING)) for name in (NEWMARK_QUARTER, NEWMARK_HALF)]
        for key, geometry in (("one", ONE), ("switching", SWITCHING))
    }
    paper = {
        key: told(pick(rows, geometry, PAPER_IRK, VELOCITIES_LASTING, "tol"))
        for key, geometry in (("one", ONE), ("switching", SWITCHING))
    }
    turning = [told(row) for _, row in rows[rows["case"] == CRANK].iterrows() if row["status"] == "REACHED_END"]
    turn = {
        key: told(pick(rows, CRANK, GAUSS, variant))
        for key, variant in (
            ("velocities", VELOCITIES_LASTING),
            ("momenta", MOMENTA_LASTING),
            ("symmetric", MOMENTA_SYMMETRIC),
        )
    }
    failed = rows[rows["status"] != "REACHED_END"]
    return {
        "long": long_of(rows[(rows["case"] == SWITCHING) & (rows["group"] != "order")]),
        "sun": sun,
        "gauss": gauss,
        "radau": radau,
        "canonical": canonical,
        "sun_over_gauss": abs(sun["drift"]) / gauss["bound"],
        "sun_over_canonical": abs(sun["drift"]) / canonical["bound"],
        "n_lasting": len(lasting),
        "n_lasting_calm": int(lasting["verdict"].isin(CALM).sum()),
        "n_even": len(even),
        "n_even_calm": int(even["verdict"].isin(CALM).sum()),
        "n_uneven": len(uneven),
        "n_uneven_calm": int(uneven["verdict"].isin(CALM).sum()),
        "n_controlled": len(controlled),
        "n_controlled_drift": int(controlled["verdict"].isin((DRIFTS, SLOWLY)).sum()),
        "newmark": newmark,
        "newmark_calm_one": all(run["verdict"] == NO_DRIFT for run in newmark["one"]),
        "newmark_calm_switching": all(run["verdict"] == NO_DRIFT for run in newmark["switching"]),
        "paper": paper,
        "orders": orders_of(rows),
        "crank": turning,
        "crank_gauss": turn,
        "crank_t_end": float(rows[rows["case"] == CRANK]["t_end"].iloc[0]),
        "h": H,
        "early": EARLY,
        "problems": {geometry: rows[rows["case"] == geometry]["problem"].iloc[0] for geometry in (ONE, SWITCHING)},
        "n_failed": len(failed),
    }


def _energy(run: dict[str, Any]) -> str:
    """The drift of a run where it is told from none, else what cannot be excluded; what went wrong, if anything did."""
    if run["drifts"]:
        return number(run["drift"])
    resolved = run["calm"] or run["verdict"] == IRREGULAR
    return f"< {number(run['bound'])} ({run['verdict']})" if resolved else str(run["verdict"])


def choice_table(found: dict[str, Any]) -> str:
    """What small energy errors cost without and with a drift, ours and others."""
    lines = []
    for at in ({"share": None, **found}, *found["at"]):
        line = ["any" if at["share"] is None else f"≤ {number(at['energy'])} J"]
        for kind in ("no_drift", "drift"):
            for which in ("ours", "others"):
                run = at[kind][which] if kind in at else None
                line += ["none" if kind in at else "–", ""] if run is None else [_setting(run), number(run["cpu_s"])]
        lines.append(line)
    header = ["largest energy error", "no drift: ours", "CPU (s)", "no drift: other", "CPU (s)"]
    return table([*header, "not free of it: ours", "CPU (s)", "not free of it: other", "CPU (s)"], lines)


def _setting(run: dict[str, Any]) -> str:
    value = f"h = {number(run['value'])} s" if run["setting"] == "h" else power(run["value"])
    return f"`{run['name']}`, {value}"


def runs_table(listed: Iterable[dict[str, Any]]) -> str:
    """Runs with what they cost and what their energy does."""
    header = ["solver", "called from", "drift (J)", "largest error (J)", "violation", "evaluations", "CPU (s)"]
    lines = []
    for run in listed:
        line = [_setting(run), run["called_from"], _energy(run)]
        lines.append(
            [*line, *(number(run[key]) for key in ("energy", "violation_q", "n_evaluations", "cpu_s"))],
        )
    return table(header, lines)


def variants_table(rows: pd.DataFrame) -> str:
    """Fixed steps: the drift of each method in each variant, on both geometries."""
    header = ["method", "h (s)", f"{ONE}: velocities", "momenta", f"{SWITCHING}: velocities"]
    header += ["velocities, symmetric", "momenta", "momenta, symmetric"]
    places = [(ONE, VELOCITIES_LASTING), (ONE, MOMENTA_LASTING), *((SWITCHING, variant) for variant in VARIANTS)]
    fixed = rows[(rows["group"] == "fixed") & (rows["case"] != CRANK)]
    lines = []
    for solver in dict.fromkeys(fixed["solver"]):
        own = fixed[fixed["solver"] == solver]
        line = [solver, number(own["h"].iloc[0])]
        for geometry, variant in places:
            cell = own[(own["case"] == geometry) & (own["variables"] == variant[0]) & (own["partition"] == variant[1])]
            line.append("not run" if cell.empty else _energy(told(cell.iloc[0])))
        lines.append(line)
    return table(header, lines)


def orders_table(found: Sequence[dict[str, Any]]) -> str:
    """Drift in J per 1000 s for each step, and the order."""
    header = ["method", "geometry", *(f"h = {number(h)} s" for h in LADDER), "order", "expected"]
    lines = []
    for line in found:
        slopes = dict(zip(line["steps"], line["slopes"], strict=True))
        cells = [number(slopes.get(h)) for h in LADDER]
        lines.append([line["name"], line["geometry"], *cells, number(line["order"]), number(line["expected"])])
    return table(header, lines)


def series_of(rows: pd.DataFrame) -> tuple[pd.DataFrame, Series]:
    """The rows without the windows of their runs, and these as series, named by the place of the row."""
    series: Series = {}
    for key, row in rows.iterrows():
        if isinstance(row["window_t"], list):
            series |= {f"t{key}": np.array(row["window_t"]), f"mean{key}": np.array(row["window_mean"])}
    return rows.drop(columns=["window_t", "window_mean"]), series


def report(output: Output, rows: pd.DataFrame, series: Series, line: str) -> dict[str, Any]:
    """Write findings, figures and report; the findings."""
    rows = judged(tables.medians(rows))
    findings = findings_of(rows)
    output.save_findings(findings)
    failed = tables.failures(rows)
    ready = {
        "choice": choice_table(findings["long"]),
        "alternatives": runs_table(findings["long"]["alternatives"]),
        "variants": variants_table(rows),
        "orders": orders_table(findings["orders"]),
        "crank": runs_table(findings["crank"]),
        "failed": table(["solver", "setting", "status", "message"], failed) if failed else "",
    }
    figures.save(cost_figure(rows), output, "energy_cost")
    figures.save(time_figure(rows, series), output, "energy_long")
    names = {"one": ONE, "switching": SWITCHING}
    output.write("energy.md", render("energy", findings, ready, stamp=line, quick=output.call.quick, names=names))
    return findings


def _work(words: Sequence[str] | None) -> None:
    call = cli.parse("energy", __doc__, words)
    with Output(call) as output:
        if call.redraw:
            (rows, line), series = output.load_rows(), output.load_series()
        else:
            with output.kept() as kept:
                rows = collect(runs(call.quick), kept, measure, processes=2)
            line = cli.stamp(call.command)
            rows, series = series_of(judged(rows))
            output.save_rows(rows, line)
            output.save_series(series)
        report(output, rows, series, line)
        write_index(output)
    print(f"wrote energy.md, .csv, .json, series and figures to {output.path}")


def main(words: Sequence[str] | None = None) -> None:
    """Run the study and write its report."""
    cli.main(_work, words)


if __name__ == "__main__":
    main()
