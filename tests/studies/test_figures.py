"""Figures: the default looks the same everywhere; which lines are drawn, through which runs, and where labels stand."""

import itertools

import numpy as np
import pandas as pd
import pytest
from matplotlib import pyplot as plt
from matplotlib.colors import to_hex
from matplotlib.text import Text

from studies.bench import figures
from studies.bench.cli import Call
from studies.bench.solvers import CATALOGUE, DEFAULT, GIVEN, IRK, IRK_LINE
from studies.bench.store import Output
from tests.studies.of_study import median

FAMILY = {"heyoka": "heyoka", "CVODE from C, Adams": "SUNDIALS", "CVODE, Adams": "SUNDIALS", "LSODA, index 1": "SciPy"}
FAMILY |= {"IDA from C, stabilised": "SUNDIALS", "DOP853, index 1": "SciPy", "Dopri8, diffrax": "diffrax"}
ERRORS = (1e-2, 1e-3, 1e-4)
OURS = "twoloop, the default"


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


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


def labels(axes):
    return {text.get_text(): text for text in axes.texts}


def test_the_default_has_a_colour_and_a_width_of_its_own():
    ours, theirs = (
        {figures.style(name)["color"] for name, solver in CATALOGUE.items() if (solver.family == "two-loop") == own}
        for own in (True, False)
    )
    assert not ours & theirs
    thick = {name for name in CATALOGUE if "linewidth" in figures.style(name)}
    assert thick == {DEFAULT, GIVEN} and figures.style(GIVEN) == figures.style(DEFAULT)
    for solver, coded in (("auto", False), ("auto, compiled", True)):  # the same whatever it does by itself
        look = figures.look(pd.Series({"solver": solver}), coded)
        assert look == figures.style(DEFAULT) | {"label": OURS}
    other = figures.look(pd.Series({"solver": "auto"}), True)
    assert "linewidth" not in other and other["label"] == "compiled=False"


def test_no_two_solvers_look_alike():
    names = [name for name in dict.fromkeys((*figures.STYLES, *CATALOGUE)) if name not in (IRK_LINE, GIVEN)]
    pairs = {name: (figures.style(name)["color"], figures.style(name)["marker"]) for name in names}
    listed = {name: pairs[name] for name in figures.STYLES if name in pairs}
    assert len(set(listed.values())) == len(listed)
    unlisted = {pairs[name] for name in names if name not in listed}
    assert not unlisted & set(listed.values()) and figures.style("unknown") == figures.style("unknown")
    assert figures.style(IRK) == figures.style(IRK_LINE)


def test_lines_are_the_default_the_papers_procedure_and_the_fastest_of_each_other_project():
    slow = {"heyoka": 90.0, "CVODE from C, Adams": 80.0, "IDA from C, stabilised": 70.0, "LSODA, index 1": 60.0}
    slow |= {"DOP853, index 1": 95.0, "CVODE, Adams": 99.0}
    made = rows(**{f"Gauss{k}": 0.1 * k for k in (4, 6)}, **slow, auto=40.0, **{"auto, compiled": 30.0, IRK_LINE: 20.0})
    others = ["LSODA, index 1", "IDA from C, stabilised", "heyoka", "CVODE from C, Adams"]
    assert figures.lines_of(made, ERRORS, True) == ["auto, compiled", IRK_LINE, *others]
    assert figures.lines_of(made, ERRORS, False) == ["auto", IRK_LINE, *others]
    assert figures.lines_of(made[~made["solver"].str.contains("auto|Paper")], ERRORS) == [*others, "Gauss4", "Gauss6"]
    # a solver that reaches no error that is compared is drawn all the same, one that gets nowhere is not
    made.loc[made["solver"] == "heyoka", "error_q"] = [3.0, 2.0, np.nan]
    made.loc[made["solver"].str.startswith("IDA"), ["error_q", "status"]] = [np.nan, "TIME_LIMIT"]
    assert figures.lines_of(made, ERRORS, True)[2:] == ["LSODA, index 1", "heyoka", "CVODE from C, Adams", "Gauss4"]


def test_the_cheapest_lines_are_the_cheapest():
    made = pd.DataFrame([median(f"s{k}", 1e-4, 1.0 + k) | {"tol": 1e-4, "astray": False} for k in (3, 0, 2, 1)])
    assert figures.cheapest_lines(made, (1e-3,), 2) == ["s0", "s1"]
    assert figures.cheapest_lines(made, (1e-9,), 2) == []


def test_a_line_goes_through_all_runs_whose_error_is_known_in_the_order_of_the_setting():
    made = rows(auto=1.0)
    assert figures.line_of(made.iloc[::-1])["error_q"].tolist() == list(ERRORS)
    assert figures.line_of(made.assign(error_q=[1e-2, np.nan, 5e-7]))["error_q"].tolist() == [1e-2, 5e-7]
    assert figures.line_of(made.assign(floor=5e-4))["error_q"].tolist() == [1e-2, 1e-3]
    assert figures.line_of(made.assign(astray=[True, False, False]))["error_q"].tolist() == [1e-3, 1e-4]
    steps = made.assign(tol=1e-5, err_out=[1e-3, 1e-7, 1e-5], error_q=[1e-2, 1e-3, 5e-3])
    assert figures.line_of(steps)["error_q"].tolist() == [1e-2, 5e-3, 1e-3]
    assert figures.line_of(made[:0]).empty  # a quick run has not all solvers of a figure


@pytest.mark.slow
def test_a_work_precision_figure_has_labels_on_at_most_six_lines_and_better_is_left(tmp_path):
    made = rows(auto=1.0, heyoka=2.0, **{f"Gauss{k}": 1.0 * k for k in (4, 6, 8, 10, 12)})
    with pytest.raises(ValueError, match="at most 6 lines; given 7"):
        figures.work_precision(made, list(dict.fromkeys(made["solver"])), "message")
    (axes,) = figures.work_precision(made, ["heyoka", "auto"], "message", coded=False).axes
    assert not axes.xaxis_inverted() and axes.get_xscale() == axes.get_yscale() == "log"
    assert axes.get_legend() is None and axes.get_figure().get_suptitle() == "message"
    lines = {line.get_label(): line for line in axes.lines}
    assert list(lines) == list(labels(axes)) == [OURS, "heyoka"]
    for name, text in labels(axes).items():
        assert text.get_color() == to_hex(lines[name].get_color())
    assert lines[OURS].get_linewidth() == figures.THICK > lines["heyoka"].get_linewidth()
    with Output(Call("x", True, tmp_path, False, "")) as output:
        for _ in range(2):
            figures.save(figures.work_precision(made, ["heyoka", "auto"], "message"), output, "x")
            known = (tmp_path / "x.svg").read_bytes()
            assert (tmp_path / "x.svg").read_bytes() == known and b"quick run" in known
    assert (tmp_path / "x.png").stat().st_size > 1000


def test_labels_do_not_overlap_and_stand_in_the_order_of_the_lines_in_the_last_panel_that_has_them():
    figure, (left, right) = plt.subplots(1, 2, layout="constrained")
    for axes in (left, right):
        for k in range(6):
            axes.plot([1.0, 2.0], [1.0, 1.0 + 1e-3 * k], label=f"{k}")
        axes.axhline(0.5, label="level")
        axes.plot([1.0, 2.0], [np.nan, np.nan], label="nothing")
    left.fill_between([1.0, 3.0], 2.0, 3.0, label="band", color="red")
    figures.label_lines((left, right))
    assert list(labels(left)) == ["band"] and set(labels(right)) == {"level", *"012345"}
    assert to_hex(labels(left)["band"].get_color()) == "#ff0000"
    figure.canvas.draw()
    boxes = {name: Text.get_window_extent(text) for name, text in labels(right).items()}
    middles = [boxes[name].y0 + boxes[name].y1 for name in ("level", *"012345")]
    assert middles == sorted(middles)
    assert not any(one.overlaps(other) for one, other in itertools.combinations(boxes.values(), 2))
    assert all(box.x0 > right.get_window_extent().x1 for box in boxes.values())


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
