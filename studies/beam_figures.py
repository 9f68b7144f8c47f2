"""The figures of the beam study, from its rows and curves."""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.ticker import NullLocator

from studies.beam_limits import FIXED_STEP, PARTING, PERTURBED
from studies.beam_runs import CASES, NEWTON, PAPER, PAPER_TOL, SOFT, SOLVERS, SWEEPS
from studies.report import Array, Call

TARGET = 1e-4  # m, the tip error at which costs are compared
UNSEEN = 1e-7  # m, below which differences are not drawn
ORDERS = {SOFT: 1e-3, "moderately stiff": 1e-5}  # s, the paper's step sizes by order of magnitude

STYLES: dict[str, str] = dict(
    zip(
        SOLVERS,
        (
            *("C3o-", "C1v-", "C1^--"),  # the paper's
            *("C0o-", "b^-", "mv-", "b2:", "C9s-", "C0D--"),  # Newton's method
            *("C2s-", "C8^-", "C4v-"),  # sweeps
            "C6P-",  # explicit
            *("ks-", "kD--", "C7s:", "C7D:", "C5x-"),  # other people's
        ),
        strict=True,
    )
)


def figures(rows: pd.DataFrame, series: dict[str, Array], call: Call) -> None:
    """Draw all figures."""
    _motion(rows, series, call)
    _cost(rows, call)
    _sensitivity(series, call)
    _growth(rows, call)


def _motion(rows: pd.DataFrame, series: dict[str, Array], call: Call) -> None:
    plot, axes = plt.subplots(3, 2, figsize=(10.5, 8), sharex=True, layout="constrained", height_ratios=(3, 3, 3.4))
    tolerance = f"{PAPER_TOL:.0e}".replace("e-0", "e-")
    for column, case in enumerate(CASES):
        tip, middle, steps = axes[:, column]
        for name, style, label in (
            (f"{case}, truth", {"color": "0.75", "lw": 4}, "reference"),
            (
                f"{case}, {PAPER}",
                {"color": "tab:red", "lw": 1.4},
                f"PaperIRK, Atol = Rtol = {tolerance}",
            ),
            (f"{case}, {NEWTON}", {"color": "tab:blue", "lw": 1.2, "ls": "--"}, "RadauIIA5, Newton's method"),
        ):
            if f"{name}: t" not in series:  # a quick run may not have all
                continue
            t = series[f"{name}: t"]
            tip.plot(t, series[f"{name}: tip"], label=label, **style)
            middle.plot(t, series[f"{name}: middle"], **style)
            if f"{name}: steps" in series:
                start, low, mid, high = series[f"{name}: steps"]
                steps.fill_between(start, low, high, color=style["color"], alpha=0.3, lw=0)
                steps.semilogy(start, mid, color=style["color"], lw=1.0)
        steps.axhline(ORDERS[case], color="black", lw=1, ls=":")
        steps.text(0.02, ORDERS[case] * (1.15 if case == SOFT else 0.6), "the paper's order of magnitude", fontsize=8)
        steps.set(xlabel="t (s)", ylim=(3e-6, 5e-2))
        if case == SOFT and t[-1] > PARTING:
            for panel in (tip, middle):
                panel.axvline(PARTING, color="black", lw=1, ls=":")
        tip.set_title(f"The {case} beam", fontsize=10)
    plot.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3, fontsize=9)
    for panel, label in zip(axes[:, 0], ("tip height (m)", "midpoint deflection (m)", "step size (s)"), strict=True):
        panel.set_ylabel(label)
    plot.savefig(call.out / "beam_motion.png")
    plt.close(plot)


def _cost(rows: pd.DataFrame, call: Call) -> None:
    runs = rows[rows["group"] == "run"]
    plot, axes = plt.subplots(1, 2, figsize=(11, 5.4), sharey=True, layout="constrained")
    for panel, case in zip(axes, CASES, strict=True):
        for solver, style in STYLES.items():
            line = runs[(runs["case"] == case) & (runs["solver"] == solver) & runs["error_tip"].notna()]
            if not line.empty:
                line = line.sort_values("tol")
                panel.loglog(line["cpu_s"], line["error_tip"], style, ms=4, lw=1.1, label=solver)
        panel.axhline(TARGET, color="black", lw=1, ls=":")
        panel.set(xlabel="CPU time (s)", title=f"The {case} beam, {runs['t_end'].iloc[0]:g} s")
    axes[0].set_ylabel("largest error of the tip's height (m)")
    handles, labels = axes[0].get_legend_handles_labels()
    plot.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8)
    plot.savefig(call.out / "beam_cost.png")
    plt.close(plot)


def _sensitivity(series: dict[str, Array], call: Call) -> None:
    plot, axes = plt.subplots(1, 2, figsize=(10.5, 4.4), sharey=True, layout="constrained")
    t = series["sensitivity: t"]
    for panel, case in zip(axes, CASES, strict=True):
        for k, name in enumerate(PERTURBED):
            off = np.abs(series[f"sensitivity: {case}, {name}"])
            panel.semilogy(t, np.maximum(off, UNSEEN), color=f"C{k}", lw=1.1, label=name)
        if case == SOFT and t[-1] > PARTING:
            panel.axvline(PARTING, color="black", lw=1, ls=":")
            panel.text(PARTING, 2e-7, " 1.2 s", fontsize=8)
        panel.set(xlabel="t (s)", title=f"The {case} beam", ylim=(UNSEEN, 2.0))
    axes[0].set_ylabel("change of the tip's height (m)")
    plot.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(PERTURBED), fontsize=8)
    plot.savefig(call.out / "beam_sensitivity.png")
    plt.close(plot)


def _growth(rows: pd.DataFrame, call: Call) -> None:
    plot, (mesh, stiffness) = plt.subplots(1, 2, figsize=(12, 4.2), layout="constrained")
    elements = rows[rows["group"] == "elements"]
    for kind, color in (("dense", "tab:gray"), ("banded", "tab:blue")):
        line = elements[elements["solver"] == kind]
        if not line.empty:
            mesh.loglog(line["n_elements"], 1e3 * line["cpu_s"] / line["n_steps"], "o-", color=color, label=kind)
    counts = sorted(elements["n_elements"].dropna().unique())
    mesh.set_xticks(counts, [f"{n:.0f}" for n in counts], minor=False)
    mesh.xaxis.set_minor_locator(NullLocator())
    mesh.set(
        xlabel="elements",
        ylabel="CPU time a step (ms)",
        title=f"Newton's method, fixed steps of {FIXED_STEP:g} s",
    )
    mesh.legend()
    modulus = rows[rows["group"] == "modulus"]
    for (solver, tol), line in modulus.groupby(["solver", "tol"]):
        color = {PAPER: "tab:red", SWEEPS: "tab:green", NEWTON: "tab:blue"}[solver]
        ls = {1e-1: ":", 1e-3: "--"}.get(tol, "-")
        label = f"{solver}, tol {tol:g}"
        stiffness.loglog(line["modulus"], line["n_evaluations"] / line["t_end"], "o", ls=ls, color=color, label=label)
    stiffness.set(xlabel="Young's modulus (N/m²)", ylabel="evaluations a second of motion", title="Cost and stiffness")
    stiffness.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    plot.savefig(call.out / "beam_growth.png")
    plt.close(plot)
