"""The claims of Table 3 and of efficiency, with their judges."""

from itertools import pairwise

import numpy as np

from studies.claims_four_bar import PASSES
from studies.claims_verdicts import (
    DEFAULT,
    Claim,
    Judgement,
    NoRows,
    Rows,
    cell,
    cost,
    grade,
    long_enough,
    not_run,
    pick,
    span,
)
from studies.report import number
from studies.runs import ASTRAY, LOST
from studies.solvers import IRK, IRK_LINE, NEWMARK, QUARTER
from studies.table3_causes import FAMILIES, PAPER_IRK, PAPER_NEWMARK, TOLERANCES

IRK_GROUP, NEWMARK_GROUP = FAMILIES
LAST = TOLERANCES[-1]
PRINTED_RATIO = PAPER_NEWMARK[3][3] / PAPER_IRK[3][3]  # type: ignore[operator]
NEAR = 1.5  # factor within which a ratio counts as the printed one
MAIN = 2.0  # times a logarithm must exceed another for its tolerance to be the main influence
SHARES = (0.3, 0.1, 0.03, 0.01)  # m or rad: errors over the run at which the procedures are compared
CELLS = ("err_in", "err_out", "cpu_s", "n_evaluations")


def _influence(rows: Rows, group: str, what: str, coarsest: float) -> tuple[float, float]:
    """Mean factors in `what` from `coarsest` to 1e-9: of err_in at every err_out from there on, and the reverse."""
    out = [e for e in TOLERANCES if e <= coarsest]
    by_in = [cell(rows, group, LAST, e)[what] / cell(rows, group, coarsest, e)[what] for e in out]
    by_out = [cell(rows, group, e, LAST)[what] / cell(rows, group, e, coarsest)[what] for e in out]
    return float(np.exp(np.log(by_in).mean())), float(np.exp(np.log(by_out).mean()))


def _newmark_time(rows: Rows) -> Judgement:
    long_enough(pick(rows, "table3", group=NEWMARK_GROUP, problem=DEFAULT))
    found = {what: _influence(rows, NEWMARK_GROUP, what, 1e-5) for what in ("cpu_s", "n_evaluations")}
    met = [np.log(by_out) > MAIN * abs(np.log(by_in)) for by_in, by_out in found.values()]
    evaluations = [cell(rows, NEWMARK_GROUP, LAST, e)["n_evaluations"] for e in TOLERANCES[1:]]
    decades = [b / a for a, b in pairwise(evaluations)]
    paper = [b / a for a, b in pairwise(PAPER_NEWMARK[3][1:])]  # type: ignore[operator]
    why = (
        f"From 1e-5 to 1e-9, means over the cells: err_out changes time by × {found['cpu_s'][1]:.2f} and evaluations by × "
        f"{found['n_evaluations'][1]:.2f}, err_in by × {found['cpu_s'][0]:.2f} and × {found['n_evaluations'][0]:.2f}. Evaluations for two "
        f"decades of err_out: × {span(decades)} (paper, time: × {span(paper)}). So err_out is read as the "
        "tolerance of the step's error; the paper does not say."
    )
    return Judgement(
        f"time × {found['cpu_s'][1]:.1f} by err_out, × {found['cpu_s'][0]:.2f} by err_in",
        grade(all(met), any(met)),
        why,
    )


def _irk_time(rows: Rows) -> Judgement:
    long_enough(pick(rows, "table3", group=IRK_GROUP, problem=DEFAULT))
    found = {what: _influence(rows, IRK_GROUP, what, 1e-3) for what in ("cpu_s", "n_evaluations", "n_inner")}
    fine = _influence(rows, IRK_GROUP, "cpu_s", 1e-5)
    met = {what: np.log(by_in) > MAIN * abs(np.log(by_out)) for what, (by_in, by_out) in found.items()}
    texts = [f"{what} × {by_in:.2f} by err_in, × {by_out:.2f} by err_out" for what, (by_in, by_out) in found.items()]
    said = (
        ""
        if met["cpu_s"]
        else "In time it is not reproduced here, in inner iterations alone. "
        if met["n_inner"]
        else "It is not reproduced here. "
    )
    why = (
        f"{said}From 1e-3 to 1e-9, means over the cells: {'; '.join(texts)}; from 1e-5, where the outer loop no longer disturbs the error estimate, time × "
        f"{fine[0]:.2f} and × {fine[1]:.2f}. The paper's time at the other tolerance 1e-9: × {PAPER_IRK[3][3] / PAPER_IRK[0][3]:.2f} and × {PAPER_IRK[3][3] / PAPER_IRK[3][0]:.2f}. Its growth with err_in is "
        "that of the inner iterations, as if they made up its cost; here an evaluation weighs more, and (32) asks more sweeps for a smaller err_out."
    )
    return Judgement(
        "; ".join(
            f"{name} × {found[what][0]:.2f} by err_in, × {found[what][1]:.2f} by err_out"
            for name, what in (("time", "cpu_s"), ("inner", "n_inner"))
        ),
        grade(bool(met["cpu_s"]), bool(met["n_inner"])),
        why,
    )


def _newmark_star(rows: Rows) -> Judgement:
    cells = long_enough(pick(rows, "table3", group=NEWMARK_GROUP, problem=DEFAULT))
    coarse, fine = cells[cells["err_out"] == 1e-3], cells[cells["err_out"] < 1e-3]
    other = long_enough(pick(rows, "table3", group=NEWMARK_GROUP))
    other = other[(other["problem"] != DEFAULT) & (other["err_out"] == 1e-3)]
    astray = sorted(fine[fine["astray"]]["err_out"].unique(), reverse=True)
    why = (
        f"Lost in {int(coarse['lost'].sum())} of {len(coarse)} cells with err_out = 1e-3 (energy error {span(coarse['energy'])} J of "
        f"{coarse['kinetic'].iloc[0]:.3g} J) and in {int(fine['lost'].sum())} of {len(fine)} others. On the second geometry at 1e-3: lost in "
        f"{int(other['lost'].sum())} of {len(other)}. Out of phase, by more than {ASTRAY:.0%} of the range of y3, also at err_out = "
        f"{', '.join(f'{e:.0e}' for e in astray) or 'none'}, which the paper's criterion, the line y3 = 0, does not show."
    )
    met = bool(coarse["lost"].all() and not fine["lost"].any())
    number_ = f"lost: {int(coarse['lost'].sum())} of {len(coarse)}, {int(fine['lost'].sum())} of {len(fine)}"
    return Judgement(number_, grade(met and not fine["astray"].any(), met), why)


def _irk_star(rows: Rows) -> Judgement:
    cells = long_enough(pick(rows, "table3", group=IRK_GROUP, problem=DEFAULT, err_out=1e-3))
    kept, follows = not cells["lost"].any(), not cells["astray"].any()
    why = (
        f"Not lost: the energy error, {span(cells['energy'])} J, is {(cells['energy'].abs() / cells['kinetic']).max():.1%} of the kinetic energy. "
        f"But out of phase in {int(cells['astray'].sum())} of {len(cells)} cells (error up to {number(cells['error_q'].max())} m or rad), and y3 "
        f"passes 0 by up to {number(1e3 * cells['y3_max'].max())} mm. Reasonable as to energy, not as to the motion."
    )
    return Judgement(
        f"energy off by {span(cells['energy'])} J",
        grade(kept and follows and bool((cells["y3_max"] < PASSES).all()), kept),
        why,
    )


def _ratio(rows: Rows) -> Judgement:
    parts, ratios = [], {}
    for problem in dict.fromkeys(pick(rows, "table3", group=IRK_GROUP)["problem"]):
        slow, fast = cell(rows, NEWMARK_GROUP, LAST, LAST, problem), cell(rows, IRK_GROUP, LAST, LAST, problem)
        time, evaluations = slow["cpu_s"] / fast["cpu_s"], slow["n_evaluations"] / fast["n_evaluations"]
        ratios[problem] = (time, evaluations)
        parts.append(
            f"{problem}: × {time:.1f} in time, × {evaluations:.1f} in evaluations (errors {number(slow['error_q'])} and {number(fast['error_q'])})"
        )
    long_enough(pick(rows, "table3", group=IRK_GROUP))
    both = [ratio for pair in ratios.values() for ratio in pair]
    time, evaluations = ratios[DEFAULT]
    why = f"{'; '.join(parts)}; printed: × {PRINTED_RATIO:.1f}. Newmark with β = 1/2; at equal error see the next row."
    met = all(ratio >= PRINTED_RATIO / NEAR for ratio in both)
    return Judgement(f"× {time:.1f} in time, × {evaluations:.1f} in evaluations", grade(met, min(both) > 1.0), why)


def _equal_error(rows: Rows) -> Judgement:
    parts, ratios = [], []
    for problem in dict.fromkeys(pick(rows, "table3", solver=IRK_LINE)["problem"]):
        runs = long_enough(pick(rows, "table3", problem=problem))
        fast = runs[runs["solver"] == IRK_LINE]
        for solver in (NEWMARK, QUARTER):
            slow = runs[(runs["solver"] == solver) & (runs["err_in"] == LAST)]
            for what in ("cpu_s", "n_evaluations"):
                found = [cost(slow, e, what) / cost(fast, e, what) for e in SHARES]
                found = [ratio for ratio in found if not np.isnan(ratio)]
                ratios += found
                parts.append(f"{solver}, {what}, {problem}: × {span(found) if found else '–'}")
    if not ratios:
        raise NoRows("no error is reached by both procedures")
    why = f"Cost of Newmark over that of PaperIRK at errors of {', '.join(f'{e:g}' for e in SHARES)}, where both reach them: {'; '.join(parts)}."
    return Judgement(f"cost × {span(ratios)}", grade(min(ratios) > 1.0, max(ratios) > 1.0), why)


def _constraints(rows: Rows) -> Judgement:
    runs = pick(rows, "table3", solver=(IRK, NEWMARK))
    reached = runs["status"] == "REACHED_END"
    inner = runs["n_inner"] / runs["n_evaluations"]
    why = f"{int(reached.sum())} of {len(runs)} runs of both procedures on {runs['problem'].nunique()} geometries reach their end, with {span(inner)} iterations of the inner loop an evaluation."
    return Judgement(f"{int(reached.sum())} of {len(runs)} runs", grade(bool(reached.all())), why)


CLAIMS = (
    Claim(
        "4.1",
        "err_out governs the time of Newmark's procedure, err_in hardly matters.",
        "Table 3, the columns and rows from 1e-5 on (1e-3 loses the solution).",
        {"table3": ("group = Table 3: Newmark, default geometry", CELLS)},
        f"Logarithms of the mean factors from 1e-5 to 1e-9. Holds if err_out's is more than {MAIN:g} times err_in's, in time and in evaluations.",
        _newmark_time,
        assumed=True,
    ),
    Claim(
        "4.1",
        "err_in is the main influence on the time of the new procedure.",
        "Table 3.",
        {"table3": ("group = Table 3: IRK, default geometry", (*CELLS, "n_inner"))},
        f"Logarithms of the mean factors from 1e-3 to 1e-9. Holds if err_in's is more than {MAIN:g} times err_out's in time; with conditions if it is so "
        "in inner iterations only.",
        _irk_time,
        assumed=True,
    ),
    Claim(
        "4.1",
        "With err_out = 1e-3 Newmark gives no reasonable long-time result, with smaller ones it does.",
        "Table 3.",
        {"table3": ("group = Table 3: Newmark", ("err_out", "lost", "astray", "energy", "kinetic", "t_end"))},
        f"Holds if all cells with 1e-3 are lost (energy error above {LOST:.0%} of the kinetic energy) and no other, and the others are in phase; with conditions if they are not.",
        _newmark_star,
        assumed=True,
    ),
    Claim(
        "4.1",
        "With err_out = 1e-3 the new procedure still gives a reasonable long-time result.",
        "Table 3.",
        {
            "table3": (
                "group = Table 3: IRK; err_out = 1e-3",
                ("lost", "astray", "energy", "kinetic", "y3_max", "error_q"),
            )
        },
        f"Holds if no such cell is lost or out of phase and y3 stays below {PASSES:g} m; with conditions if none is lost.",
        _irk_star,
        assumed=True,
    ),
    Claim(
        "4.1",
        "At err_in = err_out = 1e-9 the new procedure is 14 times as fast as Newmark's (3.60 s against 50.93 s).",
        "Table 3, both geometries.",
        {"table3": ("err_in = err_out = 1e-9; both groups", ("cpu_s", "n_evaluations", "error_q", "t_end"))},
        f"Holds if all ratios, in time and evaluations, reach {PRINTED_RATIO:.1f} / {NEAR:g}; with conditions (faster, by less) if all exceed 1.",
        _ratio,
        assumed=True,
    ),
    Claim(
        "abstract, 1, 5",
        "The new procedure is more efficient than the two-loop procedure with Newmark's method.",
        "PaperIRK over Atol = Rtol, PaperNewmark over err_out with β = 1/2 and 1/4, at equal error, both geometries.",
        {"table3": ("solver = the three; err_in = 1e-9 or none", ("cpu_s", "n_evaluations", "error_q", "t_end"))},
        "Holds if Newmark costs more at every error that both reach, in time and in evaluations; with conditions if at some.",
        _equal_error,
        assumed=True,
    ),
    Claim(
        "4.1",
        "Table 3: the computation times in seconds.",
        "Nothing.",
        {},
        "Needs a run of the paper's code on its computer.",
        not_run(
            "the paper names neither its computer nor its language, and its code is not public. Ratios are judged above."
        ),
    ),
    Claim(
        "4.1",
        "The procedure handles the constraints of a closed chain: one independent coordinate, eight dependent ones.",
        "All cells of Table 3 on both geometries.",
        {"table3": ("solver = PaperIRK, PaperNewmark (beta = 1/2)", ("status", "n_inner", "n_evaluations"))},
        "Holds if all runs reach their end.",
        _constraints,
        assumed=True,
    ),
)
