"""The text of the beam study, every number from its rows."""

import numpy as np
import pandas as pd

from studies.beam_anderson import STATES
from studies.beam_figures import TARGET
from studies.beam_limits import (
    FINE_STAGES,
    FINE_TOL,
    FIXED_STEP,
    LIMIT_STEPS,
    LOOSER_TOL,
    MODULUS_SWEEPS_END,
    PAPER_SWEEPS,
    PARTING,
    PERTURBED,
    REDUCED,
    VISIBLE,
)
from studies.beam_runs import (
    AUTO,
    BDF,
    CASES,
    DIFFERENCES,
    EXPLICIT,
    IDA_C,
    IDA_C_LOOSE,
    NEWTON,
    NEWTON_4,
    NEWTON_5,
    NEWTON_GAUSS,
    PAPER,
    PAPER_TOL,
    PER_SECOND,
    SOFT,
    STIFF,
    SWEEPS,
    for_error,
)
from studies.beam_tables import (
    anderson_table,
    cheapest,
    check_table,
    cost_table,
    cpu_for,
    element_table,
    limit_table,
    modulus_table,
    power,
    run_table,
    truth_table,
)
from studies.report import Call, markdown_table, number
from studies.runs import time_for
from studies.solvers import OWN_EXPLICIT

PAPER_SECONDS = {SOFT: 56.27, STIFF: 6278.54}  # the computation times that the paper gives
ORDER = {SOFT: "1e-3", STIFF: "1e-5"}  # s, its step sizes by order of magnitude
SECONDS_ASKED = {SOFT: 2.0, STIFF: 60.0}  # CPU time asked of the paper's procedure here
FACTOR_ASKED = {SOFT: 20.0, STIFF: 200.0}  # times less CPU asked of Newton's method
GROWTH_ASKED = 24.0  # from 4 to 64 elements
STIFFEST = 2e10  # N/m^2
FEW = 10  # sweeps


def of_paper(rows: pd.DataFrame, case: str) -> pd.Series:
    """The run of the paper's procedure at the paper's tolerances."""
    found = for_error(rows, case, PAPER)
    return found[found["tol"] == PAPER_TOL].iloc[0]


def _times(value: float) -> str:
    return f"{number(value)} times" if np.isfinite(value) else "(no run reaches that error)"


def least(rows: pd.DataFrame, case: str, solvers: tuple[str, ...]) -> tuple[str, float]:
    """Which of these solvers reaches TARGET in the least CPU time, and in what time."""
    times = {solver: cpu_for(rows, case, solver) for solver in solvers}
    known = {solver: value for solver, value in times.items() if np.isfinite(value)}
    return min(known.items(), key=lambda item: item[1]) if known else ("none", float("nan"))


NEWTONS, IDAS = (NEWTON, NEWTON_4, NEWTON_5, NEWTON_GAUSS), (IDA_C, IDA_C_LOOSE)
OURS = (*NEWTONS, AUTO, SWEEPS, BDF, OWN_EXPLICIT)


def goals(rows: pd.DataFrame) -> list[list[str]]:
    """What was asked of this example, what was measured, and whether that is reached."""
    lines = []

    def goal(asked: str, measured: str, value: float, reached: bool) -> None:
        lines.append([asked, measured, ("yes" if reached else "no") if np.isfinite(value) else "not measured"])

    for case in CASES:
        row = of_paper(rows, case)
        value = float(row["cpu_s"]) if row["status"] == "REACHED_END" else float("nan")
        asked = f"the paper's procedure, {case}: less than {SECONDS_ASKED[case]:g} s of CPU"
        goal(asked, f"{number(value)} s for {row['t_end']:g} s", value, value < SECONDS_ASKED[case])
    for case in CASES:
        solver, seconds = least(rows, case, NEWTONS)
        value = cpu_for(rows, case, PAPER) / seconds
        asked = (
            f"Newton's method, {case}: {FACTOR_ASKED[case]:g} times less CPU than the paper's at a tip error of 0.1 mm"
        )
        own = of_paper(rows, case)["cpu_s"] / seconds
        measured = (
            f"{_times(value)} ({solver}, {number(seconds)} s); {_times(own)} if the paper's keeps its own tolerances"
        )
        goal(asked, measured, value, value >= FACTOR_ASKED[case])
    for case in CASES:
        (ours, own), (other, theirs) = least(rows, case, OURS), least(rows, case, IDAS)
        value = theirs / own
        asked = f"faster than IDA driven from C with compiled residual and exact Jacobian, {case}: any method of this project"
        measured = f"IDA takes {_times(value)} the CPU ({other}, {number(theirs)} s, against {ours}, {number(own)} s)"
        goal(asked, measured, value, value > 1.0)
        newton, seconds = least(rows, case, NEWTONS)
        measured = f"IDA takes {_times(theirs / seconds)} the CPU ({newton}, {number(seconds)} s)"
        goal(f"the same, {case}: Newton's method", measured, theirs / seconds, theirs > seconds)
    value = growth(rows, "banded")
    counts = rows[rows["group"] == "elements"]["n_elements"]
    asked = f"cost of a step from 4 to 64 elements: at most {GROWTH_ASKED:g} times"
    known = np.isfinite(value) and counts.max() == 64
    goal(
        asked, f"{_times(value)} to {counts.max():g} elements", value if known else float("nan"), value <= GROWTH_ASKED
    )
    value, text = stiffness_growth(rows)
    asked = "Newton's method at E = 2e10: about the cost of E = 2e8 (less than twice) at a tip error of 0.1 mm"
    goal(asked, text, value if rows["modulus"].max() == STIFFEST else float("nan"), value < 2.0)
    return lines


def growth(rows: pd.DataFrame, kind: str) -> float:
    """CPU time of a step with the most elements over that with the fewest."""
    line = rows[(rows["group"] == "elements") & (rows["solver"] == kind)].sort_values("n_elements")
    if len(line) < 2:
        return float("nan")
    each = line["cpu_s"] / line["n_steps"]
    return float(each.iloc[-1] / each.iloc[0])


def modulus_cost(rows: pd.DataFrame, modulus: float, what: str) -> float:
    """Cost of RadauIIA5 for a tip error of TARGET with this modulus."""
    found = rows[(rows["group"] == "modulus") & (rows["solver"] == NEWTON) & (rows["modulus"] == modulus)]
    return time_for(found.assign(error_q=found["error_tip"]), TARGET, what)


def stiffness_growth(rows: pd.DataFrame) -> tuple[float, str]:
    """Cost of Newton's method at the stiffest beam over that at 2e8 N/m^2, and a text that says so."""
    stiffest = float(rows["modulus"].max())
    counts, seconds = (
        modulus_cost(rows, stiffest, what) / modulus_cost(rows, 2e8, what) for what in ("n_evaluations", "cpu_s")
    )
    return (
        counts,
        f"{_times(counts)} the evaluations, {number(seconds)} times the CPU, from 2e8 to {power(stiffest)} N/m²",
    )


def summary(rows: pd.DataFrame) -> list[str]:
    """The findings."""
    lines = []
    for case in CASES:
        row = of_paper(rows, case)
        lines.append(
            f"The paper's procedure, {case} beam, Atol = Rtol = {power(PAPER_TOL)}: {row['status'].lower().replace('_', ' ')}, "
            f"{number(row['n_steps'], 3)} steps of {number(row['h_median'])} s in the middle and {number(row['h_max'])} s "
            f"at most (the paper: order {ORDER[case]} s), {number(row['n_evaluations'])} evaluations, "
            f"{number(row['cpu_s'])} s of CPU for {row['t_end']:g} s of motion (the paper, on its machine: "
            f"{PAPER_SECONDS[case]:g} s), tip error {number(row['error_tip'])} m."
        )
    soft, stiff = of_paper(rows, SOFT), of_paper(rows, STIFF)
    ratio = PAPER_SECONDS[STIFF] / PAPER_SECONDS[SOFT]
    lines.append(
        f"Between the cases its cost grows by {number(stiff['n_evaluations'] / soft['n_evaluations'])} (evaluations) and "
        f"{number(stiff['cpu_s'] / soft['cpu_s'])} (CPU); in the paper by {number(ratio)} (time). The largest frequency "
        "grows by 10: the paper's runs may differ in length or settings, which it does not tell."
    )
    for case in CASES:
        solver, seconds = least(rows, case, NEWTONS)
        value = cpu_for(rows, case, PAPER) / seconds
        lines.append(
            f"Newton's method as the outer loop, {case} beam: {number(seconds)} s of CPU for a tip error of "
            f"{1e3 * TARGET:g} mm ({solver}), {_times(value)} less than the paper's procedure."
        )
    return [*lines, *_explicit_text(rows), _limit_text(rows), *_sensitivity_text(rows)]


def _explicit_text(rows: pd.DataFrame) -> list[str]:
    """What an explicit method in the same inner loop costs; nothing in rows of before it was there."""
    lines = []
    for case in CASES:
        row = cheapest(rows, case, OWN_EXPLICIT)
        if row is None:
            continue
        others = [least(rows, case, solvers) for solvers in (NEWTONS, IDAS)]
        implicit = " and ".join(f"{number(seconds)} s ({name})" for name, seconds in others if np.isfinite(seconds))
        lines.append(
            f"No outer loop at all, {case} beam: {OWN_EXPLICIT} takes {number(cpu_for(rows, case, OWN_EXPLICIT))} s of CPU for a tip "
            f"error of {1e3 * TARGET:g} mm ({number(row['n_evaluations'])} evaluations at tol {power(row['tol'])}, error "
            f"{number(row['error_tip'])} m); the cheapest implicit ones {implicit or 'are not in these rows'}."
        )
    return lines


def _limit_text(rows: pd.DataFrame) -> str:
    paper = rows[(rows["group"] == "limit") & (rows["solver"] == PAPER_SWEEPS)].iloc[0]
    return (
        f"Why the paper's steps are short: its sweeps shrink for h w_max < {number(paper['theory'], 3)} (measured "
        f"{number(paper['free'], 3)} where nothing ends them), but its test (33) gives them up from h w_max = "
        f"{number(paper['measured'])} on in the linearised beam, where changes grow before they shrink."
    )


def _sensitivity_text(rows: pd.DataFrame) -> list[str]:
    lines = []
    for case in CASES:
        runs = rows[(rows["group"] == "sensitivity") & (rows["case"] == case)]
        end = runs["t_end"].iloc[0]
        texts = [
            f"{run['solver']} {number(run['before'])} and {number(run['largest'])} m" for _, run in runs.iterrows()
        ]
        lines.append(
            f"Sensitivity, {case} beam, largest change of the tip's height until {min(PARTING, end):g} s and until {end:g} s: "
            f"{'; '.join(texts)}."
        )
    return lines


def headline(rows: pd.DataFrame) -> str:
    """For the index of the reports."""
    parts = []
    for case in CASES:
        solver, seconds = least(rows, case, NEWTONS)
        parts.append(
            f"{case}: the paper's procedure takes {number(cpu_for(rows, case, PAPER))} s of CPU for a tip error of "
            f"{1e3 * TARGET:g} mm, Newton's method as the outer loop {number(seconds)} s ({solver}), IDA from C "
            f"{number(least(rows, case, IDAS)[1])} s"
        )
    text = "; ".join(parts)
    return text[0].upper() + text[1:] + "."


def report(rows: pd.DataFrame, line: str, call: Call) -> None:
    """Write beam.md."""
    parts = [
        "# The flexible beam on a moving base (Sect. 4.2 of the paper)",
        f"Generated by {line}. Do not edit; rows in `beam.csv`, curves in `beam_series.npz`.",
        "\n".join(f"- {text}" for text in summary(rows)),
        "**The start is assumed**, here as everywhere below: straight along x, gravity across it, only the base node moving. "
        "The paper's text tells neither this nor the length of its runs; its figures are lost, so that it can be compared with by "
        "its prose alone: times, orders of magnitude of the steps, and until when its results agree with those of others.",
        "## What was asked, and what was reached",
        markdown_table(["asked", "measured", "reached"], goals(rows)),
        _obstacles(rows),
        "## The motion and the steps (Figs. 9 to 14)",
        "![Tip height, midpoint deflection and step size](beam_motion.png)",
        "Grey: the reference. Of the steps the median and the band from the shortest to the longest. The dotted vertical line is "
        f"the paper's {PARTING:g} s.",
        f"## Cost at equal error: the tip within {1e3 * TARGET:g} mm",
        "![Tip error against CPU time](beam_cost.png)",
        *(part for case in CASES for part in (f"### The {case} beam", cost_table(rows, case))),
        "Each line is the cheapest run whose tip stays within the target; “CPU at 1e-4 m” lies on the log-log line to the next "
        "looser run. Where already the loosest run is far better than the target, as with sweeps that their step limit holds "
        "back, it counts as it is. An evaluation of IDA is one of its residual. The very flexible beam magnifies small changes (see below): "
        "there the errors of single runs scatter by factors, and so do the times of all solvers at one error.",
        "## The step limit of sweeps",
        limit_table(rows),
        _limit_notes(),
        "## Why results part after 1.2 s",
        "![Change of the tip's height](beam_sensitivity.png)",
        _parting(rows),
        "## More elements, stiffer beams",
        "![Cost against elements and against Young's modulus](beam_growth.png)",
        element_table(rows),
        modulus_table(rows),
        f"The base moves as that of the moderately stiff beam. Sweeps run for {MODULUS_SWEEPS_END:g} s only, Newton's method for "
        f"all of the time, its tip compared with that of {FINE_STAGES}-stage Radau IIA at tol {power(FINE_TOL)}.",
        "## The reference, and other people's beams",
        truth_table(rows),
        check_table(rows),
        _check_notes(rows),
        "## Anderson's acceleration, tried and not kept",
        anderson_table(rows),
        _anderson_notes(rows),
        "## All runs",
        run_table(rows),
        "## How to read this",
        _notes(),
    ]
    (call.out / "beam.md").write_text("\n\n".join(part for part in parts if part) + "\n")


def _obstacles(rows: pd.DataFrame) -> str:
    """What stands in the way of the goals that are not reached, from the same rows."""
    texts = []
    for case in CASES:
        ours = [row for row in (cheapest(rows, case, solver) for solver in NEWTONS) if row is not None]
        theirs = [row for row in (cheapest(rows, case, solver) for solver in IDAS) if row is not None]
        if not ours or not theirs:
            continue
        own = min(ours, key=lambda row: float(row["cpu_s"]))
        ida = min(theirs, key=lambda row: float(row["cpu_s"]))
        swept = for_error(rows, case, SWEEPS)
        each = float((swept["cpu_s"] / swept["n_evaluations"]).median())
        share = each * own["n_evaluations"] / own["cpu_s"]
        texts.append(
            f"- {case}: {own['solver']} takes {number(own['n_steps'], 3)} steps of {number(own['n_evaluations'] / own['n_steps'])} "
            f"evaluations and {number(1e6 * own['cpu_s'] / own['n_steps'])} µs; at the {number(1e6 * each)} µs that an evaluation costs in "
            f"sweeps, evaluations are {share:.0%} of its time, and algebra with tangents ({number(own['n_jacobians'], 3)} of them) is the rest. "
            f"{ida['solver']} takes {number(ida['n_steps'], 3)} steps of "
            f"{number(ida['n_evaluations'] / ida['n_steps'])} residuals and {number(1e6 * ida['cpu_s'] / ida['n_steps'])} µs, all in all."
        )
        bought = cpu_for(rows, case, PAPER) / FACTOR_ASKED[case] / each
        if bought < own["n_evaluations"]:
            texts[-1] += (
                f" The {FACTOR_ASKED[case]:g}th part of the paper's procedure's time is that of {number(bought)} evaluations: fewer than "
                f"the {number(own['n_evaluations'])} of {own['solver']}, whatever its algebra costs."
            )
    notes = (
        "What stands in the way where a goal is not reached: the very flexible beam's tip depends on its fast vibrations, so that for 0.1 mm "
        "every method has to resolve them (see h w_max in the table below). There the step limit of sweeps costs little, and what "
        "counts is the cost of a step: a multistep method has one stage, a Runge–Kutta step of Newton's method three or more, each evaluated "
        "at every iteration. The stiff beam's vibrations need not be resolved, and Newton's method steps over them; the paper's procedure "
        "cannot, whatever its tolerance: its loosest run is still far more exact than asked. Both IDA and Newton's method have the exact tangent "
        f"of the forces; {DIFFERENCES} shows what differences would cost."
    )
    return "\n\n".join(["Where the time goes:", "\n".join(texts), notes]) if texts else ""


def _check_notes(rows: pd.DataFrame) -> str:
    """What the other people's beams say."""
    if not (rows["group"] == "check").any():
        return "Other people's beams: not in a quick run."
    return (
        "IDA integrates the same semi-discrete equations. Exudyn's cable (`references/exudyn_beam.py`) is a model of its own: Euler "
        "and Bernoulli's beam in absolute coordinates, without shear or stretch of the thickness, 16 elements, whose own error "
        "the tests bound by 1e-4 m. At Poisson's ratio 0 the theories meet for slender sections: the distance is our mesh error and falls with "
        "the elements, down to what shear and rotary inertia make. At Poisson's ratio 0.3 our elements lock: they are near a cable "
        "(λ + 2μ)/E = 1.346 times as stiff, and far from one without that factor. All of the beam moves at the start of these runs."
    )


def _anderson_notes(rows: pd.DataFrame) -> str:
    """What Anderson's acceleration would save."""
    trials = rows[rows["group"] == "anderson"]
    if trials.empty:
        return "Not in a quick run."
    plain = trials[trials["depth"] == 0].set_index(["case", "h"])["sweeps"]
    two = trials[trials["depth"] == 2].set_index(["case", "h"])["sweeps"]
    few = plain[plain <= FEW]
    saved = 1.0 - (two[few.index] / few)
    return (
        f"Median sweeps for one step of Sun's tableau from {STATES} states, by depth; – where most fail. Where sweeps are few (at "
        f"most {FEW}), depth 2 saves {saved.min():.0%} to {saved.max():.0%} of them, and takes memory and a least-squares problem a sweep. It "
        "extends the step limit, but with many sweeps, where Newton's method knows no limit. It is not in the integrator."
    )


def _limit_notes() -> str:
    return (
        "w_max is the largest frequency of the straight beam. Theory: for v' = -w² q, q' = v a sweep that uses all old stages "
        "multiplies changes by h w ρ(A), on accelerations alone by its square: the same limit 1/ρ(A). The paper's uses the latest "
        "stages; its limit is that of the sweep's matrix, and the third column repeats such sweeps on all modes of the linearised "
        "beam with no test at all. “As they are here”: the largest fixed step, by bisection, at which the loops of this project "
        f"converge in each of {LIMIT_STEPS} steps of the linearised beam (tolerance of the outer loop {REDUCED:g} of the velocity "
        "of the start): they are given up after 60 sweeps (the paper's after 200), when changes have grown thousandfold, and the "
        "paper's as soon as changes grow (33). To bring changes down a hundredfold in 60 sweeps takes a rate below 0.93, which on accelerations "
        "alone is 96 % of the limit. The rate is that of the sweeps counted between two tolerances of the outer loop. "
        "Newton's method has no such limit."
    )


def _parting(rows: pd.DataFrame) -> str:
    texts = []
    for case in CASES:
        runs = rows[(rows["group"] == "sensitivity") & (rows["case"] == case) & rows["solver"].isin(PERTURBED[:2])]
        first = runs["t_visible"].min()
        seen = (
            f"is {1e3 * VISIBLE:g} mm at {first:.2f} s for the first time"
            if np.isfinite(first)
            else f"stays below {1e3 * VISIBLE:g} mm"
        )
        texts.append(f"{case}: what a change of E or g by 0.1 % does to the tip {seen}")
    return (
        f"{'; '.join(texts)}. The mesh and the assumed start matter more, from the beginning on. The paper's very flexible results "
        f"agree with those that it compares with until {PARTING:g} s, its moderately stiff ones throughout. Neither can be checked, as "
        "both are lost; but models that differ a little part in this way, whoever integrates them."
    )


def _notes() -> str:
    notes = [
        f"**Tip error**: the largest difference of the tip's height from the reference at {PER_SECOND} instants a second. Two-loop "
        "procedures shorten steps to land on these, others interpolate; the paper's procedure at the paper's tolerance, whose "
        "motion is drawn, lands on ten times as many.",
        "**tol** = rtol = atol; for PaperNewmark err_out, with err_in = 1e-9. PaperIRK has err_in = 1e-9 and err_out = 1e-4 tol, "
        f"which is 1e-9 at the paper's Atol = Rtol = {power(PAPER_TOL)}.",
        f"**{SWEEPS}** and **{BDF}** sweep with this project's tests; “auto” changes between sweeps and Newton's method.",
        f"**{IDA_C_LOOSE}**: the options that let IDA step over vibrations (`references/ida_options.py`). All runs of IDA have "
        "the form stabilised and the exact tangent of the elastic forces.",
        f"**{OWN_EXPLICIT}** has no outer loop: every stage is one evaluation, its dependents restored. Undamped vibrations stay "
        "bounded for h w_max < 5.96.",
        f"**{EXPLICIT}**: SciPy's solver of the same tableau on q'' = a, projected; Python calls it.",
        f"**{PERTURBED[4]}** in the sensitivity figure: the same beam, integrated with a tolerance of {power(LOOSER_TOL)}.",
        f"**Many elements**: fixed steps of {FIXED_STEP:g} s, RadauIIA with Newton's method, very flexible beam; dense, or “banded”: with "
        "the band of the matrices known, which is used where it pays, not yet with 4 and 8 elements; “over the fewest” is in proportion to these.",
        "**Element**: 4 elements are not a converged mesh in the very flexible case, and the element locks (see "
        "`twoloop.mechanisms.ancf_beam`); both belong to the example.",
    ]
    return "\n".join(f"- {note}" for note in notes)
