"""The table "your mechanism, take": who is named for a kind of mechanism, by how solvers stand on it."""

from studies.bench.takes import takes
from studies.work_precision import rivals
from twoloop.mechanisms import bricard


def told(*mechanisms, tags=("spatial",)):
    """The rows of a table of mechanisms of these tags, by how they stand at each error."""
    made = [{"case": f"{k}", "tags": list(tags), "at": at} for k, at in enumerate(mechanisms)]
    return takes({"work_precision": {"rivals": {"mechanisms": made}}}, [])


RUN, THEIRS = {"solver": "auto, compiled", "call_s": 0.1}, {"solver": "heyoka", "call_s": 0.05}
WON = {"ours": RUN, "others": None, "verdict": "alone", "error": 1e-4}
LOST, NEAR = WON | {"others": THEIRS, "verdict": "behind"}, WON | {"others": THEIRS, "verdict": "undecided"}


def test_of_a_kind_of_mechanism_it_is_counted_who_is_the_cheapest():
    """A mechanism has one vote, however many errors it has; who cannot be ranked has none."""
    (row,) = told([WON, WON, LOST], [WON])
    assert row == {"what": "other spatial mechanisms", "take": "`compiled=True` (2 of 2 mechanisms)"}
    ranked = {
        "`compiled=True` (2 of 3 mechanisms), `heyoka` (1)": ([WON, WON, LOST], [WON], [LOST] * 9),
        "no clear choice (of 2 mechanisms: `compiled=True` 1)": ([WON], [LOST, WON]),
        "no clear choice (of 3 mechanisms: `compiled=True` 1)": ([WON], [NEAR] * 3, [NEAR, WON]),
        "no clear choice (of 2 mechanisms: `compiled=True` 1, `heyoka` 1)": ([WON], [LOST]),
        "no clear choice": ([NEAR, NEAR],),
    }
    for said, mechanisms in ranked.items():
        assert told(*mechanisms)[0]["take"] == said
    assert told([WON], tags=("spatial", "redundant"))[0]["what"] == "redundant constraints"
    assert {"spatial", "redundant"} <= set(rivals.tags()[bricard().name])


def test_kinds_on_which_one_solver_is_the_cheapest_share_a_row():
    kinds = {"driven": [LOST], "non-holonomic": [LOST], "spatial": [WON], "planar": [LOST]}
    made = [{"case": kind, "tags": [kind], "at": at} for kind, at in kinds.items()]
    first, second = takes({"work_precision": {"rivals": {"mechanisms": made}}}, [])
    assert second["what"] == "other spatial mechanisms" and first["take"] == "`heyoka` (3 of 3 mechanisms)"
    assert first["what"] == "short smooth motion; driven by a given motion; rolling or a knife edge"


def test_where_motions_cross_singular_positions_sides_are_compared():
    tight = {**LOST, "error": 1e-6}
    (row,) = told([WON | {"verdict": "ahead", "others": THEIRS}, tight], [{**NEAR}, LOST], tags=("singular",))
    said = "another project's solver (our best is ahead in 1, behind in 2 comparisons)"
    assert row == {"what": "motion through singular positions", "take": said}


def test_of_stiff_springs_the_cheapest_is_told_by_error():
    at = [LOST, NEAR | {"error": 1e-5}, WON | {"error": 1e-6}, WON | {"error": 1e-7}]
    (row,) = told(at, tags=("stiff", "spatial"))
    assert row["take"] == "`heyoka` (1e-4), `compiled=True` (1e-6 to 1e-7)"


def test_of_beams_two_are_named_where_neither_is_cheaper():
    best = THEIRS | {"setting": "tol 0.10"}
    at = {"error": 1e-3, "verdict": "undecided", "best": best, "ours": {"solver": "TRBDF2"}, "others": THEIRS}
    found = {"cases": [{"name": "moderately stiff", "at": [at, at | {"error": 1e-4, "verdict": "behind"}]}]}
    (row,) = takes({"beam": found}, [])
    assert row["take"] == '`method="TRBDF2"` or `heyoka` (1e-3 m), `heyoka` (1e-4 m)'
    found["cases"][0]["at"] = [at | {"verdict": "behind", "ties": ["Adams"]}]
    assert takes({"beam": found}, [])[0]["take"] == '`heyoka` or `method="Adams"` (1e-3 m)'


def test_an_ode_is_advised_only_where_it_is_faster_more_often():
    minimal = {"kind": "pendulums", "n": 24, "n_behind": 23, "n_ahead": 1, "wrong_from": 0.1, "asked": 70}
    minimal["wrong_by"] = [{"solver": "CVODE, minimal", "n": 3, "asked": 50}]
    at = [{"verdict": verdict, "rival": {"solver": "CVODE, minimal"}} for verdict in ("behind", "ahead")]
    minimal["mechanisms"] = [{"at": at}]

    def told(**counts):
        return takes({"work_precision": {"minimal": [minimal | counts]}}, [])

    wrong = "`CVODE` silently wrong by over 0.10 in 3 of 50 runs, others in 0 of 20"
    said = f"faster in 23, slower in 1 of 24 comparisons; {wrong}"
    assert told() == [{"what": "pendulums", "take": f"an ODE in angles by `CVODE` ({said})"}]
    assert told(n_behind=1, n_ahead=23) == []
    (row,) = told(kind="loops", n_behind=12, n_ahead=11)
    assert row["what"] == "loops solvable in closed form" and row["take"].startswith("no clear choice (an ODE in ")
