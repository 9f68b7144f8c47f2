"""Figures: a look of its own for each solver, the same everywhere; which lines are drawn, and where they have gaps."""

import itertools

import numpy as np
import pandas as pd
import pytest
from matplotlib import pyplot as plt
from matplotlib.colors import to_hex

from studies import motion, step_size, violation
from studies.bench import figures
from studies.bench.figures import FIRST
from studies.bench.names import label, looks_like
from studies.bench.solvers import (
    CATALOGUE,
    CVODE_C,
    DEFAULT,
    GEAR_ORDERS,
    GIVEN,
    HEYOKA,
    IDA_C,
    IDA_C_ORDER_2,
    IDA_C_STATES,
    IRK,
    IRK_LINE,
    NEWMARK,
    OWN_EXPLICIT,
    gear,
)
from studies.energy import study as energy
from studies.honesty import study as honesty
from studies.motion import GRIDS
from studies.table3 import study as table3
from studies.work_precision import rivals
from tests.studies.of_study import median

NEW = (  # of rivals that no table of styles knows, as a study may bring them
    *("IDA from C, q and v tested", "CVODE from C, BDF, projected", "CVODES, CasADi", "heyoka, minimal coordinates"),
    *(
        "CVODE from C, minimal coordinates",
        "Exudyn, GeneralizedAlpha 0.6",
        "Exudyn, GeneralizedAlpha 1",
        "an unknown solver",
    ),
)
FAMILY = {"heyoka": "heyoka", "CVODE from C, Adams": "SUNDIALS", "CVODE, Adams": "SUNDIALS", "LSODA, index 1": "SciPy"}
FAMILY |= {"IDA from C, stabilised": "SUNDIALS", "DOP853, index 1": "SciPy", "Dopri8, diffrax": "diffrax"}
FAMILIES = {  # of rivals that one figure shows, with what it mostly shows of them
    "heyoka": (HEYOKA,),
    "CVO": (CVODE_C, "CVODE, Adams", "CVODE from C, BDF"),
    "IDA": (IDA_C, IDA_C_STATES, IDA_C_ORDER_2, "IDA, stabilised", "IDA, index1"),
    "SciPy": ("LSODA, index 1", "DOP853, index 1", "DOP853, projected", "Radau, index 1"),
    "Exudyn": ("Exudyn, GeneralizedAlpha", "Exudyn, TrapezoidalIndex2"),
    "CasADi": ("IDAS, CasADi", "CVODES, CasADi", "collocation, CasADi"),
    "diffrax": ("Dopri8, diffrax",),
}
ERRORS = (1e-2, 1e-3, 1e-4)
OFTEN = (*FIRST[:2], HEYOKA, CVODE_C)  # of the lines of a work-precision figure
STIFF = ("TRBDF2", "RadauIIA5", "RadauIIA9")


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


def pair(solver):
    look = figures.style(solver)
    return look["color"], look["marker"]


def rows(**seconds):
    """Medians on the four-bar: of each solver three runs a decade of error apart, the time that of the loosest."""
    return pd.DataFrame(
        [
            median(solver, error, cost := time * 2.0**k, family=FAMILY.get(solver, "two-loop"), times=(cost,) * 5)
            | {"case": "four-bar", "tol": error, "astray": False}
            for solver, time in seconds.items()
            for k, error in enumerate(ERRORS)
        ]
    )


def drawn(axes):
    """Colour and marker of each labelled line."""
    found = {}
    for handle, words in zip(*axes.get_legend_handles_labels(), strict=True):
        line = handle[0] if isinstance(handle, tuple) else handle
        found[words.rsplit(" [", 1)[0]] = to_hex(line.get_color()).upper(), line.get_marker()
    return found


def test_no_two_solvers_look_alike():
    names = dict.fromkeys((*figures.STYLES, *CATALOGUE, *NEW))
    names.pop(IRK_LINE)  # the paper's procedure along another setting
    names.pop(GIVEN)  # in its runs the default is auto
    alike = [pairs for pairs in itertools.combinations(names, 2) if pair(pairs[0]) == pair(pairs[1])]
    assert alike == [] and pair(IRK) == pair(IRK_LINE) and pair(GIVEN) == pair(DEFAULT)


def test_no_colour_is_of_ours_and_of_others_nor_of_two_families_drawn_together():
    ours, theirs = (
        {pair(name)[0] for name, solver in CATALOGUE.items() if (solver.family == "two-loop") == own}
        for own in (True, False)
    )
    assert not ours & theirs and not figures.OURS.keys() & figures.THEIRS.keys()
    listed = {family: {pair(name)[0] for name in names} for family, names in FAMILIES.items()}
    assert all(len(each) == 1 for each in listed.values()) and len(set.union(*listed.values())) == len(listed)


@pytest.mark.parametrize(
    ("names", "coded"),
    [
        (energy.DRAWN, True),
        (table3.DRAWN, True),
        (violation.DRAWN, True),
        (violation.OVER_TIME, True),
        ((*OFTEN, IRK_LINE, "Taylor", OWN_EXPLICIT, IDA_C, "DOP853, index 1"), True),  # the four-bars
        ((*OFTEN, "Taylor, compiled", "DOP853, compiled", OWN_EXPLICIT, IDA_C, "LSODA, index 1"), True),
        ((*OFTEN, IRK, "Adams", OWN_EXPLICIT, "Gauss12", IDA_C_STATES, "DOP853, index 1"), False),  # the beams
        (
            (*OFTEN, "TRBDF2", "RadauIIA5", "RadauIIA9", IDA_C, IDA_C_ORDER_2, "DOP853, index 1", "Radau, index 1"),
            False,
        ),
        ((DEFAULT, OWN_EXPLICIT, *FAMILIES["Exudyn"][:1], HEYOKA, CVODE_C, "IDA, sparse"), None),  # chains
    ],
)
def test_solvers_of_a_figure_are_told_apart_without_colours(names, coded):
    assert len({pair(looks_like(name, coded))[1] for name in names}) == len(names)


@pytest.mark.parametrize(
    "names", [(energy.SUN, energy.GAUSS, energy.RADAU, energy.NEWMARK), motion.LISTED[:7], step_size.PAPER]
)
def test_solvers_that_are_always_drawn_together_do_not_look_alike(names):
    assert len({pair(name) for name in names}) == len(names)


def test_curves_without_markers_differ_in_colour():
    names = (IRK, NEWMARK, *(gear(order) for order in (1, 2, 3, 5)))
    assert len({pair(name)[0] for name in names}) == len(names)


def test_a_solver_looks_the_same_in_all_figures_and_no_two_in_one_look_alike():
    names = ("auto", "auto, compiled", "Adams", "heyoka", "CVODE from C, Adams", "LSODA, index 1", *NEW[:3])
    made = rows(**dict.fromkeys(names, 1.0))
    panels = [*figures.work_precision(made, names, "").axes, *rivals.picture(made).axes]
    found = [drawn(panel) for panel in panels]
    assert found[0].keys() == found[1].keys() == set(map(label, names)) and len(found[2]) >= 5
    for looks, coded in zip(found, (None, None, True), strict=True):  # the picture is of a mechanism with code
        assert len(set(looks.values())) == len(looks)
        known = {label(name, coded): pair(looks_like(name, coded)) for name in names}
        assert looks == {name: (known[name][0].upper(), known[name][1]) for name in looks}


def test_default_the_papers_procedure_and_the_main_rivals_are_drawn_however_slow():
    own = {f"Gauss{k}": 0.1 * k for k in range(4, 18, 2)}
    slow = {"heyoka": 90.0, "CVODE from C, Adams": 80.0, "IDA from C, stabilised": 70.0, "LSODA, index 1": 60.0}
    slow |= {"DOP853, index 1": 95.0, "CVODE, Adams": 99.0, "Dopri8, diffrax": 50.0}
    made = rows(**own, **slow, **{"auto": 40.0, "auto, compiled": 30.0, IRK_LINE: 20.0})
    first = ["auto", "auto, compiled", IRK_LINE]
    four = ["heyoka", "CVODE from C, Adams", "IDA from C, stabilised", "LSODA, index 1"]
    won = "Dopri8, diffrax"  # the cheapest of others, though none of the main rivals
    assert figures.lines_of(made, ERRORS) == [*first, "Gauss4", *four, won]
    assert figures.lines_of(made[made["solver"] != won], ERRORS) == [*first, "Gauss4", "Gauss6", *four]
    assert figures.lines_of(made[made["solver"] != "auto"], ERRORS)[:3] == [*first[1:], "Gauss4"]
    # a rival that gets to no error that is compared is drawn all the same, one that gets nowhere is not
    made.loc[made["solver"] == "heyoka", "error_q"] = [3.0, 2.0, np.nan]
    made.loc[made["solver"].str.startswith("IDA"), ["error_q", "status"]] = [np.nan, "TIME_LIMIT"]
    assert figures.lines_of(made, ERRORS)[-4:] == ["heyoka", "CVODE from C, Adams", "LSODA, index 1", won]


def gaps(runs):
    """Pairs of errors between which a line is drawn."""
    errors = figures.with_gaps(runs)["error_q"].tolist()
    return [ends for ends in itertools.pairwise(errors) if not np.isnan(ends).any()]


def test_a_line_has_a_gap_where_nothing_was_run_and_where_a_run_failed():
    made = rows(auto=1.0)
    assert gaps(made.iloc[::-1]) == [(1e-2, 1e-3), (1e-3, 1e-4)]
    failed = made.assign(error_q=[1e-2, np.nan, 5e-3])
    assert gaps(failed) == []  # less than a decade apart, but the run between failed
    assert gaps(made.assign(error_q=[1e-2, 9e-4, 8e-4])) == [(9e-4, 8e-4)]
    assert gaps(made.assign(used=["Newton", "explicit", "explicit"])) == [(1e-3, 1e-4)]
    assert gaps(made.assign(used=np.nan)) == [(1e-2, 1e-3), (1e-3, 1e-4)]  # as a file has it
    assert gaps(made.assign(floor=5e-4)) == [(1e-2, 1e-3)] and gaps(made.assign(astray=[True, False, False])) == [
        (1e-3, 1e-4)
    ]
    assert figures.with_gaps(made[:0]).empty  # a quick run has not all solvers of a figure
    steps = made.assign(tol=1e-5, err_out=[1e-3, 1e-7, 1e-5], error_q=[1e-2, np.nan, 5e-3])
    assert gaps(steps) == [(1e-2, 5e-3)]  # in the order of the setting that varies


def test_the_lines_of_a_figure_have_these_gaps():
    made = rows(auto=1.0, heyoka=2.0)
    made.loc[1, ["error_q", "status"]] = [np.nan, "FAILED"]
    for axes in (*figures.work_precision(made, ["auto"], "").axes, *rivals.picture(made).axes):
        (line,) = (each for each in axes.lines if to_hex(each.get_color()).upper() == figures.VIOLET)
        x = np.asarray(line.get_xdata(), dtype=float)
        assert np.isnan(x).tolist() == [False, True, True, False] or np.isnan(x).tolist() == [False, True, False]


@pytest.mark.parametrize(
    ("ends", "seen"), [((0.013, 0.86), (0.1, 1.0)), ((3.0, 5e4), (10.0, 1e4)), ((3.0, 4.0), (1.0, 10.0))]
)
def test_logarithmic_axes_are_labelled_at_decades_of_which_two_are_in_view(ends, seen):
    figure, axes = plt.subplots()
    axes.set(xscale="log", yscale="log", ylim=ends)
    figures.label_decades(figure)
    figure.canvas.draw()
    low, high = axes.get_ylim()
    decades = [place for place in axes.yaxis.get_majorticklocs() if low <= place <= high]
    assert (decades[0], decades[-1]) == pytest.approx(seen) and low <= ends[0] and high >= ends[1]
    assert not any(label.get_text() for label in axes.yaxis.get_minorticklabels())


def test_errors_grow_to_the_right_in_all_figures():
    made = rows(auto=1.0, heyoka=2.0)
    for axes in (*figures.work_precision(made, ["auto"], "").axes, *rivals.picture(made).axes):
        assert axes.get_xscale() == axes.get_yscale() == "log" and not axes.xaxis_inverted()
        assert "(" in axes.get_xlabel() and axes.get_ylabel()
    assert {"compiled=False", "heyoka"} <= drawn(rivals.picture(made).axes[0]).keys()


def test_the_motion_is_drawn_with_both_two_loop_procedures():
    about = {"family": "two-loop", "keeps_constraints": True, "case": "four-bar", "t_end": 100.0}
    about |= {"error_y3": 1e-3, "error_y3_short": 1e-6, "group": "line-up"}
    made = [about | {"solver": name} for name in (IRK, NEWMARK)]
    stand_in = about | {"family": "stand-in", "group": "GSTIFF stand-in", "h": motion.MIDDLE, "error_y3_short": 1.0}
    made += [stand_in | {"solver": gear(order), "error_y3": float(order < 3)} for order in GEAR_ORDERS]
    made = pd.DataFrame(made).assign(series=[GRIDS] * len(made))
    (axes,) = motion.motion_figure(made, "last", (motion.MIDDLE,)).axes
    assert list(drawn(axes)) == ["true motion", IRK, NEWMARK, gear(1), gear(2)]
    assert axes.get_xlabel() == "t (s)" and axes.get_ylabel() == "y3 (m)"


def test_the_bars_of_honesty_are_the_shares_of_the_outcomes():
    outcomes = {"LSODA, index 1": [honesty.SILENT, honesty.HANG, honesty.SAID, honesty.NOT_RUN]}
    outcomes |= dict.fromkeys(("BDF (twoloop)", "Gauss6 (twoloop)"), [honesty.RIGHT] * 5)
    outcomes |= {"auto (twoloop)": [honesty.RIGHT] * 3 + [honesty.SAID]}
    made = pd.DataFrame([{"solver": name, "outcome": what} for name, each in outcomes.items() for what in each])
    made["error"] = np.where(made["outcome"] == honesty.SILENT, 2e-5, np.nan)
    totals = honesty.totals(made)
    assert {line["solver"]: line["n"] for line in totals} == dict(zip(outcomes, (3, 5, 5, 4), strict=True))
    (axes,) = honesty.picture(totals).axes
    shares = [[bar.get_width() for bar in bars] for bars in axes.containers]
    third = 100.0 / 3.0  # one run hangs, one is off by a little, one failed
    assert np.allclose(shares, [[0.0, 0.0, third], [0.0, 0.0, third], [25.0, 0.0, third]])
    assert {text.get_text() for text in axes.texts} == {"", "1", "ours", "rivals"} and axes.get_title()
    names = [label.get_text() for label in axes.get_yticklabels()]
    assert names == ["the default (4)", "2 solvers, all right (10)", "SciPy, LSODA, index 1 (3)"]


def test_the_cells_of_table_3_are_drawn_as_ratios():
    made = [
        {"group": group, "err_in": e_in, "err_out": e_out, "call_s": (paper or 9.0) / 10.0, "lost": False}
        for group in table3.FAMILIES
        for e_in, line in zip(table3.TOLERANCES, table3.printed(group), strict=True)
        for e_out, paper in zip(table3.TOLERANCES, line, strict=True)
    ]
    made[5] |= {"call_s": 10.0 * made[5]["call_s"]}
    made[6] |= {"lost": True}
    first, second, scale = table3.picture(pd.DataFrame(made)).axes
    told = [[text.get_text() for text in axes.texts] for axes in (first, second)]
    assert told[0] == ["10"] * 5 + ["1.0", "★"] + ["10"] * 9 and told[1] == ["★", "10", "10", "10"] * 4
    assert first.get_xlabel() == "err_out" and first.get_ylabel() == "err_in"
    assert scale.get_ylabel() == "paper's time / our least"
