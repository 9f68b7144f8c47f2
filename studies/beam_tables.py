"""The tables of the beam study, and what its runs cost at equal error."""

import numpy as np
import pandas as pd

from studies.beam_figures import TARGET
from studies.beam_limits import PAPER_SWEEPS
from studies.beam_runs import PAPER, SOLVERS, STIFF, for_error
from studies.report import markdown_table, number
from studies.runs import time_for


def power(value: float) -> str:
    """A tolerance as it is written: 1e-5, 0.1."""
    return f"{value:g}".replace("e-0", "e-").replace("e+", "e")


def cpu_for(rows: pd.DataFrame, case: str, solver: str) -> float:
    """CPU time for a tip error of TARGET, s; NaN where no run is that good."""
    found = for_error(rows, case, solver)
    return time_for(found, TARGET) if not found.empty else float("nan")


def cheapest(rows: pd.DataFrame, case: str, solver: str) -> pd.Series | None:
    """The run of least CPU time among those within TARGET."""
    found = for_error(rows, case, solver)
    good = found[found["error_tip"] <= TARGET]
    return None if good.empty else good.loc[good["cpu_s"].idxmin()]


COST = (
    "solver", "tol", "tip error (m)", "CPU (s)", "CPU at 1e-4 m (s)", "paper's / this", "steps", "rejected",
    "evaluations", "Jacobians", "factorizations", "evaluations a step", "µs an evaluation", "h w_max, median",
)  # fmt: skip


def cost_table(rows: pd.DataFrame, case: str) -> str:
    """The cheapest run of each solver within TARGET."""
    w_max = float(rows[rows["group"] == "limit"]["w_max"].iloc[0]) * (10.0 if case == STIFF else 1.0)
    reference = cpu_for(rows, case, PAPER)
    lines = []
    for solver in SOLVERS:
        if for_error(rows, case, solver).empty:
            continue
        row = cheapest(rows, case, solver)
        if row is None:
            best = for_error(rows, case, solver)["error_tip"].min()
            lines.append([solver, "–", f"none within; best {number(best)}", *["–"] * (len(COST) - 3)])
            continue
        seconds = cpu_for(rows, case, solver)
        per_step, each = row["n_evaluations"] / row["n_steps"], 1e6 * row["cpu_s"] / row["n_evaluations"]
        counts = [
            number(row[k], 3) for k in ("n_steps", "n_rejected", "n_evaluations", "n_jacobians", "n_factorizations")
        ]
        numbers = [number(row["error_tip"]), number(row["cpu_s"]), number(seconds), number(reference / seconds)]
        last = [number(per_step), number(each), number(row["h_median"] * w_max)]
        lines.append([solver, power(row["tol"]), *numbers, *counts, *last])
    return markdown_table(list(COST), lines)


def limit_table(rows: pd.DataFrame) -> str:
    """Step limits and rates of the sweeps."""
    header = [
        "sweeps",
        "h w_max: theory",
        "no test ends them",
        "as they are here",
        "rate a sweep",
        "theory",
        "at h w_max",
    ]
    lines = [
        [
            row["solver"],
            number(row["theory"], 3),
            number(row["free"], 3),
            number(row["measured"], 3),
            number(row["rate"], 3) if row["solver"] != PAPER_SWEEPS else "–",
            number(row["rate_theory"], 3) if row["solver"] != PAPER_SWEEPS else "–",
            number(row["rate_at"], 3) if row["solver"] != PAPER_SWEEPS else "–",
        ]
        for _, row in rows[rows["group"] == "limit"].iterrows()
    ]
    return markdown_table(header, lines)


def element_table(rows: pd.DataFrame) -> str:
    """Cost of a step by number of elements."""
    header = ["matrices", "elements", "coordinates", "CPU a step (ms)", "over the fewest", "evaluations a step",
              "Jacobians", "steps", "w_max (rad/s)"]  # fmt: skip
    lines = []
    for kind, line in rows[rows["group"] == "elements"].groupby("solver", sort=False):
        first = line.iloc[0]
        for _, row in line.sort_values("n_elements").iterrows():
            each = row["cpu_s"] / row["n_steps"]
            over = each / (first["cpu_s"] / first["n_steps"])
            lines.append(
                [
                    str(kind),
                    f"{row['n_elements']:.0f}",
                    f"{6 * (row['n_elements'] + 1):.0f}",
                    number(1e3 * each),
                    number(over),
                    number(row["n_evaluations"] / row["n_steps"]),
                    number(row["n_jacobians"]),
                    number(row["n_steps"]),
                    number(row["w_max"], 3),
                ]
            )
    return markdown_table(header, lines)


def modulus_table(rows: pd.DataFrame) -> str:
    """Cost by Young's modulus."""
    header = ["E (N/m²)", "w_max (rad/s)", "solver", "tol", "run (s)", "steps", "evaluations a second",
              "CPU a second (s)", "Jacobians", "tip error (m)", "ended"]  # fmt: skip
    lines = []
    for _, row in rows[rows["group"] == "modulus"].iterrows():
        lines.append(
            [
                power(row["modulus"]),
                number(row["w_max"], 3),
                row["solver"],
                power(row["tol"]),
                f"{row['t_end']:g}",
                number(row["n_steps"], 3),
                number(row["n_evaluations"] / row["t_end"]),
                number(row["cpu_s"] / row["t_end"]),
                number(row["n_jacobians"], 3),
                number(row["error_tip"]),
                row["status"].lower().replace("_", " "),
            ]
        )
    return markdown_table(header, lines)


def truth_table(rows: pd.DataFrame) -> str:
    """How far the reference agrees with others."""
    header = ["case", "compared with", "tol", "largest difference of the tip's height (m)"]
    lines = [
        [row["case"], row["solver"], power(row["tol"]), number(row["error_tip"])]
        for _, row in rows[rows["group"] == "truth"].iterrows()
    ]
    return markdown_table(header, lines)


def check_table(rows: pd.DataFrame) -> str:
    """IDA's digits, and the distance from Exudyn's cable."""
    checks = rows[rows["group"] == "check"]
    if checks.empty:
        return ""
    lines = []
    for _, row in checks.iterrows():
        if pd.notna(row["tol"]):
            lines.append(
                [
                    f"{row['case']}, {row['solver']}, tol {power(row['tol'])}",
                    f"at {row['t_end']:g} s",
                    number(row["error_tip"]),
                ]
            )
        else:
            ours = f"{row['n_elements']:.0f} elements, Poisson's ratio {row['poisson']:g}"
            theirs = f"{row['case']}, {row['stiffness']:.4g} × E"
            lines.append([f"{theirs}, from our {ours}", f"0 to {row['t_end']:g} s", number(row["error_tip"])])
    return markdown_table(["check", "when", "difference of the tip's height (m)"], lines)


def anderson_table(rows: pd.DataFrame) -> str:
    """Sweeps by depth."""
    trials = rows[rows["group"] == "anderson"]
    if trials.empty:
        return ""
    depths = sorted(trials["depth"].unique())
    lines = []
    for (case, h), group in trials.groupby(["case", "h"], sort=False):
        counts = group.set_index("depth")["sweeps"]
        lines.append([case, f"{h:g}", *("–" if np.isinf(counts[d]) else f"{counts[d]:.0f}" for d in depths)])
    return markdown_table(["problem", "h (s)", "plain sweeps", *(f"depth {d:.0f}" for d in depths[1:])], lines)


def run_table(rows: pd.DataFrame) -> str:
    """All runs."""
    header = ["case", "solver", "tol", "tip error (m)", "midpoint error (m)", "energy error (J)", "CPU (s)", "runs",
              "steps", "rejected", "evaluations", "Jacobians", "factorizations", "median h (s)", "ended"]  # fmt: skip
    lines = []
    for _, row in rows[rows["group"] == "run"].iterrows():
        errors = [number(row[name]) for name in ("error_tip", "error_middle", "error_energy")]
        counts = [
            number(row[k], 3) for k in ("n_steps", "n_rejected", "n_evaluations", "n_jacobians", "n_factorizations")
        ]
        ended = row["status"].lower().replace("_", " ")
        if row["status"] != "REACHED_END":
            ended += f" at {number(row['t_reached'], 3)} s"
        some = [number(row["cpu_s"]), number(row["repeats"]), *counts, number(row["h_median"]), ended]
        lines.append([row["case"], row["solver"], power(row["tol"]), *errors, *some])
    return markdown_table(header, lines)
