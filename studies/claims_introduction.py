"""The claims of the abstract and of Sections 1 and 2, with their judges."""

import numpy as np

from studies.claims_verdicts import (
    DEFAULT,
    Claim,
    Judgement,
    NoRows,
    Rows,
    cost,
    grade,
    long_enough,
    one,
    pick,
    span,
    value,
)
from studies.report import number
from studies.solvers import IRK, IRK_LINE, NEWMARK, OWN_EXPLICIT, QUARTER

PROJECTED = (("IDA, stabilised", "IDA, index1"), ("DOP853, projected", "DOP853, index 1"))
DEARER = 1.2  # times the cost: beyond the noise of times
REGULAR = 1e-10  # relative: below it an eigenvalue counts as zero
GROWTH = 10.0  # of the violation from the first tenth of a run to its last: it drifts
EXACT = 1e3  # times the violation of the two-loop procedure: not satisfied
SYMPLECTIC = 1e-10
SAME = 1e-10  # relative difference that rounding may make
ORDER = 0.25  # of a measured order about its value
TARGETS = (1e-1, 1e-2, 1e-3, 1e-4)  # m or rad, errors over the run at which costs are compared
TIGHT = 1e-12  # violation that counts as satisfied
STEPS_KEPT = 5.0  # steps a partition must last to be good for several
RARELY = 0.01  # of the steps


def _index(rows: Rows) -> Judgement:
    found = pick(rows, "claims", check="index")
    least = float(found["value"].min())
    text = f"least eigenvalue / largest = {number(least)} over a period, on {len(found)} geometries"
    return Judgement(
        f"≥ {number(least)} of the largest",
        grade(least > REGULAR),
        f"C_q M⁻¹ C_qᵀ: {text}. It is regular where the index is 3.",
    )


def _drift(rows: Rows) -> Judgement:
    runs = long_enough(
        pick(rows, "table3", solver=("DOP853, index 1", "LSODA, index 1", "IDA, index1"), problem=DEFAULT)
    )
    growth = runs["violation_late"] / runs["violation_early"]
    largest = runs["violation_q"]
    why = (
        f"Between the first and the last tenth of the run the violation grows {span(growth)} times in {len(runs)} runs; its "
        f"largest value is {span(largest)} m, the less the tighter the tolerance."
    )
    return Judgement(
        f"grows {span(growth)} ×", grade(bool((growth > GROWTH).all()), bool((growth > GROWTH).any())), why
    )


def _baumgarte(rows: Rows) -> Judgement:
    runs = pick(rows, "violation", group=("line-up", "tolerances"))
    runs = runs[runs["solver"].str.contains("Baumgarte")].reset_index(drop=True)
    theirs = runs["violation_q"]
    ours = float(one(rows, "violation", solver=IRK, group="line-up")["violation_q"])
    exact = theirs <= EXACT * ours
    others = [f"{run['solver']} at {run['tol']:g}" for _, run in runs[exact].iterrows()]
    why = (
        f"Largest violation {span(theirs)} m in {len(theirs)} runs (solvers, α and tolerances), beside {number(ours)} m of PaperIRK; more than "
        f"{EXACT:g} times as much in {int((~exact).sum())} of them. The others: {'; '.join(others) or 'none'}."
    )
    return Judgement(f"{span(theirs)} m", grade(bool((~exact).all()), bool((~exact).any())), why)


def _projection(rows: Rows) -> Judgement:
    runs = {
        name: long_enough(pick(rows, "table3", solver=name, problem=DEFAULT))
        for name in (*sum(PROJECTED, ()), OWN_EXPLICIT, IRK_LINE)
    }
    ratios, parts = [], []
    for with_it, other in (*PROJECTED, ("DOP853, projected", OWN_EXPLICIT), ("DOP853, projected", IRK_LINE)):
        for what in ("n_evaluations", "cpu_s"):
            # counts of different solvers do not compare, nor do times of SciPy's Python and of machine code
            if (other, what) in ((IRK_LINE, "n_evaluations"), (OWN_EXPLICIT, "cpu_s")):
                continue
            found = [cost(runs[with_it], e, what) / cost(runs[other], e, what) for e in TARGETS]
            found = [ratio for ratio in found if not np.isnan(ratio)]
            parts.append(f"{with_it} over {other}, {what}: × {span(found) if found else '–'}")
            ratios += found if other != IRK_LINE else []
    if not ratios:
        raise NoRows("no error is reached both with and without projection")
    dearer = [ratio > DEARER for ratio in ratios]
    why = (
        f"Cost at equal error (of {', '.join(f'{e:g}' for e in TARGETS)} where both reach it): {'; '.join(parts)}. A run without projection has "
        f"to be more accurate for an equal error. {OWN_EXPLICIT} is the same method in state space. So much for this linkage; of large systems the rows say nothing."
    )
    return Judgement(f"cost × {span(ratios)}", grade(all(dearer), any(dearer)), why)


def _explicit(rows: Rows) -> Judgement:
    found = pick(rows, "claims", check="explicit tableaux")
    diagonal = found[found["case"].str.endswith("diagonal entry of the defect")]["value"]
    is_explicit = found[found["case"].str.endswith("above or on the diagonal")]["value"]
    why = (
        f"On the diagonal of b_i a_ij + b_j a_ji − b_i b_j stands −b_i², since a_ii = 0; its largest magnitude is {span(diagonal)} "
        f"in {len(diagonal)} methods. All weights would have to vanish, and they add up to 1."
    )
    return Judgement(
        f"defect ≥ {number(diagonal.min())}", grade(bool((diagonal > 1e-3).all() and (is_explicit == 0.0).all())), why
    )


def _newmark_symplectic(rows: Rows) -> Judgement:
    found = pick(rows, "claims", check="Newmark's map")
    symplectic = found["value"] < SYMPLECTIC
    cases = found["case"].str.removesuffix(": |det - 1|")
    why = (
        f"Symplectic in (q, v): {'; '.join(cases[symplectic]) or 'none'}. Not: {'; '.join(cases[~symplectic]) or 'none'} "
        f"(|det − 1| {span(found['value'][~symplectic]) if (~symplectic).any() else '–'} at h = 0.2). The paper does not name "
        "its circumstances; its β = γ = 1/2 is the third of the cases run. With γ = 1/2 any β is symplectic in changed variables (for M = 1: q − β h² a(q) moves by "
        "the scheme of Störmer and Verlet), so its energy need not drift either."
    )
    return Judgement(
        f"{int(symplectic.sum())} of {len(found)} (β, γ)", grade(bool(symplectic.any() and not symplectic.all())), why
    )


def measured_order(rows: Rows, case: str) -> float:
    """Slope of the error at 1 s between two fixed steps."""
    runs = pick(rows, "claims", check="fixed steps to 1 s", case=case, problem=DEFAULT).sort_values("setting")
    error, h = runs["value"].to_numpy(), runs["setting"].to_numpy()
    return float(np.log(error[-1] / error[0]) / np.log(h[-1] / h[0]))


def _newmark_order(rows: Rows) -> Judgement:
    expected = {"beta = 0.5, gamma = 0.5": 2, "beta = 0.25, gamma = 0.5": 2, "beta = 0.25, gamma = 0.6": 1}
    found = {case: measured_order(rows, f"Newmark {case}") for case in expected}
    runs = pick(rows, "motion", solver="Exudyn, HHT", group="Exudyn").sort_values("h")
    if len(runs) > 1:
        error, h = runs["error_y3_short"].to_numpy(), runs["h"].to_numpy()
        expected["HHT of Exudyn"], found["HHT of Exudyn"] = (
            2,
            float(np.log(error[-1] / error[0]) / np.log(h[-1] / h[0])),
        )
    text = "; ".join(f"{case}: {order:.2f}" for case, order in found.items())
    met = all(abs(found[case] - expected[case]) < ORDER for case in expected)
    return Judgement(
        f"orders {', '.join(f'{order:.2f}' for order in found.values())}", grade(met), f"Measured: {text}."
    )


def _gamma(rows: Rows) -> Judgement:
    right, wrong = (
        value(rows, "(5)", f"{case}: largest error of C'' = C_q a - Q_d", None)
        for case in ("as printed", "opposite sign")
    )
    why = f"Along a given path the printed Q_d is wrong by {number(right)} (the differences' own error), the negative by {number(wrong)}."
    return Judgement(f"error {number(right)}", grade(right < 1e-6 < wrong), why)


def _formulas(rows: Rows, *cases: str) -> Judgement:
    found = pick(
        rows,
        "claims",
        check="(6)-(15)",
        case=tuple(f"{case}: relative difference from the direct solution" for case in cases),
    )
    worst = float(found["value"].max())
    return Judgement(
        f"difference {number(worst)}",
        grade(worst < SAME),
        f"Largest relative difference, on every geometry of the rows: {number(worst)}.",
    )


def _counts(rows: Rows) -> Judgement:
    rank, n_q, n_c = (value(rows, "sizes", case) for case in ("least rank of C_q", "n_q", "n_c"))
    missing = (3 * n_q + n_c) - (n_q + 3 * n_c)
    why = f"Rank of C_q over a period: {rank:g}; {3 * n_q + n_c:g} unknowns, {n_q + 3 * n_c:g} equations, {missing:g} missing, 2 n_DOF = {2 * (n_q - rank):g}."
    return Judgement(f"{missing:g} = 2 × {n_q - rank:g}", grade(rank == n_c and missing == 2 * (n_q - rank)), why)


def _levels(rows: Rows) -> Judgement:
    run = one(rows, "violation", solver=IRK, group="line-up")
    worst = [float(run[f"violation_{level}"]) for level in "qva"]
    cells = pick(rows, "table3", group="Table 3: IRK", problem=DEFAULT)
    by_err_in = cells.groupby("err_in")["violation_q"].max()
    good = by_err_in[by_err_in < TIGHT]
    met = max(worst) < TIGHT
    why = (
        f"At err_in = 1e-9 the largest violations of the three levels are {', '.join(number(w) for w in worst)} (m, m/s, m/s²). "
        f"Positions over err_in, at the worst err_out: {'; '.join(f'{e:.0e}: {number(x)} m' for e, x in by_err_in.items())}. What "
        "err_in leaves goes as the square of the last correction; it is below "
        f"{TIGHT:g} m for err_in = {', '.join(f'{e:.0e}' for e in good.index) or 'none'}."
    )
    return Judgement(
        f"{number(worst[0])} m at err_in 1e-9, {number(by_err_in.max())} m at {by_err_in.idxmax():.0e}",
        grade(met and len(good) == len(by_err_in), met),
        why,
    )


def _coordinates(rows: Rows) -> Judgement:
    used = {
        name: value(rows, "independent coordinates", f"{name}: coordinates in one of them")
        for name in ("LU", "SVD", "QR")
    }
    why = (
        f"Coordinates that make up one independent one: {', '.join(f'{name} {n:g}' for name, n in used.items())}. QR here is the "
        "orthogonal complement of the rows of C_q; QR with column pivoting would pick coordinates as LU does."
    )
    numbers = ", ".join(f"{n:g}" for n in used.values())
    return Judgement(f"{numbers} coordinates", grade(used["LU"] == 1 and used["SVD"] > 1 and used["QR"] > 1), why)


def _lasting(rows: Rows) -> Judgement:
    runs = pick(rows, "table3", solver=(IRK, NEWMARK), err_in=1e-9, err_out=1e-9)
    kept = runs["n_steps"] / runs["n_partitions"]
    lost = value(rows, "independent coordinates", "first choice becomes singular, times a period")
    why = (
        f"Steps a partition lasted: {span(kept)} in {len(runs)} runs on {runs['problem'].nunique()} geometries. The partition of the "
        f"start alone would not do: it becomes singular {lost:g} times a period, so it has to be looked at as the motion goes."
    )
    return Judgement(f"{span(kept)} steps", grade(bool((kept >= STEPS_KEPT).all())), why)


def _sweeps(rows: Rows) -> Judgement:
    runs = pick(rows, "step_size", solver=(NEWMARK, QUARTER), group="paper")
    failed, sweeps = runs["n_rejected_convergence"] / runs["n_steps"], runs["n_outer"] / runs["n_steps"]
    why = f"{span(sweeps)} sweeps a step; {span(failed)} of the steps did not converge, in {len(runs)} runs (β = 1/2 and 1/4)."
    return Judgement(
        f"{span(sweeps)} sweeps", grade(bool((failed < RARELY).all() and (runs["status"] == "REACHED_END").all())), why
    )


def _beta(rows: Rows) -> Judgement:
    half, quarter = (
        float(
            one(rows, "claims", check="fixed steps to 1 s", case=f"Newmark beta = {beta}, gamma = 0.5", setting=1e-3)[
                "value"
            ]
        )
        for beta in ("0.5", "0.25")
    )
    steps = [float(one(rows, "step_size", solver=solver)["n_steps"]) for solver in (NEWMARK, QUARTER)]
    order = measured_order(rows, "Newmark beta = 0.5, gamma = 0.5")
    ratio = half / quarter
    why = (
        f"β = 1/2 is of order {order:.2f} too, but its error at equal steps is {ratio:.2f} times that of β = 1/4, the average "
        f"acceleration (theory for a step: |1/2 − 1/6| / |1/4 − 1/6| = 4 in positions, 1 in velocities), and it takes {steps[0] / steps[1]:.2f} times the steps for "
        f"an equal err_out (theory: 4^(1/3) = 1.59). Costs are compared with both below."
    )
    fair = ratio <= 1.1
    return Judgement(
        f"error × {ratio:.2f}, steps × {steps[0] / steps[1]:.2f}", grade(fair, abs(order - 2.0) < ORDER), why
    )


TABLE3 = ("cpu_s", "n_evaluations", "error_q")
VALUE = ("check", "case", "value")

CLAIMS = (
    Claim(
        "1",
        "The equations of a multibody system with nonlinear holonomic constraints are usually of index 3.",
        "C_q M⁻¹ C_qᵀ along the true motion of each geometry.",
        {"claims": ("check = index", VALUE)},
        f"Holds if the least eigenvalue is above {REGULAR:g} of the largest at every instant.",
        _index,
    ),
    Claim(
        "1, 2.1",
        "Methods for ordinary differential equations let the constraints be violated when the index is reduced and nothing else done.",
        "SciPy's DOP853 and LSODA, and IDA, on the index-1 equations over 100 s at several tolerances.",
        {"table3": ("solver ends in 'index 1' or 'index1'", ("violation_early", "violation_late", "violation_q"))},
        f"Holds if in every run the violation of the last tenth is more than {GROWTH:g} times that of the first; with conditions if in some.",
        _drift,
        assumed=True,
    ),
    Claim(
        "1",
        "Baumgarte's stabilisation does not satisfy the constraints exactly.",
        "DOP853 and LSODA with Baumgarte's terms at several α and tolerances.",
        {
            "violation": (
                "group = line-up, tolerances; solver contains Baumgarte; PaperIRK of line-up",
                ("violation_q",),
            )
        },
        f"Holds if the largest violation of every run is more than {EXACT:g} times PaperIRK's; with conditions if of some.",
        _baumgarte,
        assumed=True,
    ),
    Claim(
        "1",
        "Projection, with further multipliers to enforce positions and velocities, is inefficient.",
        "IDA with the stabilised (GGL) form against index 1, and DOP853 with projection against DOP853 without, and against DOP853 in the two loops.",
        {
            "table3": (
                f"solver = one of the four, {OWN_EXPLICIT}, or PaperIRK, Atol = Rtol varied; default geometry",
                TABLE3,
            )
        },
        f"Cost at equal error, evaluations and CPU time. Holds if projection costs more than {DEARER:g} times as much at every error compared, with "
        "conditions if at some.",
        _projection,
        assumed=True,
    ),
    Claim(
        "1, 3.1",
        "No explicit Runge–Kutta method is symplectic.",
        "b_i a_ij + b_j a_ji − b_i b_j of five explicit tableaux.",
        {"claims": ("check = explicit tableaux", VALUE)},
        "Holds if every tableau is zero on and above its diagonal and the defect's diagonal is not zero (> 1e-3).",
        _explicit,
    ),
    Claim(
        "1",
        "Newmark's method is symplectic under certain circumstances.",
        "Determinant of one step as a map of (q, v) for a pendulum, by differences.",
        {"claims": ("check = Newmark's map", VALUE)},
        f"Holds if |det − 1| < {SYMPLECTIC:g} for some of the parameters run and not for all.",
        _newmark_symplectic,
    ),
    Claim(
        "1",
        "The Newmark and HHT methods are of order 2 or 1.",
        "Newmark with fixed steps of 2 and 1 ms to 1 s, and Exudyn's HHT over 2 s at several steps, against the true motion.",
        {
            "claims": ("check = fixed steps to 1 s; case begins with Newmark", (*VALUE, "setting")),
            "motion": ("group = Exudyn; solver = Exudyn, HHT", ("h", "error_y3_short")),
        },
        f"Holds if the measured order is within {ORDER:g} of 2 for γ = 1/2 and HHT, and of 1 for γ = 0.6.",
        _newmark_order,
    ),
    Claim(
        "2.1",
        "(5): C_q q̈ = Q_d with the printed Q_d and its sign.",
        "C differenced twice along a given path, with a constraint that depends on time.",
        {"claims": ("check = (5)", VALUE)},
        "Holds if the error is below 1e-6, and that of the opposite sign above.",
        _gamma,
    ),
    Claim(
        "2.2",
        "(7), (8): closed formulas for the multipliers and the accelerations.",
        "Both against the whole system (6), solved directly, along the true motion.",
        {"claims": ("check = (6)-(15); case begins with 'lam by (7)' or 'a by (8)'", VALUE)},
        f"Holds if the relative difference stays below {SAME:g}.",
        lambda rows: _formulas(rows, "lam by (7)", "a by (8)"),
    ),
    Claim(
        "2.2",
        "The four levels of equations leave 2 n_DOF unknowns to the integration method.",
        "Sizes and the rank of C_q along the true motion.",
        {"claims": ("check = sizes", VALUE)},
        "Holds if C_q has rank n_c and the equations are 2 (n_q − rank) too few.",
        _counts,
    ),
    Claim(
        "1, 2.2, 5",
        "State-space methods satisfy the constraints strictly, on the levels of position, velocity and acceleration at once.",
        "PaperIRK at the paper's settings; Table 3 for other err_in.",
        {
            "violation": ("group = line-up; solver = PaperIRK", ("violation_q", "violation_v", "violation_a")),
            "table3": ("group = Table 3: IRK, default geometry", ("err_in", "violation_q")),
        },
        f"Holds if all three are below {TIGHT:g} at err_in = 1e-9 and positions also at every other err_in; with conditions if only at 1e-9. "
        "The acceleration is solved from (6) at every step, so its level is no achievement.",
        _levels,
        assumed=True,
    ),
    Claim(
        "2.2",
        "LU decomposition picks original coordinates; those of QR and SVD are linear combinations.",
        "The three decompositions of C_q at the start.",
        {"claims": ("check = independent coordinates; case = LU, SVD, QR", VALUE)},
        "Holds if an independent coordinate is made of one coordinate with LU and of more with QR and SVD.",
        _coordinates,
        assumed=True,
    ),
    Claim(
        "2.3",
        "The partition may be made once in several steps.",
        "PaperIRK and PaperNewmark, which look at the partition after every step and renew it when it is worn.",
        {
            "table3": (
                "solver = PaperIRK, PaperNewmark (beta = 1/2); err_in = err_out = 1e-9",
                ("n_steps", "n_partitions"),
            ),
            "claims": ("check = independent coordinates; case = first choice …", VALUE),
        },
        f"Holds if in every run a partition lasts {STEPS_KEPT:g} steps or more on average.",
        _lasting,
        assumed=True,
    ),
    Claim(
        "2.3",
        "Newmark's equations can be solved by fixed-point sweeps on the accelerations alone.",
        "PaperNewmark with β = 1/2 and 1/4 at err_in = err_out = 1e-9.",
        {
            "step_size": (
                "group = paper; solver begins with PaperNewmark",
                ("n_outer", "n_steps", "n_rejected_convergence", "status"),
            )
        },
        f"Holds if all runs reach their end and fewer than {RARELY:.0%} of the steps fail to converge.",
        _sweeps,
        assumed=True,
    ),
    Claim(
        "2.3, 4.1",
        "(12) with β = γ = 1/2 stands for Newmark's method in the comparison (not said, but done).",
        "Newmark with fixed steps of 1 ms to 1 s, and PaperNewmark at err_out = 1e-9, with β = 1/2 and β = 1/4.",
        {
            "claims": ("check = fixed steps to 1 s; case begins with Newmark", (*VALUE, "setting")),
            "step_size": ("group = paper; solver begins with PaperNewmark", ("n_steps",)),
        },
        "Holds if its error is at most 1.1 times that of β = 1/4 at equal steps; with conditions if it is larger but of order 2.",
        _beta,
        assumed=True,
    ),
    Claim(
        "2.3, 3.2",
        "(14), (15): velocities and corrections of the positions without rearranging coordinates.",
        "Both against the partitioned systems, solved directly, along the true motion.",
        {"claims": ("check = (6)-(15); case begins with 'v by (14)' or 'dq by (15)'", VALUE)},
        f"Holds if the relative difference stays below {SAME:g}.",
        lambda rows: _formulas(rows, "v by (14)", "dq by (15)"),
    ),
)
