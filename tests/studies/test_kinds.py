"""The table of kinds of mechanisms: in how many comparisons each solver is the fastest, loosely and tightly."""

from studies.bench.kinds import by_kind
from studies.work_precision import rivals
from twoloop.mechanisms import bricard

RANGES = [{"name": "loose", "errors": [1e-4, 1e-5]}, {"name": "tight", "errors": [1e-8]}, {"name": "all", "errors": []}]
OURS, THEIRS = {"solver": "Taylor, compiled", "call_s": 0.1}, {"solver": "heyoka", "call_s": 0.05}
WON = {"ours": OURS, "others": None, "verdict": "alone", "error": 1e-4}
LOST, NEAR = WON | {"others": THEIRS, "verdict": "behind"}, WON | {"others": THEIRS, "verdict": "undecided"}
NONE = {"ours": None, "others": None, "verdict": "none", "error": 1e-4}


def cells(*mechanisms, tags=("spatial",)):
    """What and cells of the only row, of mechanisms of these tags by how solvers stand on each."""
    made = [{"case": f"m{k}", "tags": list(tags), "at": at} for k, at in enumerate(mechanisms)]
    (row,) = by_kind({"rivals": {"mechanisms": made, "ranges": RANGES}})["rows"]
    return [row["what"], *row["cells"]]


def test_each_comparison_counts_once_within_its_range_of_errors():
    tight = LOST | {"error": 1e-8}
    assert cells([WON, WON | {"error": 1e-5}, tight], [LOST, WON | {"error": 1e-12}]) == [
        "other spatial mechanisms (2)",
        "`Taylor` 2, `heyoka` 1 of 3",
        "`heyoka` 1 of 1",
    ]
    assert cells([NEAR, NONE], [WON]) == ["other spatial mechanisms (2)", "`Taylor` 1, undecided 1 of 2", "not reached"]
    assert cells([NONE])[1:] == ["not reached", "not reached"]
    alone = WON | {"verdict": "unasked"}
    assert cells([WON, alone])[1] == "`Taylor` 1, reached by ours only (not all rivals run) 1 of 2"


def test_rivals_of_two_projects_that_take_as_long_are_undecided():
    tie = LOST | {"close": ["CyRK, DOP853"]}
    assert cells([tie, LOST])[1] == "`heyoka` 1, undecided 1 of 2"
    assert cells([WON | {"others": None, "close": ["CyRK, DOP853"]}])[1] == "`Taylor` 1 of 1"


def test_the_default_has_its_name_and_only_three_are_named():
    names = ("auto, compiled", "auto", "DOP853 (twoloop)", "DOP853, compiled", "Adams, compiled")
    at = [WON | {"ours": {"solver": name, "call_s": 0.1}} for name in names]
    _, loose, _ = cells([*at, at[0], at[1], at[2]])
    assert loose == "the default 2, `compiled=False` 2, `DOP853, compiled=False` 2, other solvers 2 of 8"


def test_briefly_only_the_most_often_fastest_are_named():
    other = WON | {"ours": {"solver": "Adams, compiled", "call_s": 0.1}}

    def brief(*at):
        made = [{"case": "m", "tags": ["spatial"], "at": list(at)}]
        return by_kind({"rivals": {"mechanisms": made, "ranges": RANGES}})["rows"][0]["brief"][0]

    assert brief(WON, WON, other, NEAR, NONE) == "`Taylor` 2 of 4"
    assert brief(WON, other, NEAR) == "`Taylor` 1, `Adams` 1, undecided 1 of 3" and brief(NEAR) == "undecided 1 of 1"


def test_kinds_are_told_by_the_first_of_their_tags():
    assert cells([WON], tags=("spatial", "redundant"))[0] == "redundant constraints (m0)"
    assert cells([WON], tags=("planar",))[0] == "other planar pendulums, chains and loops (m0)"
    assert cells([WON], tags=())[0] == "four-bar linkages, over 10 s (m0)"
    assert {"spatial", "redundant"} <= set(rivals.tags()[bricard().name])
    made = [{"case": f"A02, N = {n}", "tags": ["planar", "singular"], "at": [WON]} for n in (1, 2)]
    (row,) = by_kind({"rivals": {"mechanisms": made, "ranges": RANGES}})["rows"]
    assert row["what"] == "motion through singular positions (2 variants of one, A02)"


def test_driven_and_rolling_mechanisms_share_a_row_and_nothing_is_told_of_nothing():
    made = [{"case": tag, "tags": [tag], "at": [LOST]} for tag in ("driven", "non-holonomic")]
    (row,) = by_kind({"rivals": {"mechanisms": made, "ranges": RANGES}})["rows"]
    assert row["what"].endswith("(2)") and row["cells"][0] == "`heyoka` 2 of 2"
    assert by_kind({}) == {"errors": [], "rows": []}
    assert by_kind({"rivals": {"mechanisms": made}})["rows"] == []
