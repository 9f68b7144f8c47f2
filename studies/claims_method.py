"""The claims of Section 3, the new procedure and its equations, with their judges."""

import numpy as np
import pandas as pd

from studies.claims_introduction import ORDER, SYMPLECTIC, VALUE, measured_order
from studies.claims_verdicts import DEFAULT, Claim, Judgement, NoRows, Rows, grade, one, pick, span, value
from studies.energy_drift import EPS, GAUSS, ONE, PAPER_IRK, RESOLVED, SUN
from studies.report import number
from studies.solvers import IRK

ROUNDING = 1e-14  # defect of an order condition
NOT_SYMPLECTIC = 1e-6  # of a determinant from 1
LONG_RUN = 1000.0  # s, the least length of a run that tells of drift
ENERGY = ("slope", "slope_error", "t_end", "n_steps", "kinetic", "status")
SPREAD = 2.0  # between the largest and the least h omega: the step goes with 1 / omega
FACTOR_2 = 2.0
NEEDLESS = 0.1  # share of the steps given up


def _table1(rows: Rows) -> Judgement:
    defect, sixth, symplectic = (
        value(rows, "Table 1", f"restored: {case}", None)
        for case in ("worst of B(5), C(2), D(2)", "B(6)", "b_i a_ij + b_j a_ji - b_i b_j")
    )
    lost = value(rows, "Table 1", "lost entries zero: worst of B(5), C(2), D(2)", None)
    difference = value(rows, "Table 1", "difference of twoloop's tableau from it", None)
    why = (
        f"B(5), C(2), D(2), which imply order 5, hold to {number(defect)}, the symplectic condition to {number(symplectic)}; B(6) "
        f"fails by {number(sixth)}, so the order is not 6. The text at hand lost b_3, c_3 and a_33; Σb = 1, symplecticity and the row "
        f"sums give 1/9, 1 and 1/18 (without them the conditions fail by {number(lost)}). twoloop's tableau differs by {number(difference)}."
    )
    return Judgement(f"defect {number(defect)}", grade(max(defect, symplectic) < ROUNDING and sixth > 1e-6), why)


def _order(rows: Rows) -> Judgement:
    order = measured_order(rows, "Sun")
    return Judgement(
        f"order {order:.2f}",
        grade(order > 5.0 - ORDER),
        f"Error at 1 s with h = 0.02 and 0.01 s: order {order:.2f}. Above 5 is no contradiction: Sun's "
        "method is conjugate to one of order 6 (`tests/test_tableaux.py`), so its error of order h^5 comes and goes with the motion and does not add up.",
    )


def _map(rows: Rows) -> Judgement:
    velocities, momenta = (
        value(rows, "one step as a map", f"on {name}: |det - 1| in (q_i, p_i)") for name in ("velocities", "momenta")
    )
    why = (
        f"In canonical variables |det − 1| of a step of 0.1 s is up to {number(velocities)} for the procedure on (q_i, q̇_i), and "
        f'{number(momenta)} if it iterates momenta (`variables="momenta"`). (q_i, q̇_i) are not canonical: the reduced mass depends '
        "on q_i."
    )
    in_part = momenta < SYMPLECTIC < velocities < NOT_SYMPLECTIC
    return Judgement(f"det off by {number(velocities)}", grade(velocities < SYMPLECTIC, in_part), why)


def drifts(run: pd.Series) -> bool:
    """Whether the mean energy error of a run has a slope that neither scatter nor rounding explains."""
    change = abs(run["slope"]) * run["t_end"]
    if run["status"] != "REACHED_END":
        return True
    return bool(abs(run["slope"]) > RESOLVED * run["slope_error"] and change > EPS * run["kinetic"] * run["n_steps"])


def _stable(rows: Rows) -> Judgement:
    runs = pick(rows, "energy", solver=(SUN, PAPER_IRK, GAUSS))
    runs = runs[runs["t_end"] == runs["t_end"].max()]
    if runs["t_end"].max() < LONG_RUN:
        raise NoRows(
            f"quick run: it covers {runs['t_end'].max():g} s, and drift is looked for over {LONG_RUN:g} s or more"
        )
    runs = runs.assign(drifts=[drifts(run) for _, run in runs.iterrows()])
    own = runs[(runs["variables"] == "velocities") & (runs["partition"] == "lasting") & (runs["solver"] != GAUSS)]
    calm = runs[~runs["drifts"]]
    # one partition and fixed steps in canonical variables: where a symplectic tableau makes a symplectic map
    maps = runs[
        (runs["variables"] == "momenta")
        & (runs["partition"] == "lasting")
        & (runs["geometry"] == ONE)
        & runs["h"].notna()
        & (runs["solver"] == SUN)
    ]
    names = [
        f"{run['solver']} on {run['variables']}, {run['partition']} partition, {run['geometry']}, "
        + ("variable steps" if pd.isna(run["h"]) else f"h = {run['h']:g} s")
        for _, run in calm.iterrows()
    ]
    change = (own["slope"] * own["t_end"]).abs()
    why = (
        f"The energy drifts in {int(own['drifts'].sum())} of {len(own)} runs of Sun's method on (q_i, q̇_i), by {span(change)} J over "
        f"{own['t_end'].iloc[0]:g} s (kinetic energy up to {span(own['kinetic'])} J), with fixed steps and with variable ones. No "
        f"drift: {'; '.join(names) or 'nowhere'}."
    )
    holds = not own["drifts"].any()
    if not holds:
        why += (
            " A symplectic tableau is not enough. For a symplectic map it takes canonical variables, fixed steps and one partition, too; where Gauss(3) does "
            "without them, its symmetry helps, not its being symplectic (`energy.md`). What is stable over 100 s is a small error."
        )
    in_part = bool(len(maps) and not maps["drifts"].any())
    return Judgement(f"{int(own['drifts'].sum())} of {len(own)} drift", grade(holds, in_part), why)


def _reduction(rows: Rows) -> Judgement:
    given, stages, after = (
        value(rows, "(18)", case)
        for case in ("difference of the given sums b K", "difference of the stages", "difference of the next y")
    )
    why = (
        f"Two sets of stages that give the same y_n+1 (to {number(given)}) and differ by up to {number(stages)} give next iterates that "
        f"differ by {number(after)}. The sweep is a map of the s stages K_i, 2 s n unknowns; y_n+1 alone does not determine them for s > 1. The algorithm printed below (18) carries the K_i from sweep to sweep, and works."
    )
    return Judgement(f"next y differ by {number(after)}", grade(after < 1e3 * max(given, EPS)), why)


def _jacobian(rows: Rows) -> Judgement:
    case = "Q_d given: "
    calls = {
        name: value(rows, "values alone", f"{case}calls of {name} an evaluation") for name in ("mass", "force", "gamma")
    }
    reached = value(rows, "values alone", f"{case}reached its end")
    why = (
        f"Calls for one evaluation of the accelerations: {', '.join(f'{name} {n:.3f}' for name, n in calls.items())}; difference "
        "quotients of the right side would need more. What fixed-point sweeps cost instead is in the row on stiff systems."
    )
    return Judgement(f"{max(calls.values()):.3f} calls", grade(reached == 1.0 and max(calls.values()) < 1.001), why)


def _stiff(rows: Rows) -> Judgement:
    found = pick(rows, "claims", check="stiff spring", case="largest h omega of an accepted step").sort_values(
        "setting"
    )
    errors = pick(rows, "claims", check="stiff spring", case="rejected by the error")["value"]
    radius = value(rows, "Table 1", "restored: spectral radius of A", None)
    h_omega = found["value"]
    reached = pick(rows, "claims", check="stiff spring", case="reached its end")["value"].min() == 1.0
    limited = h_omega.max() / h_omega.min() < SPREAD and h_omega.max() < 1.0 / radius and errors.max() == 0
    why = (
        f"Where no error limits the step ({errors.max():g} rejections by it), the longest step of PaperIRK has hω = {span(h_omega)} for "
        f"springs of ω = {span(found['setting'])} 1/s. What goes as h ∝ 1/ω goes as in an explicit method. Sweeps of this tableau contract only "
        f"for hω < 1/ρ(A) = {1.0 / radius:.2f}; the classical explicit method of order 4 is stable up to 2.83. The tableau's A-stability "
        "is of use with Newton's method only."
    )
    return Judgement(f"hω ≤ {h_omega.max():.2f}", grade(reached and not limited, reached), why)


def _embedding(rows: Rows) -> Judgement:
    orders, errors = {}, {}
    for case in ("embedded", "y_d constant in a step"):
        runs = pick(rows, "claims", check="embedding", case=case).sort_values("setting")
        error, h = runs["value"].to_numpy(), runs["setting"].to_numpy()
        orders[case], errors[case] = float(np.log(error[-1] / error[0]) / np.log(h[-1] / h[0])), error[0]
    inside, outside = orders["embedded"], orders["y_d constant in a step"]
    why = (
        f"Order at 0.4 s with h = 0.04 and 0.02 s: {inside:.2f} with the dependents at every stage, {outside:.2f} with y_d constant in a "
        f"step; errors at 0.02 s {number(errors['embedded'])} and {number(errors['y_d constant in a step'])}."
    )
    return Judgement(f"order {inside:.2f}, not {outside:.2f}", grade(inside > 5.0 - 2 * ORDER and outside < 2.0), why)


def _rheonomic(rows: Rows) -> Judgement:
    by_q, by_t = (
        value(rows, "(24)", case, None)
        for case in ("change of v_d with q_i at equal v_i, m/s", "change of v_d with t at equal q_i, v_i, m/s")
    )
    why = (
        f"For a pendulum with a moving pivot q̇_d changes by {number(by_q)} m/s with q_i at equal q̇_i, and by {number(by_t)} m/s with t "
        "at equal q_i and q̇_i: q̇_d = g_1(t, q_i, q̇_i), q_d = g_2(t, q_i). A slip of notation: (23) and the algorithm are right."
    )
    return Judgement(f"q̇_d changes by {number(by_q)}, {number(by_t)} m/s", grade(max(by_q, by_t) < 1e-10), why)


def _richardson(rows: Rows) -> Judgement:
    ratios = pick(rows, "claims", check="(26), (27)", case="median of estimate over true error", problem=DEFAULT)[
        "value"
    ]
    why = (
        f"The undivided difference is {span(ratios)} times the true local error of the two half steps, which are kept (theory: "
        "2^5 − 1 = 31). It errs on the safe side: steps are 31^(1/6) = 1.77 times shorter than Atol and Rtol ask for."
    )
    near = bool(((ratios > 1.0 / FACTOR_2) & (ratios < FACTOR_2)).all())
    return Judgement(f"{span(ratios)} × the error", grade(near, bool((ratios >= FACTOR_2).all())), why)


def _components(rows: Rows) -> Judgement:
    z, n_q = value(rows, "sizes", "components of z"), value(rows, "sizes", "n_q")
    why = f"z holds positions and velocities, {z:g} components, twice n_q = {n_q:g}. A mean over n_q would make err √2 times larger."
    return Judgement(f"{z:g} = {z / n_q:g} n_q", grade(z == n_q), why)


def _exponent(rows: Rows) -> Judgement:
    runs = pick(rows, "claims", check="(26), (27)", case="median estimate", problem=DEFAULT).sort_values("setting")
    estimate, h = runs["value"].to_numpy(), runs["setting"].to_numpy()
    slope = float(np.log(estimate[-1] / estimate[0]) / np.log(h[-1] / h[0]))
    why = f"err grows as h^{slope:.2f}, so the q that the text leaves undefined is {slope - 1.0:.2f}: the order 5."
    return Judgement(f"h^{slope:.2f}", grade(abs(slope - 6.0) < 2 * ORDER), why)


def _stopping(rows: Rows) -> Judgement:
    changes = pick(rows, "claims", check="(32)", case="printed ratio for the change given as setting")
    least = pick(
        rows, "claims", check="(32)", case="printed ratio of the least change of a value as large as the setting"
    )
    small = changes[changes["setting"].abs() < 1.0]
    absolute = bool((small["value"] == small["setting"].abs()).all())
    large = changes[changes["setting"] >= 1.0]["value"]
    out_of_reach = least[least["value"] > 1e-9]["setting"]
    why = (
        f"As printed the ratio is the change itself below 1 (no scaling with y), {span(large)} whatever a positive change of 1 or more, "
        f"and {span(changes[changes['setting'] < 0.0]['value'])} for a change of −5. A value of {span(out_of_reach) if len(out_of_reach) else '–'} "
        f"could not meet 1e-9 at all. With max(|y_i|, 1), as in this project, it is relative. On the linkage, where no "
        f"component of q or v exceeds {value(rows, 'true motion', 'largest component of q or v'):.3g}, the two hardly differ."
    )
    return Judgement(
        f"|Δ| if Δ < 1, else {span(large)}" if absolute else f"{span(changes['value'])}", grade(not absolute), why
    )


def _h_max(rows: Rows) -> Judgement:
    by_h = pick(rows, "claims", check="(33)", case="steps given up").set_index("setting")["value"]
    converging = pick(rows, "claims", check="(33)", case="of these, converging").set_index("setting")["value"]
    given_up, needless = by_h.sum(), converging.sum()
    if given_up == 0:
        raise NoRows("(33) gave up none of the steps tried")
    run = one(rows, "step_size", solver=IRK, group="paper")
    why = (
        f"Of {given_up:.0f} steps that (33) gives up, {needless:.0f} converge if they are let "
        f"({'; '.join(f'h = {h:g} s: {converging[h]:.0f} of {n:.0f}' for h, n in by_h.items())}). The sweep of [q̇, q] is not normal, so "
        f"an unscaled norm may grow before it falls. On the linkage this costs little: {run['n_rejected_convergence']:.0f} of "
        f"{run['n_steps'] + run['n_rejected_error'] + run['n_rejected_convergence']:.0f} attempts of PaperIRK end so."
    )
    return Judgement(f"{needless / given_up:.0%} needless", grade(needless <= NEEDLESS * given_up), why)


CLAIMS = (
    Claim(
        "3.1",
        "Table 1 is Sun's Radau II method: 3 stages, order 5, symplectic.",
        "Simplifying assumptions and the symplectic condition of the coefficients.",
        {"claims": ("check = Table 1", VALUE)},
        f"Holds if B(5), C(2), D(2) and the symplectic condition hold to {ROUNDING:g}, and B(6) does not (> 1e-6).",
        _table1,
    ),
    Claim(
        "3.1",
        "The new procedure is as accurate as its method: order 5.",
        "Sun's method with fixed steps of 20 and 10 ms to 1 s, against the true motion.",
        {"claims": ("check = fixed steps to 1 s; case = Sun", (*VALUE, "setting"))},
        f"Holds if the measured order is above {5.0 - ORDER:g}.",
        _order,
        assumed=True,
    ),
    Claim(
        "1, 3.1",
        "With a symplectic method for the independent coordinates the integration is symplectic.",
        "Determinant of a step of 0.1 s in (q_i, p_i), by differences, at seven phases.",
        {"claims": ("check = one step as a map", VALUE)},
        f"Holds if |det − 1| < {SYMPLECTIC:g}; with conditions if it is below {NOT_SYMPLECTIC:g} and that on momenta below {SYMPLECTIC:g}.",
        _map,
        assumed=True,
    ),
    Claim(
        "1, 3.1",
        "Because the method is symplectic the result stays stable over long times.",
        "Energy of Sun's method over 10⁴ s: fixed and variable steps, velocities and momenta, two geometries; Gauss(3) beside it.",
        {
            "energy": (
                "solver = Sun Radau IIB(3), PaperIRK, Gauss(3); the longest t_end",
                (*ENERGY, "h", "variables", "partition", "geometry"),
            )
        },
        f"A run drifts if its slope exceeds {RESOLVED:g} standard errors and what rounding explains (ε × kinetic energy × steps), or if it "
        "fails. Holds if no run of Sun's method on (q_i, q̇_i) drifts; with conditions if it does not where its map is symplectic: on momenta, with fixed steps and one partition.",
        _stable,
        assumed=True,
    ),
    Claim(
        "3.1",
        "The stages are functions of y_n+1, so (18) reduces the unknowns from 2 s n_q to 2 n_q.",
        "Two sets of stages with the same y_n+1, one sweep from each.",
        {"claims": ("check = (18)", VALUE)},
        "Holds if equal y_n+1 (to rounding, × 1000) give equal next iterates.",
        _reduction,
    ),
    Claim(
        "abstract, 1, 3.1, 5",
        "Fixed-point sweeps need no Jacobian of the right side, by formula or by differences.",
        "PaperIRK on the linkage given by functions that count their calls.",
        {"claims": ("check = values alone; case begins with Q_d given", VALUE)},
        "Holds if the run reaches its end with one call of M, Q and Q_d for each evaluation of the accelerations (< 1.001).",
        _jacobian,
    ),
    Claim(
        "1, 2.2, 3.1",
        "Stiff systems need an implicit method, and the new procedure, being implicit, is applicable to them.",
        "PaperIRK on springs of 10 and 1000 rad/s, excited so weakly that no error limits the step.",
        {"claims": ("check = stiff spring; Table 1 for ρ(A)", (*VALUE, "setting"))},
        f"Holds if the runs reach their end and stiffness does not limit the step; with conditions if they do and it does: hω of the longest steps the "
        f"same within a factor {SPREAD:g}, below 1/ρ(A), no rejection by the error. The paper says of its beam that time increases much with stiffness.",
        _stiff,
    ),
    Claim(
        "3.2",
        "The constraints have to be solved inside the sweep; else the dependents stay constant in a step.",
        "Sweeps in NumPy with the dependents solved at every stage, and with y_d kept until the end of the step.",
        {"claims": ("check = embedding", (*VALUE, "setting"))},
        f"Holds if the order is above {5.0 - 2 * ORDER:g} with them and below 2 without.",
        _embedding,
        assumed=True,
    ),
    Claim(
        "3.2",
        "(22)–(24): q̇_d is a function of q̇_i alone and q_d of q_i alone.",
        "A pendulum with a moving pivot at equal q̇_i.",
        {"claims": ("check = (24)", VALUE)},
        "Holds if q̇_d changes neither with q_i nor with t (< 1e-10).",
        _rheonomic,
    ),
    Claim(
        "3.3",
        "(26), (27): the difference of one step and two half steps is the local error.",
        "Both from true states at instants of a period, against the true motion, in the norm (27).",
        {"claims": ("check = (26), (27)", (*VALUE, "setting"))},
        f"Holds if the median ratio of estimate to error is within a factor {FACTOR_2:g} of 1; with conditions if it is larger (safe).",
        _richardson,
        assumed=True,
    ),
    Claim(
        "3.3",
        "n in (27) equals n_q.",
        "Components of z = [y_i, y_d].",
        {"claims": ("check = sizes", VALUE)},
        "Holds if z has n_q components.",
        _components,
    ),
    Claim(
        "3.3",
        "(28)–(31), (34): err ∝ h^(q+1), with q the order of the method.",
        "The estimate (27) at two steps, from true states at instants of a period.",
        {"claims": ("check = (26), (27); case = median estimate", (*VALUE, "setting"))},
        f"Holds if the measured exponent is within {2 * ORDER:g} of 6.",
        _exponent,
        assumed=True,
    ),
    Claim(
        "3.3",
        "(32) as printed is a relative test of convergence.",
        "Its ratio for given changes, and for the least change that a number of given size can have.",
        {"claims": ("check = (32)", (*VALUE, "setting"))},
        "Does not hold if, for changes below 1, the ratio is the change itself.",
        _stopping,
    ),
    Claim(
        "3.3",
        "(33): where the differences grow from sweep to sweep, h is beyond the largest step that converges.",
        "Sweeps in NumPy from true states at instants of a period, continued after (33) has failed; PaperIRK's own rejections.",
        {
            "claims": ("check = (33)", (*VALUE, "setting")),
            "step_size": (
                "solver = PaperIRK, group = paper",
                ("n_rejected_convergence", "n_rejected_error", "n_steps"),
            ),
        },
        f"Holds if at most {NEEDLESS:.0%} of the steps given up would have converged within 200 sweeps.",
        _h_max,
        assumed=True,
    ),
)
