"""The table "for, take": who is named for beams, in minimal coordinates, for energies and for many runs."""

import pytest

from studies.bench.takes import NO_ANGLES, takes

THEIRS = {"solver": "heyoka", "call_s": 0.05}
MATRICES = "SUNDIALS had dense matrices, ours are banded"


def test_of_beams_two_are_named_where_neither_is_cheaper():
    best = THEIRS | {"setting": "tol 0.10"}
    at = {"error": 1e-3, "verdict": "undecided", "best": best, "ours": {"solver": "TRBDF2"}, "others": THEIRS}
    found = {"cases": [{"name": "moderately stiff", "at": [at, at | {"error": 1e-4, "verdict": "behind"}]}]}
    (row,), stiff = takes({"beam": found}, []), "stiff, vibrations irrelevant"
    assert row["what"] == "beams, by the error of the tip (tolerances chosen afterwards, up to 0.10)"
    assert row["take"] == f'{stiff}: `method="TRBDF2"` or `heyoka` (1e-3 m), `heyoka` (1e-4 m); {MATRICES}'
    assert takes({"beam": found | {"banded": True}}, [])[0]["take"] == row["take"].removesuffix(f"; {MATRICES}")
    found["cases"][0]["at"] = [at | {"verdict": "behind", "ties": ["Adams"]}]
    assert takes({"beam": found}, [])[0]["take"] == f'{stiff}: `heyoka` or `method="Adams"` (1e-3 m); {MATRICES}'


def test_rows_that_lack_the_newest_rival_say_so():
    at = {"error": 1e-3, "verdict": "ahead", "best": THEIRS | {"setting": "tol 0.10"}}
    found = {"beam": {"cases": [{"name": "very flexible", "at": [at]}]}}
    found["work_precision"] = {"lacking": ["beams by the error of the tip"]}
    assert takes(found, [])[0]["take"].endswith(f"`heyoka` (1e-3 m); {MATRICES}; without `CyRK`")
    pick = {"solver": "CyRK, DOP853", "accuracies": ["1e-2"], "undecided": []}
    entry = {"class": "stiff, vibrations wanted", "name": "very flexible beam", "t_end": 2.0, "picks": [pick]}
    told = takes(found, [entry])[0]["take"]
    assert told.endswith(
        "without `CyRK`, which is the fastest on the very flexible beam by the error of all coordinates"
    )


def minimal(kind, wrong=(), **mechanisms):
    """Findings in minimal coordinates, from verdicts at three errors."""
    n = sum(map(len, mechanisms.values()))
    n_behind = sum(verdict == "behind" for verdicts in mechanisms.values() for verdict in verdicts)
    told = {"n": n, "n_behind": n_behind, "kind": kind, "wrong_by": list(wrong), "wrong_from": 0.1, "mechanisms": []}
    for name, verdicts in mechanisms.items():
        at = [{"verdict": verdict, "ratio": 1.0, "rival": {"solver": "heyoka, minimal"}} for verdict in verdicts]
        told["mechanisms"].append({"case": name, "at": at})
    return told


def test_an_ode_in_angles_is_told_by_counts():
    loops = minimal("loops", crank=["behind"] * 3, slider=["behind", "undecided", "ahead"])
    wrong = {"solver": "heyoka, minimal", "n": 3, "asked": 14}
    pendulums = minimal("pendulums", [wrong], one=["behind"] * 3, two=["behind"] * 3)
    (row,) = takes({"work_precision": {"minimal": [loops, pendulums]}}, [])
    assert row["take"] == (
        "an ODE in angles by `heyoka` (loops: faster than our best in 4 of 6 comparisons; "
        "pendulums: faster than our best in 6 of 6 comparisons; "
        "`heyoka` is silently wrong by over 0.10 in 3 of 14 runs of pendulums)"
    )
    assert takes({"work_precision": {"minimal": []}}, []) == []


@pytest.mark.parametrize(
    ("ratios", "close"), [((2.0, 1.6, 0.5), ""), ((1.2, 1.6, 0.9), "; 2 of these 3 by less than 1.5 times")]
)
def test_of_ensembles_it_is_said_how_many_are_close(ratios, close):
    at = [{"verdict": "ahead" if ratio > 1.0 else "behind", "ratio": ratio, "rival": "heyoka"} for ratio in ratios]
    (row,) = takes({"ensembles": {"cases": [{"at": [*at, {"verdict": "none", "ratio": None}]}]}}, [])
    assert row["take"] == f"`ensemble` (ahead of all that ran in 2, behind in 1 of 3 comparisons{close}); {NO_ANGLES}"


@pytest.mark.parametrize(("over", "times"), [([7.0, 10.0], ", at 7.0 to 10 times the time"), (None, "")])
def test_of_the_energy_it_is_said_what_a_run_without_a_drift_takes(over, times):
    pick = {"solver": "Taylor, compiled", "accuracies": ["1 J"], "undecided": []}
    level = {**pick, "solver": "Gauss(3), symmetric partition"}
    entry = {"class": "long and conservative", "t_end": 1e4, "picks": [pick], "without_drift": [level]}
    found = {"energy": {"long": {"calm_ours": {"over_drifting": over}}}}
    told = takes(found, [entry])[0]["take"]
    assert told.endswith(f"(drifts); without a visible drift `Gauss(3), symmetric partition`{times}; {NO_ANGLES}")


def test_runs_timed_once_are_not_ranked_but_their_times_are_told():
    pick = {"solver": "auto, compiled", "accuracies": ["1 J"], "undecided": ["1 J"]}
    entry = {"class": "long and conservative", "t_end": 1e4, "picks": [pick], "without_drift": []}
    sides = [
        {"ours": {"solver": "auto, compiled", "call_s": own}, "others": {"solver": "heyoka", "call_s": other}}
        for own, other in ((0.3, 1.4), (0.4, 2.0))
    ]
    long = {
        "at": [{"drift": each, "energy": energy} for each, energy in zip(sides, (2e-4, 2e-6), strict=True)],
        "repeats": 1,
    }
    told = takes({"energy": {"long": long}, "work_precision": {"rivals": {"with_code": ["four-bar"]}}}, [entry])
    assert told[0]["take"] == (
        f"not ranked, as timed once: the default 0.40 s and `heyoka` 2.0 s for at most 2e-6 J (both drift); {NO_ANGLES}"
    )
    assert takes({"energy": {"long": long | {"repeats": 5}}}, [entry])[0]["take"] == "no clear choice"
