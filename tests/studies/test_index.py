"""The list of studies, running them all, and the index of the reports."""

import json
import sys
from pathlib import Path

import pytest

from studies import __main__ as command
from studies import index
from studies.cli import StudyError


def test_the_list_names_every_study_with_its_first_line(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["studies"])
    command.main()
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(index.STUDIES) >= 5
    for name, line in zip(index.STUDIES, lines, strict=True):
        assert line.startswith(f"python -m studies.{name}") and line.endswith(".") and len(line) > 60


def test_unknown_words_are_refused(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["studies", "motoin"])
    with pytest.raises(SystemExit, match="given motoin, which is none of"):
        command.main()


def test_a_failing_study_is_named_and_the_others_run(monkeypatch, capsys):
    ran = []

    class Study:
        def __init__(self, name):
            self.name = name

        def main(self, words):
            ran.append((self.name, words))
            if self.name == "bad":
                raise RuntimeError("broken on purpose")

    def load(name):
        if name == "studies.missing":
            raise ImportError("no such package")
        return Study(name.removeprefix("studies."))

    monkeypatch.setattr(command, "STUDIES", ("good", "bad", "missing", "last"))
    monkeypatch.setattr(command.importlib, "import_module", load)
    monkeypatch.setattr(sys, "argv", ["studies", "all", "--quick"])
    with pytest.raises(SystemExit, match=r"2 of 4 studies failed.*bad, missing") as exit_:
        command.main()
    assert exit_.value.code not in (0, None)
    assert ran == [("good", ["--quick"]), ("bad", ["--quick"]), ("last", ["--quick"])]
    assert "broken on purpose" in capsys.readouterr().err


def test_one_study_runs_by_its_name(monkeypatch):
    ran = []
    monkeypatch.setattr(command.importlib, "import_module", lambda name: type("S", (), {"main": ran.append}))
    monkeypatch.setattr(sys, "argv", ["studies", "table3", "--quick"])
    command.main()
    assert ran == [["--quick"]]


REPORTS = Path(__file__).parents[2] / "reports"
BEST = {"solver": "ours", "cpu_s": 0.1, "cpu_q1": 0.1, "cpu_q3": 0.1, "n_evaluations": 1e5, "keeps": True}
BEST |= {"called_from": "compiled", "violation_q": 1e-15, "energy": -1e-3}
THEIRS = BEST | {"solver": "theirs", "cpu_s": 0.2, "keeps": False, "called_from": "Python", "n_evaluations": 1e4}
NOTHING = {"ours": None, "others": None, "ida": None, "default_over": None}


def at_error(error=1e-4, **changed):
    return {"error": error, "ours": BEST, "others": THEIRS, "ida": BEST | {"cpu_s": 0.3}, "default_over": 2.0} | changed


def case(**changed):
    """A case as `work_precision` finds it."""
    found = {"name": "crane", "tags": ["smooth"], "t_end": 1.0, "floor": 1e-9, "at": [at_error()]}
    found |= {"figure": "crane.png", "default_dominated": True, "default_over": [2.0, 3.0], "astray": []}
    return found | changed


def long_run(name, cpu_s, calm=True):
    run = BEST | {"name": name, "cpu_s": cpu_s, "calm": calm, "drifts": not calm, "energy": 2e-3, "drift": 0.1}
    return run | {"verdict": "no drift" if calm else "drifts", "n_evaluations": None}


def energy(**changed):
    """Findings of the study of energy."""
    none = {"ours": None, "others": None}
    free = {"ours": long_run("Gauss(3)", 2.0), "others": long_run("alpha", 3.0)}
    at = [{"energy": 0.02, "no_drift": free, "drift": none | {"others": long_run("LSODA", 1.0, calm=False)}}]
    long = {
        "case": "switching",
        "t_end": 1e4,
        "kinetic": 20.0,
        "at": at,
        "alternatives": [long_run("LSODA", 1.0, False)],
    }
    found = {"long": long, "sun": long_run("Sun", 1.0, calm=False), "canonical": long_run("Sun, momenta", 1.0)}
    return found | changed


def beam(differences_s, paper_s=4.5):
    at = {"error": 1e-4, "paper_s": paper_s, "differences_s": differences_s, "best": {"solver": "IDA", "cpu_s": 0.01}}
    return {"cases": [{"name": "moderately stiff", "at": [at]}]}


def screen(tmp_path, cases=(), dominated=(), **others):
    found = {"cases": list(cases), "dominated": list(dominated), "limit": 2.0, "default": "SunRadau5"}
    for path in tmp_path.glob("*.json"):
        path.unlink()
    if cases:
        others["work_precision"] = found
    for name, each in others.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(each))
    return index.first_screen(tmp_path, False)


def front(tmp_path, cases, **others):
    """The generated piece of the project's README."""
    screen(tmp_path, cases, **others)
    readme = tmp_path / "front.md"
    readme.write_text("<!-- generated: begin -->\n<!-- generated: end -->")
    index.put_in_readme(tmp_path, readme)
    return readme.read_text()


WORSE = {"solver": "slow", "by": "ours", "factor": 3.0, "n": 6, "called_from": "Python"}
WORSE |= {"case": "crane", "error": 1e-4, "cpu_s": 0.6, "by_s": 0.2, "evaluations": 1.5}


def test_the_first_screen_turns_with_the_findings(tmp_path):
    text = screen(tmp_path, [case()])
    assert "| smooth, rigid: crane, 1.0 s | 1e-4 | `ours` 0.10 | `theirs` (Python, drifts off) 0.20 |" in text
    assert "Cheapest of all: `ours` at 1 of the 1 error below." in text and "IDA takes 3.0 times" in text
    assert "20 and 1.0 µs an evaluation in the first class: compare the evaluations" in text
    near = THEIRS | {"n_evaluations": 4e5}
    assert "compare the evaluations" not in screen(tmp_path, [case(at=[at_error(others=near)])])

    faster = at_error(others=THEIRS | {"cpu_s": 0.05}, ida=None)
    text = screen(tmp_path, [case(at=[faster])])
    assert "5.0 and 1.0 µs an evaluation" in text and "Cheapest of all: `theirs` at 1" in text
    assert "IDA takes" not in text
    other = case(name="hoist", at=[at_error(), faster, at_error(error=1e-6)])
    text = screen(tmp_path, [other])
    assert "Cheapest of all: `ours` at 2 of the 3 errors below, `theirs` at 1." in text
    assert "IDA takes 3.0 times as long as our cheapest. It does not reach 1e-4 on hoist." in text
    text = screen(tmp_path, [case(at=[faster | {"ours": None}])])
    assert "| none reaches it | `theirs` (Python, drifts off) 0.050 |" in text
    text = screen(tmp_path, [case(at=[{"error": 1e-4, **NOTHING}], default_dominated=False, default_over=[])])
    assert "`SunRadau5`, reaches none of these errors on crane." in text
    assert "Cheapest of all: none reaches any of these errors." in text


def test_the_sentence_on_trust_is_computed(tmp_path):
    wrong = {"default": 0, "compiled": 3, "ours": 5, "others": 7}
    trust = {name: {"n": 50, "wrong": n, "unasked": 0} for name, n in wrong.items()}
    bad = {"ours_bad": [], "others_bad": [], "unasked": 0, "missed_by_all": []}
    honesty = bad | {"n_traps": 20, "forces": {"n_families": 15, "mechanisms": ["pendulum", "four-bar"]}, "trust": trust}
    text = front(tmp_path, [case()], honesty=honesty)
    assert "under 15 kinds of sharp everyday forces" in text and "on 2 mechanisms, and on 20 other traps" in text
    assert (
        "0 of 50 runs of the default, 3 of 50 of the compiled default, 5 of 50 of our other methods and 7 of 50" in text
    )
    assert "step over" not in text and "random mechanisms under such forces" not in text
    trust["default"] |= {"unasked": 2}
    sharp = {"n": 3000, "wrong and silent": 4}
    text = front(tmp_path, [case()], honesty=honesty, robustness={"sharp": sharp, "n_linkages": 9, "long": [], "silent": []})
    assert "; 2 more of the default step over a force of 1 ms." in text
    assert "Of 3000 runs of random mechanisms under such forces, by every preset, 4 are" in text
    assert "**Trust**" not in front(tmp_path, [case()])


def test_the_advice_turns_with_the_findings(tmp_path):
    text = front(tmp_path, [case()])
    assert "(crane): `ours` for 1e-4 (0.10 s; the cheapest of others takes 2.0 times as long). IDA takes 3.0" in text
    faster = at_error(others=THEIRS | {"cpu_s": 0.05}, ida=None)
    text = front(tmp_path, [case(at=[faster])])
    assert "IDA does not reach 1e-4" in text
    assert "`theirs` for 1e-4 (0.050 s; not ours and drifting off the constraints; our cheapest takes 2.0" in text
    assert "none of ours reaches it" in front(tmp_path, [case(at=[faster | {"ours": None}])])
    text = front(tmp_path, [case(at=[at_error(others=None), at_error(error=1e-2)])])
    assert "for 1e-4 and 1e-2 (0.10 s; the cheapest of others takes 2.0 times as long, where one reaches it)" in text
    assert "no other reaches it" in front(tmp_path, [case(at=[at_error(others=None)])])
    text = front(tmp_path, [case(at=[{"error": 1e-4, **NOTHING}], default_dominated=False, default_over=[])])
    assert "no solver compared reaches any of these errors" in text


def test_mechanisms_of_a_class_with_the_same_picks_are_told_together(tmp_path):
    other = case(name="hoist", at=[at_error(ours=BEST | {"cpu_s": 0.05}, ida=None)])
    text = front(tmp_path, [case(), other])
    assert "(crane; hoist): `ours` for 1e-4 (0.050 to 0.10 s; the cheapest of others takes 2.0 to 4.0 times" in text
    assert "IDA does not reach 1e-4 on hoist" in text
    text = front(tmp_path, [case(), case(name="hoist", at=[at_error(ours=BEST | {"solver": "mine"})])])
    assert "(crane): `ours`" in text and "(hoist): `mine`" in text


def test_solvers_beaten_everywhere_are_listed(tmp_path):
    text = screen(tmp_path, [case()], [WORSE])
    assert "takes at most 0.50 of their time" in text and "(worst first): `slow` (Python)." in text
    many = [WORSE | {"solver": f"slow {k}", "factor": 3.0 + k, "called_from": "compiled"} for k in range(10)]
    text = screen(tmp_path, [case()], many)
    assert "(the worst eight of 10): `slow 9`, `slow 8`" in text and "`slow 1`" not in text
    assert "No solver compared is dominated everywhere" in screen(tmp_path, [case()])


def test_picks_are_joined_where_the_solver_is_the_same():
    prices = ((2, 0.1), (4, 0.4), (6, 0.1))
    lines = [{"accuracy": f"1e-{k}", "ours": BEST | {"cpu_s": cpu}, "others": THEIRS} for k, cpu in prices]
    found = index.picks(lines)
    assert [(pick["solver"], pick["accuracies"]) for pick in found] == [
        ("ours", ["1e-2", "1e-6"]),
        ("theirs", ["1e-4"]),
    ]
    assert found[0]["over"] == pytest.approx([2.0, 2.0]) and found[1]["over"] == pytest.approx([2.0])
    assert index.picks([{"accuracy": "1e-2", "ours": None, "others": None}]) == []


def test_the_default_is_named_where_it_is_dominated(tmp_path):
    best = case(name="hoist", default_dominated=False, default_over=[1.0, 2.0])
    text = screen(tmp_path, [case(), best])
    assert "`SunRadau5`, is never the cheapest of ours on crane (× 2.0 to 3.0); is the cheapest of ours at one" in text
    assert "of these errors at least on hoist (elsewhere up to × 2.0)." in text
    assert "never" not in screen(tmp_path, [best])


def test_classes_come_in_their_order_and_the_long_one_from_the_energy(tmp_path):
    stiff = case(name="beam", tags=["stiff", "vibrations wanted"], at=[at_error(ours=BEST | {"energy": None})])
    other = case(name="robot", tags=["odd"])
    text = screen(tmp_path, [other, stiff, case()], energy=energy())
    places = [text.index(f"| {label}: ") for label in ("smooth, rigid", "stiff, vibrations wanted", "odd", index.LONG)]
    assert places == sorted(places)
    assert "| 0.020 J | `Gauss(3)` 2.0 | `LSODA` 1.0† |" in text and "†: its energy drifts" in text
    text = front(tmp_path, [case()], energy=energy())
    assert "`LSODA` for 0.020 J (1.0 s; not ours; our cheapest takes 2.0 times as long)." in text
    assert "Without drift: `Gauss(3)` for 0.020 J (2.0 s)." in text
    calm = energy()
    calm["long"]["alternatives"] = [long_run("Gauss(3)", 2.0)]
    calm["long"]["at"][0]["drift"]["others"] = None
    text = screen(tmp_path, [case()], energy=calm)
    assert "| 0.020 J | `Gauss(3)` 2.0 | `alpha` 3.0 |" in text and "†" not in text


def test_runs_out_of_phase_are_told_by_mechanism(tmp_path):
    run = {"solver": "loose", "setting": "tol", "value": 1e-3, "error_q": 0.5, "cpu_s": 0.1}
    finer = run | {"solver": "looser", "value": 1e-5}
    step = run | {"solver": "stepping", "setting": "h", "value": 1e-9}
    text = screen(tmp_path, [case(astray=[run, finer, step])])
    assert "(work_precision.csv)): 3 solvers on crane, `looser` even at tol = 1e-5." in text
    text = screen(tmp_path, [case(astray=[run]), case(name="hoist", astray=[run, finer])])
    assert "1 solver on crane, 2 on hoist, `looser` even at tol = 1e-5." in text
    assert "1 solver on crane, `stepping` even at h = 1e-9" in screen(tmp_path, [case(astray=[step])])
    assert "Out of phase" not in screen(tmp_path, [case()]) and "is out of phase" in screen(tmp_path, [case()])
    found = {"one_constant": True, "newmark_astray": ["1e-3"], "irk_astray": []}
    text = screen(tmp_path, [case()], table3=found)
    assert "(table3.md)): `PaperNewmark` with err_out = 1e-3." in text
    text = screen(tmp_path, [case()], table3=found | {"irk_astray": ["1e-3"]})
    assert "err_out = 1e-3, `PaperIRK` with err_out = 1e-3." in text
    assert "in phase with all settings" in screen(tmp_path, [case()], table3=found | {"newmark_astray": []})


def test_the_times_of_table_3_turn_with_the_findings(tmp_path):
    found = {"one_constant": False, "newmark_astray": [], "irk_astray": []}
    found |= {"irk_over": [8.0, 15.0], "newmark_over": [25.0, 30.0]}
    text = screen(tmp_path, [case()], table3=found)
    assert "not reproduced up to one factor: the paper's over ours is 8.0 to 30." in text
    assert "Table 3 are reproduced up to one factor" in screen(
        tmp_path, [case()], table3=found | {"one_constant": True}
    )


def claims(verdict):
    more = {"verdict": verdict, "linkage": [2.0, 6.0], "soft": [1.5, 3.0], "stiff": [0.3, 0.4]}
    counts = {"holds": 11, "holds in part": 7, "does not hold": 17}
    return {"claims": {"more_efficient": more}, "n": 40, "counts": counts}


def test_each_promise_has_its_opposite(tmp_path):
    text = screen(tmp_path, claims=claims("holds"))
    assert "holds on the linkage and both beams" in text and "Of 40 empirical claims 11 hold, 7 hold in part" in text
    text = screen(tmp_path, claims=claims("holds in part"))
    assert "holds in part; at equal error Newmark takes 2.0 to 6.0 times as long on the linkage, 1.5 to 3.0 on" in text
    assert "*More efficient than Newmark*: not run yet" in screen(tmp_path, claims=claims("not run"))

    kept = {"ours_keep": True, "irk_grows": False, "ours": [1e-15, 1e-15, 0.0], "t_end": 100.0}
    for change, says in (
        ({}, "drift*: holds;"),
        ({"irk_grows": True}, "holds in part"),
        ({"ours_keep": False}, "not hold"),
    ):
        assert says in screen(tmp_path, violation=kept | change).split("Constraints are kept")[1].splitlines()[0]

    assert "does not hold; in the paper's variables" in screen(tmp_path, energy=energy())
    assert "on momenta it does not." in screen(tmp_path, energy=energy())
    assert "over long times*: holds" in screen(tmp_path, energy=energy(sun=long_run("Sun", 1.0)))
    lost = long_run("Sun", 1.0) | {"calm": False, "verdict": "lost"}
    assert "with fixed steps is lost" in screen(tmp_path, energy=energy(sun=lost))

    assert "Newton's method by differences 0.020 s" in screen(tmp_path, beam=beam(0.02))
    assert "not decided; Newton's method with Jacobians by differences does not reach" in screen(
        tmp_path, beam=beam(None)
    )
    assert "holds against Newton's method by differences" in screen(tmp_path, beam=beam(9.0))
    assert "does not reach 0.10 mm" in screen(tmp_path, beam=beam(0.02, None))

    steps = {"holds": True, "longer": True, "irk": {"share_time": 0.99}, "long": 0.02, "ratios": [170.0, 270.0]}
    assert "Large steps*: holds; steps longer than 0.02 s cover all but 1.0 % of the time" in screen(
        tmp_path, step_size=steps
    )
    assert "Large steps*: does not hold" in screen(tmp_path, step_size=steps | {"longer": False})


def test_what_can_be_trusted_turns_with_the_findings(tmp_path):
    found = {"n": 21, "tight": 1e-10, "only_ours": ["a"], "only_others": [], "none_right": ["b", "c"], "not_put": ["d"]}
    text = screen(tmp_path, validation=found | {"n_wrong": {"ours": 1, "others": 57}})
    assert "right on 17, ours only on 1 (and on 1 not put to others), others only on 0" in text
    assert "1 of ours, 57 of others" in text
    traps = {"n_traps": 15, "ours_bad": [{}], "others_bad": [{}, {}], "missed_by_all": [], "unasked": 0}
    assert "wrong and silent, or hanging, runs: 1 of ours, 2 of others." in screen(tmp_path, honesty=traps)
    assert "; 3 more never evaluate the force in question." in screen(tmp_path, honesty=traps | {"unasked": 3})
    text = screen(tmp_path, honesty=traps | {"missed_by_all": ["pulse"]})
    assert "no solver notices: pulse." in text
    robust = {"n_linkages": 300, "long": [{}, {}], "silent": [{}]}
    text = screen(tmp_path, robustness=robust)
    assert "300 random linkages by 2 of our methods" in text and "1 runs are wrong and silent" in text
    assert "73 planted faults" in screen(tmp_path, planted_errors={"n": 73, "missed": ["x"]})


def test_a_study_that_has_not_run_is_said_to_be_missing(tmp_path):
    text = index.first_screen(tmp_path, False)
    for name in (
        "work_precision",
        "energy",
        "violation",
        "beam",
        "step_size",
        "claims",
        "table3",
        "validation",
        "honesty",
    ):
        assert f"not run yet (`python -m studies.{name}`)" in text
    assert text.count(": not run yet") + text.count("(not run yet:") == 14 + len(index.STUDIES)
    assert "Not judged by quick runs" in index.first_screen(tmp_path, True)
    (tmp_path / "beam.json").write_text("{")
    with pytest.raises(StudyError, match=r"beam.json cannot be read.*studies.beam again"):
        index.first_screen(tmp_path, False)


@pytest.mark.parametrize("report", sorted(REPORTS.glob("*.md")), ids=lambda path: path.stem)
def test_every_report_has_less_than_a_thousand_words(report):
    assert len(report.read_text(encoding="utf-8").split()) < 1000  # as `wc -w` counts


def test_the_readme_changes_between_its_marks_only(tmp_path):
    screen(tmp_path, [case()])
    readme = tmp_path / "README.md"
    readme.write_text("above\n<!-- generated: begin -->\nearlier\n<!-- generated: end -->\nbelow\n")
    index.put_in_readme(tmp_path, readme)
    text = readme.read_text()
    assert text.startswith("above\n") and text.endswith("\nbelow\n") and "earlier" not in text
    assert "`ours` for 1e-4 (0.10 s;" in text and "**The default**, `SunRadau5`, is never the cheapest" in text
    assert "Long and conservative problems: not run yet" in text
    with pytest.raises(StudyError, match="there is no work_precision"):
        index.put_in_readme(tmp_path / "nowhere", readme)
