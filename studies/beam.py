"""The stiff beam of Sect. 4.2: the paper's procedure beside Newton's method as the outer loop, IDA and others."""

from collections.abc import Iterator

import pandas as pd
from rich.console import Console

from studies.beam_anderson import anderson_rows
from studies.beam_checks import check_rows
from studies.beam_figures import figures
from studies.beam_limits import element_rows, limit_rows, modulus_rows, sensitivity, sensitivity_rows
from studies.beam_report import headline, report
from studies.beam_runs import (
    AUTO,
    BDF,
    CASES,
    DIFFERENCES,
    EXPLICIT,
    IDA,
    IDA_C,
    IDA_C_LOOSE,
    IDA_LOOSE,
    NEWMARK,
    NEWTON,
    NEWTON_4,
    NEWTON_5,
    NEWTON_GAUSS,
    OWN_NEWMARK,
    PAPER,
    PAPER_TOL,
    QUARTER,
    SOFT,
    SOLVERS,
    STIFF,
    SWEEPS,
    T_END,
    BeamJob,
    collect,
    compile_all,
    free_motion,
    true_motion,
    truth_rows,
)
from studies.index import put_in_index
from studies.report import Array, Call, load_rows, load_series, parse, save_rows, save_series, stamp
from studies.solvers import OWN_EXPLICIT

T_END_QUICK = 0.1  # s
NEWTON_DRAWN = {SOFT: 1e-3, STIFF: 1e-2}  # tolerance of the motion in the figures, beside the paper's at its own
TOLERANCES: dict[str, dict[str, tuple[float, ...]]] = {
    SOFT: {
        PAPER: (1e-1, 1e-3, 1e-5),
        NEWMARK: (1e-5, 1e-7, 1e-9, 3e-10),
        QUARTER: (1e-5, 1e-7, 1e-9, 3e-10),
        NEWTON: (1e-1, 1e-2, 3e-3, 1e-3, 1e-4, 1e-5, 1e-6),
        NEWTON_4: (1e-1, 1e-2, 3e-3, 1e-3, 1e-4),
        NEWTON_5: (1e-1, 1e-2, 3e-3, 1e-3, 1e-4),
        DIFFERENCES: (1e-2, 3e-3, 1e-3, 1e-4),
        NEWTON_GAUSS: (1e-1, 1e-2, 1e-3, 1e-4, 1e-6),
        AUTO: (1e-1, 1e-2, 1e-3, 1e-4, 1e-6),
        SWEEPS: (1e-1, 1e-2, 1e-4, 1e-6),
        OWN_NEWMARK: (1e-4, 1e-6, 1e-8),
        BDF: (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6),
        OWN_EXPLICIT: (1e-1, 1e-2, 1e-3, 1e-4, 1e-5),
        IDA_C: (1e-3, 1e-4, 3e-5, 1e-5, 1e-6, 1e-7),
        IDA_C_LOOSE: (1e-4, 1e-5, 1e-6, 1e-7, 1e-8),
        IDA: (1e-4, 1e-5),
        IDA_LOOSE: (1e-6,),
        EXPLICIT: (1e-2, 1e-3, 1e-4, 1e-6),
    },
    STIFF: {
        PAPER: (1e-1, 1e-5),
        NEWMARK: (1e-5, 1e-7, 1e-9),
        QUARTER: (1e-5, 1e-7, 1e-9),
        NEWTON: (1e-1, 3e-2, 1e-2, 3e-3, 1e-3),
        NEWTON_4: (1e-1, 3e-2, 1e-2, 3e-3, 1e-3),
        NEWTON_5: (1e-1, 3e-2, 1e-2, 3e-3, 1e-3),
        DIFFERENCES: (1e-1, 3e-2, 1e-2, 3e-3, 1e-3),
        NEWTON_GAUSS: (1e-1, 1e-2, 1e-3),
        AUTO: (1e-1, 1e-2, 1e-3),
        SWEEPS: (1e-1, 1e-2, 1e-4),
        OWN_NEWMARK: (1e-2, 1e-4, 1e-6),
        BDF: (1e-1, 1e-2, 1e-3, 1e-4),
        OWN_EXPLICIT: (1e-1, 1e-2, 1e-3, 1e-4, 1e-5),
        IDA_C: (1e-1, 1e-2, 1e-3, 1e-5),
        IDA_C_LOOSE: (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 3e-8, 1e-8),
        IDA: (1e-3,),
        IDA_LOOSE: (1e-4, 1e-5, 1e-6),
        EXPLICIT: (1e-2, 1e-4),
    },
}
# short runs, of which the median of three counts
SHORT = (NEWTON, NEWTON_4, NEWTON_5, DIFFERENCES, NEWTON_GAUSS, AUTO, OWN_EXPLICIT, IDA_C_LOOSE)
SHORT_SOFT = (PAPER, BDF, SWEEPS, IDA_C)  # in the very flexible case
REPEATS = 3
QUICK = (PAPER, QUARTER, NEWTON, AUTO, SWEEPS, BDF, OWN_EXPLICIT)  # IDA takes seconds to compile


def jobs(quick: bool) -> Iterator[BeamJob]:
    """All runs of the table; those of the paper's procedure at its own tolerance are drawn, too."""
    t_end = T_END_QUICK if quick else T_END
    for case, ladders in TOLERANCES.items():
        for solver, ladder in ladders.items():
            if quick and solver not in QUICK:
                continue
            for tol in ladder[-1:] if quick and solver == PAPER else ladder[:2] if quick else ladder:
                short = solver in SHORT or (case == SOFT and solver in SHORT_SOFT)
                repeats = REPEATS if short and not quick else 1
                yield BeamJob(case, solver, tol, t_end, repeats, drawn=solver == PAPER and tol == PAPER_TOL)


def run(call: Call) -> tuple[pd.DataFrame, dict[str, Array]]:
    """Make all rows, and the curves of the figures."""
    t_end = T_END_QUICK if call.quick else T_END
    say = Console().print
    compile_all(QUICK if call.quick else SOLVERS)
    say("the reference motions")
    truths = {case: true_motion(make(), t_end) for case, make in CASES.items()}
    rows = [*truth_rows(truths)]
    runs, curves = collect(jobs(call.quick), truths)
    rows += runs
    say("step limits, growth with elements and with stiffness")
    rows += [*limit_rows(), *element_rows(call.quick), *modulus_rows(call.quick)]
    say("sensitivity")
    curves["sensitivity"] = sensitivity(call.quick)
    rows += sensitivity_rows(curves["sensitivity"])
    if not call.quick:
        say("other people's beams, Anderson's acceleration")
        rows += [*check_rows(), *anderson_rows()]
    for case, truth in truths.items():
        curves[f"{case}, {NEWTON}"] = free_motion(CASES[case](), NEWTON_DRAWN[case], t_end)
        curves[f"{case}, truth"] = {"t": truth.t, "tip": truth.tip, "middle": truth.middle}
    series: dict[str, Array] = {f"{name}: {kind}": x for name, kinds in curves.items() for kind, x in kinds.items()}
    return pd.DataFrame(rows), series


def main(words: list[str] | None = None, command: str | None = None) -> None:
    """Run the study and write its report."""
    call = parse("beam", __doc__, words, command)
    path = call.out / "beam.csv"
    if call.redraw:
        rows, line = load_rows(path)
        series = load_series(path.with_name("beam_series.npz"))
    else:
        line = stamp(call.command)  # before the runs: sources edited meanwhile are not theirs
        rows, made = run(call)
        save_rows(path, rows, line)
        save_series(path.with_name("beam_series.npz"), made)
        series = load_series(path.with_name("beam_series.npz"))  # of the digits that a redraw has
    report(rows, line, call)
    figures(rows, series, call)
    text = f"[Report](beam.md), [rows](beam.csv)\n\n![Tip error against CPU time](beam_cost.png)\n\n{headline(rows)}"
    put_in_index(call, "beam", __doc__, text, line)
    print(f"wrote beam.md, beam.csv, beam_series.npz and figures to {call.out}")


if __name__ == "__main__":
    main()
