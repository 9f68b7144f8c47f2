"""The list of studies, running them all, and the index of the reports."""

import json
import sys

import pytest

from studies import __main__ as command
from studies.bench import index
from studies.bench.cli import ROOT, StudyError
from studies.bench.solvers import CATALOGUE, OTHER_SOLVERS


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
    monkeypatch.setattr(index.importlib, "import_module", load)
    monkeypatch.setattr(sys, "argv", ["studies", "all", "--quick"])
    with pytest.raises(SystemExit, match=r"2 of 4 studies failed.*bad, missing") as exit_:
        command.main()
    assert exit_.value.code not in (0, None)
    assert ran == [("good", ["--quick"]), ("bad", ["--quick"]), ("last", ["--quick"])]
    assert "broken on purpose" in capsys.readouterr().err


def test_the_block_of_the_readme_is_written_by_its_name(monkeypatch):
    written = []
    monkeypatch.setattr(command, "put_in_readme", lambda folder, readme: written.append((folder.name, readme.name)))
    monkeypatch.setattr(sys, "argv", ["studies", "readme"])
    command.main()
    assert written == [("reports", "README.md")]


def test_one_study_runs_by_its_name(monkeypatch):
    ran = []
    monkeypatch.setattr(index.importlib, "import_module", lambda name: type("S", (), {"main": ran.append}))
    monkeypatch.setattr(sys, "argv", ["studies", "table3", "--quick"])
    command.main()
    assert ran == [["--quick"]]


BEST = {"solver": "ours", "call_s": 0.1, "call_q1": 0.1, "call_q3": 0.1, "n_evaluations": 1e5, "keeps": True}
BEST |= {"called_from": "compiled", "violation_q": 1e-15, "energy": -1e-3}
THEIRS = BEST | {"solver": "theirs", "call_s": 0.2, "keeps": False, "called_from": "Python", "n_evaluations": 1e4}
NOTHING = {"ours": None, "others": None, "standing": None}


def standing(call_s=0.1, verdict="ahead"):
    found = {"solver": "ours", "call_s": call_s, "ratio": 2.0, "interval": [1.5, 2.5], "verdict": verdict}
    return {name: dict(found) for name in ("the default", "auto", "auto, compiled", "best of ours")}


def at_error(error=1e-4, **changed):
    found = {"error": error, "ours": BEST, "others": THEIRS, "standing": standing()}
    return found | changed


def case(**changed):
    """A case as `work_precision` finds it."""
    found = {"name": "crane", "tags": ["smooth"], "t_end": 1.0, "floor": 1e-9, "at": [at_error()]}
    return found | {"figure": "crane.png"} | changed


def long_run(name, call_s, calm=True):
    run = BEST | {"name": name, "call_s": call_s, "calm": calm, "drifts": not calm, "energy": 2e-3, "drift": 0.1}
    return run | {"verdict": "no drift" if calm else "drifts", "n_evaluations": None}


def energy(**changed):
    """Findings of the study of energy."""
    none = {"ours": None, "others": None}
    free = {"ours": long_run("Gauss(3)", 2.0), "others": long_run("alpha", 3.0), "verdict": "ahead"}
    at = [
        {"energy": 0.02, "times": {}, "no_drift": free, "drift": none | {"others": long_run("LSODA", 1.0, calm=False)}}
        | {"verdict": "behind"}
    ]
    long = {
        "case": "switching",
        "t_end": 1e4,
        "kinetic": 20.0,
        "at": at,
        "alternatives": [long_run("LSODA", 1.0, False)],
    }
    found = {"long": long, "sun": long_run("Sun", 1.0, calm=False), "canonical": long_run("Sun, momenta", 1.0)}
    return found | changed


def screen(tmp_path, cases=(), standings=None, behind=None, **others):
    found = {"cases": list(cases), "default": "SunRadau5"}
    put = {"n": 21, "least": 8, "mechanisms": 23, "counts": 1.05, "nearly": 1.25}
    found |= {"rivals": {"standings": standings, "put": put, "behind": behind or {}}} if standings else {}
    for path in tmp_path.glob("*.json"):
        path.unlink()
    if cases:
        others["work_precision"] = found
    for name, each in others.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(each | {"timed": index.WHOLE_CALL}))
    return index.first_screen(tmp_path, False)


def front(tmp_path, cases, **others):
    """The generated piece of the project's README."""
    screen(tmp_path, cases, **others)
    readme = tmp_path / "front.md"
    readme.write_text("<!-- generated: begin -->\n<!-- generated: end -->")
    index.put_in_readme(tmp_path, readme)
    return readme.read_text()


def entries(cases, **others):
    """What the first screen is made of: one entry a class of problem and mechanism."""
    found = {"work_precision": {"cases": cases}} if cases else {}
    return index.classes(found | others)


def test_the_cheapest_are_found_among_ours_and_others():
    faster = at_error(others=THEIRS | {"call_s": 0.05})
    (entry,) = entries([case(name="hoist", at=[at_error(), faster, at_error(error=1e-6)])])
    assert [(pick["solver"], pick["accuracies"]) for pick in entry["picks"]] == [
        ("ours", ["1e-4", "1e-6"]),
        ("theirs", ["1e-4"]),
    ]
    for at, solvers in ((faster | {"ours": None}, ["theirs"]), ({"error": 1e-4, **NOTHING}, [])):
        assert [pick["solver"] for pick in entries([case(at=[at])])[0]["picks"]] == solvers


WHAT_MAY_BE_FOUND = {
    "nothing else": {},
    "no others": {"at": [at_error(others=None), at_error(error=1e-2)]},
    "others are faster": {"at": [at_error(others=THEIRS | {"call_s": 0.05})]},
    "none of ours": {"at": [at_error(ours=None)]},
    "none at all": {"at": [{"error": 1e-4, **NOTHING}]},
}


@pytest.mark.parametrize("changed", WHAT_MAY_BE_FOUND.values(), ids=WHAT_MAY_BE_FOUND)
def test_the_first_screen_and_the_advice_can_be_written_whatever_is_found(changed, tmp_path):
    """Templates raise on what is not defined."""
    cases = [case(**changed), case(name="hoist")]
    text = screen(tmp_path, cases, energy=energy()) + front(tmp_path, cases, energy=energy())
    assert "crane" in text and "nan" not in text and "None" not in text


def test_an_undecided_comparison_counts_as_a_win_for_neither_side(tmp_path):
    near = at_error(standing=standing(verdict="undecided"))
    assert "no clear choice (of 2 errors: " in screen(tmp_path, [case(at=[at_error(error=1e-2), near])])
    close = energy()
    close["long"]["at"][0]["verdict"] = "undecided"
    told = [entries([], energy=found)[0]["at"][0]["undecided"] for found in (close, energy())]
    assert told == [True, False]


def test_classes_come_in_their_order_and_the_long_one_from_the_energy():
    stiff = case(name="beam", tags=["stiff", "vibrations wanted"], at=[at_error(ours=BEST | {"energy": None})])
    made = entries([case(name="robot", tags=["odd"]), stiff, case()], energy=energy())
    named = ["four-bar linkages, over long times", "stiff, vibrations wanted", "odd", index.LONG]
    assert [entry["class"] for entry in made] == named
    (line,), (pick,), (free,) = made[-1]["at"], made[-1]["picks"], made[-1]["without_drift"]
    assert line["ours"]["solver"] == "Gauss(3)" and line["others"]["solver"] == "LSODA" and line["others"]["drifts"]
    assert pick["solver"] == "LSODA" and free["solver"] == "Gauss(3)"
    calm = energy()
    calm["long"]["at"][0]["drift"]["others"] = None
    line = entries([], energy=calm)[-1]["at"][0]
    assert line["others"]["solver"] == "alpha" and not line["others"]["drifts"]


TABLE3 = {"one_constant": False, "irk_over": [8.0, 15.0], "newmark_over": [25.0, 30.0]}
VALID = {
    "n": 21,
    "tight": 1e-10,
    "only_ours": [{"case": "a"}, {"case": "b"}],
    "only_others": [],
    "none_right": ["b", "c"],
}
VALID |= {"n_wrong": {"ours": 1, "others": 57}, "n_ended": {"ours": 500, "others": 300}}


def test_what_is_said_of_the_paper_turns_with_the_findings(tmp_path):
    claims = {"n": 40, "counts": {"holds": 11, "holds in part": 7, "does not hold": 17}}
    text = screen(tmp_path, claims=claims, table3=TABLE3)
    assert "Of 40 empirical claims, 11 hold, 7 hold in part and 17 do not hold. ([claims](claims.md))." in text
    claims["counts"] |= {"not reproduced (inputs assumed)": 4, "holds by construction": 1}
    told = (
        "17 do not hold. Of the rest, 4 are not reproduced, as inputs had to be assumed, 1 is true by construction. 38 "
    )
    text = screen(tmp_path, claims=claims | {"after": 38}, table3=TABLE3)
    assert f"{told}of the 40 criteria were chosen after the data had been seen ([claims](claims.md))." in text
    assert "not reproduced up to one factor: the ratio of the paper's to ours is 8.0 to 30." in text
    assert "are reproduced up to one factor" in screen(tmp_path, table3=TABLE3 | {"one_constant": True})


def test_what_can_be_trusted_is_counted(tmp_path):
    text = screen(tmp_path, validation=VALID)
    assert "one rival are right on 17, only ours on 2, only rivals on 0, none on 2." in text
    assert (
        "Of the runs of all solvers on these that report success, 1 of 500 of ours and 57 of 300 of rivals are wrong."
        in text
    )
    stopped = VALID | {"only_ours": [{"case": "a", "limit": ["x", "y"]}, {"case": "b", "limit": []}], "time_limit": 1.5}
    said = "only ours on 2 (where we stopped 2 of the rivals),"
    assert said in screen(tmp_path, validation=stopped)
    parts = {"singular": 51, "given": 45, "tight": {"elsewhere": 0}}
    text = screen(tmp_path, validation=VALID | {"wrong_others": parts, "usual": 1e-8})
    assert (
        "of rivals are wrong. 51 of the latter are at singular positions, 45 of these by solvers given accelerations, "
        "which are undefined there; none of the others is at 1e-8 or tighter." in text
    )
    by = {"solve_dae": 20, "known motion": 30, "bounds": 2, "tests": 20}
    planted = {"n": 73, "missed": ["x"], "by": by, "models": {"n": 20, "stopped": 12}}
    text = screen(tmp_path, planted_errors=planted)
    said = "- `solve_dae` refuses or stops 12 of the 20 faults that we planted in models; no check"
    assert f"{said} that we ran catches 1: x ([planted errors](planted_errors.md))." in text


def test_a_study_that_has_not_run_is_said_to_be_missing(tmp_path):
    text = index.first_screen(tmp_path, False)
    for name in ("work_precision", "energy", "claims", "table3", "validation", "honesty", "planted_errors"):
        assert f"not run yet (`python -m studies.{name}`)" in text
    assert index.first_screen(tmp_path, True) != text
    (tmp_path / "beam.json").write_text("{")
    with pytest.raises(StudyError, match=r"beam.json cannot be read.*studies.beam again"):
        index.first_screen(tmp_path, False)


def test_the_readme_changes_between_its_marks_only(tmp_path):
    screen(tmp_path, [case()])
    readme = tmp_path / "README.md"
    readme.write_text("above\n<!-- generated: begin -->\nearlier\n<!-- generated: end -->\nbelow\n")
    index.put_in_readme(tmp_path, readme)
    text = readme.read_text()
    assert text.startswith("above\n") and text.endswith("\nbelow\n") and "earlier" not in text
    assert "work_precision.png" in text and "`SunRadau5`" not in text
    with pytest.raises(StudyError, match="there is no work_precision"):
        index.put_in_readme(tmp_path / "nowhere", readme)


def test_each_of_default_and_best_stands_in_the_table_by_its_verdict(tmp_path):
    at = at_error()
    at["standing"] = standing(0.25, "behind") | {"best of ours": standing(0.1, "undecided")["best of ours"]}
    at["standing"]["the default"] |= {"verdict": "missed", "call_s": None, "ratio": None}
    line = next(line for line in screen(tmp_path, [case(at=[at])]).splitlines() if ": crane, 1.0 s" in line)
    assert [cell.strip() for cell in line.split("|")[3:6]] == [
        "–",
        "`ours` 0.10, undecided",
        "`theirs`‡ (Python) 0.20",
    ]


def test_the_counts_of_the_headline_stand_first(tmp_path):
    counts = {
        "ahead": 51,
        "behind": 123,
        "undecided": 20,
        "alone": 4,
        "missed": 2,
        "n": 200,
        "unbeaten": 4,
        "n_mechanisms": 23,
    }
    standings = [counts | {"name": name} for name in ("the default", "auto, compiled", "auto", "best of ours")]
    text = front(tmp_path, [case()], standings=standings)
    assert "another solver is usually faster." in text and "the constraints drift" not in text
    named = front(tmp_path, [case()], standings=standings, behind={"CyRK, DOP853": 9, "heyoka": 2})
    assert (
        "usually faster, most often `CyRK` or `heyoka`. In these comparisons they integrate accelerations, which"
        in named
    )
    standings[0] |= {"behind": 60}
    assert "usually faster" not in front(tmp_path, [case()], standings=standings)


def test_findings_of_other_times_than_the_whole_call_are_not_mixed_in(tmp_path):
    screen(tmp_path, [case()])
    path = tmp_path / "work_precision.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"timed": "inside"}))
    assert "not run yet (`python -m studies.work_precision`)" in index.first_screen(tmp_path, False)


def test_a_rival_that_older_rows_lack_is_told(tmp_path):
    for name, solver in (("beam", "heyoka"), ("energy", "CyRK, DOP853")):
        (tmp_path / f"{name}.csv").write_text(f"# line\nsolver\n{solver}\n")
    assert index.lacking(tmp_path) == ["beams by the error of the tip"]


def test_projects_of_rivals_that_a_study_leaves_out_are_told(tmp_path):
    for name in OTHER_SOLVERS:
        assert [each for each, named in index.PROJECTS.items() if named.search(name)] == [CATALOGUE[name].family]
    assert set(index.PROJECTS) == {CATALOGUE[name].family for name in OTHER_SOLVERS}
    (tmp_path / "motion.csv").write_text('# heyoka\n"solver","message"\n"IDA, stabilised","not CyRK"\n"BDF",""\n')
    (tmp_path / "conformance.csv").write_text('"simulator"\n' + "".join(f'"{name}"\n' for name in OTHER_SOLVERS))
    others = [project for project in index.PROJECTS if project != "SUNDIALS"]
    assert index.unasked(tmp_path) == {"motion": others}
    text = screen(tmp_path, [case()])
    assert f"| motion | {', '.join(others)} |" in text and "| conformance |" not in text
    assert "The solvers of motion were chosen" in text and "`max_step`, too" not in text
    (tmp_path / "motion.csv").unlink()
    assert "Rivals that studies leave out" not in screen(tmp_path, [case()])


def test_the_index_has_the_price_of_the_readme():
    block, text = ((ROOT / name).read_text(encoding="utf-8") for name in ("README.md", "reports/README.md"))
    price = block.split("**Price**")[1].split("**Silently wrong**")[0]
    assert f"**Price**{price}## Can it be trusted?" in text
