"""The first screen, reports/README.md: which method to take, from the findings of all studies in the folder."""

import csv
import importlib
import json
import re
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from studies.bench import tables
from studies.bench.cli import StudyError
from studies.bench.headline import BEST
from studies.bench.kinds import by_kind
from studies.bench.render import number, power, render
from studies.bench.store import TIMED, WHOLE_CALL, Output
from studies.bench.takes import NEWEST, takes

# claims and compare_page read the others' rows
STUDIES = (
    *("linkage", "work_precision", "table3", "motion", "step_size", "violation", "energy", "beam", "validation"),
    *("ablation", "honesty", "robustness", "planted_errors", "symbolic_size", "sweep_linkages", "ensembles", "scale"),
    *("engines", "conformance"),
    "claims",
    "compare_page",
)
CLASSES = {  # tags of a case and the class of problem that they stand for, in the order of the first screen
    ("smooth",): "four-bar linkages, over long times",
    ("stiff", "vibrations irrelevant"): "stiff, vibrations irrelevant",
    ("stiff", "vibrations wanted"): "stiff, vibrations wanted",
}
LONG = "long and conservative"
ASKED_OF = {"beam": "beams by the error of the tip", "energy": "energy", "honesty": "sharp forces", "table3": "Table 3"}
ASKED_OF |= {"validation": "published mechanisms", "ensembles": "many runs in one call"}
WITH_RIVALS = (*ASKED_OF, "violation", "motion", "step_size", "scale", "conformance")
SOLVERS_OF_NEWEST = re.compile(rf'"{NEWEST}, [^",]*')
PROJECTS = {  # of the rivals of work_precision, and how their solvers are called in the rows of all studies
    "heyoka": re.compile("heyoka"),
    "CyRK": re.compile("CyRK"),
    "SUNDIALS": re.compile(r"(CVODE|IDA)\b"),
    "CasADi": re.compile("CasADi"),
    "diffrax": re.compile("diffrax"),
    "SciPy": re.compile("^(LSODA|DOP853|Radau|BDF), (index 1|projected)"),
    "extensisq": re.compile("Pr9"),
    "solve_dae": re.compile(", solve_dae"),
    "Exudyn": re.compile("Exudyn"),
}
AT_LENGTH = '"compare",'  # how rows of work_precision begin that are of long motions


def module_of(name: str) -> ModuleType:
    """The module of a study, a file or `study` in a folder."""
    found = importlib.import_module(f"studies.{name}")
    return importlib.import_module(f"studies.{name}.study") if hasattr(found, "__path__") else found


def run_study(name: str, words: Sequence[str]) -> None:
    """Run a study for a command line: the `STUDY` of its module, or its `main`."""
    module = module_of(name)
    getattr(module, "STUDY", module).main(words)


WHOSE = ("ours", "others")
COSTS = ("call_s", "called_from", "keeps")


def findings(folder: Path) -> dict[str, dict[str, Any]]:
    """What NAME.json of each study holds, for those that have been run into the folder and time what all time.

    In that of work_precision, "lacking" is what was not run with the newest rival, "long_without" the cases at length,
    "unasked" the projects that other studies lack, "one_asked" those of the latter with one solver of that rival.

    Raises StudyError if a file is damaged.
    """
    found = {}
    for path in (path for name in STUDIES if (path := folder / f"{name}.json").is_file()):
        try:
            told = json.loads(path.read_text())
        except ValueError as error:
            raise StudyError(f"{path} cannot be read ({error}); run python -m studies.{path.stem} again") from None
        if path.stem not in TIMED or told.get("timed") == WHOLE_CALL:  # others are to be run again
            found[path.stem] = told
    if "work_precision" in found:
        found["work_precision"] |= {"lacking": lacking(folder), "long_without": long_without(folder)}
        found["work_precision"] |= {"unasked": unasked(folder), "one_asked": one_asked(folder)}
    return found


def lacking(folder: Path) -> list[str]:
    """What the rows of a folder do not compare `NEWEST` on."""
    rows = {name: _lines(folder / f"{name}.csv") for name in ASKED_OF}
    told = {what: rows[name] for name, what in ASKED_OF.items()}
    without = [what for what, lines in told.items() if lines and not any(map(_has_newest, lines))]
    return ["some long motions"] * bool(long_without(folder)) + without


def unasked(folder: Path) -> dict[str, list[str]]:
    """Of the other studies with rivals, those of whose rows lack all solvers of a project, with the projects."""
    found: dict[str, list[str]] = {}
    for name in WITH_RIVALS:
        solvers = _solvers(_lines(folder / f"{name}.csv"))
        without = [project for project, named in PROJECTS.items() if not any(map(named.search, solvers))]
        found |= {name: without} if solvers and without else {}
    return found


def one_asked(folder: Path) -> list[str]:
    """The other studies with rivals that have one solver of `NEWEST` only."""
    named = {name: SOLVERS_OF_NEWEST.findall("\n".join(_lines(folder / f"{name}.csv"))) for name in WITH_RIVALS}
    return [name for name, own in named.items() if len(set(own)) == 1]


def _solvers(lines: Sequence[str]) -> set[str]:
    """Who made the rows of a file."""
    read = csv.DictReader(line for line in lines if not line.startswith("#"))
    column = next((each for each in ("solver", "simulator", "way") if each in (read.fieldnames or ())), None)
    return {row[column] for row in read} if column else set()


def long_without(folder: Path) -> list[str]:
    """The cases at length that the rows of a folder do not compare `NEWEST` on."""
    long = [line for line in _lines(folder / "work_precision.csv") if line.startswith(AT_LENGTH)]
    asked, there = ({line[1] for line in csv.reader(lines)} for lines in (long, filter(_has_newest, long)))
    return sorted(asked - there)


def _has_newest(line: str) -> bool:
    return NEWEST in line


def _lines(file: Path) -> list[str]:
    return file.read_text(encoding="utf-8").splitlines() if file.is_file() else []


def cases_of(found: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """The mechanisms compared, in the order of their classes."""
    known = list(CLASSES)
    cases: list[dict[str, Any]] = found["work_precision"]["cases"] if "work_precision" in found else []
    return sorted(cases, key=lambda case: [*known, tuple(case["tags"])].index(tuple(case["tags"])))


def classes(found: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """One entry a class of problem and mechanism: the cheapest of ours and of others at each accuracy."""
    made = []
    for case in cases_of(found):
        label = CLASSES.get(tuple(case["tags"]), ", ".join(case["tags"]) or "other")
        made.append(_entry(label, case, [_at_error(at) for at in case["at"]]))
    if "energy" in found:
        long = found["energy"]["long"]
        name = f"four-bar, {long['case']}, largest kinetic energy {number(long['kinetic'])} J"
        case = {"name": name, "t_end": long["t_end"]}
        made.append(_entry(LONG, case, [_at_energy(at, at["verdict"], "no_drift", "drift") for at in long["at"]]))
        made[-1]["without_drift"] = picks([_at_energy(at, at["no_drift"]["verdict"], "no_drift") for at in long["at"]])
    return made


def _entry(label: str, case: dict[str, Any], at: list[dict[str, Any]]) -> dict[str, Any]:
    made = {"class": label, "name": case["name"], "t_end": case["t_end"], "at": at, "picks": picks(at)}
    return made | {"without_drift": [], "processor": case.get("processor", "")}


def _at_error(at: dict[str, Any]) -> dict[str, Any]:
    """The line of a largest position error.

    times: of the default, the compiled default and the best of ours. neighbour: a rival that has no run within a
    decade of the error, and has one beside it that is cheaper than the cheapest of others.
    """
    line: dict[str, Any] = {"accuracy": power(at["error"]), "standing": at["standing"], **dict.fromkeys(WHOSE)}
    standing = at["standing"] or {}
    line["times"] = {who: stands["call_s"] for who, stands in standing.items()}
    line["undecided"] = bool(standing) and standing[BEST]["verdict"] == "undecided"
    for which in (which for which in WHOSE if at[which]):
        line[which] = {key: at[which][key] for key in COSTS} | {"solver": at[which]["solver"], "drifts": False}
    rival = standing.get(BEST, {}).get("rival") or {}
    cheaper = bool(rival.get("solver")) and (
        line["others"] is None or tables.LEAST * rival["call_s"] < line["others"]["call_s"]
    )
    return line | {"neighbour": rival if cheaper else None}


def _at_energy(at: dict[str, Any], verdict: str, *kinds: str) -> dict[str, Any]:
    """The line of a largest energy error, from runs with a drift, without, or both; `verdict`: on ours among these.

    What wanders is marked as what drifts.
    """
    line: dict[str, Any] = {"accuracy": f"{number(at['energy'])} J", "standing": None, **dict.fromkeys(WHOSE)}
    line |= {"times": at["times"], "neighbour": None}
    for which in WHOSE:
        runs = [at[kind][which] for kind in kinds if at[kind][which]]
        if runs:
            best = min(runs, key=lambda run: float(run["call_s"]))
            line[which] = {key: best[key] for key in COSTS} | {"solver": best["name"], "drifts": not best["calm"]}
    return line | {"undecided": verdict == "undecided"}


def picks(at: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The cheapest solvers of all, each with the accuracies at which it is that, and those where it may be another."""
    made: dict[str, dict[str, Any]] = {}
    for line in at:
        runs = [line[which] for which in WHOSE if line[which]]
        if runs:
            solver = min(runs, key=lambda run: float(run["call_s"]))["solver"]
            pick = made.setdefault(solver, {"solver": solver, "accuracies": [], "undecided": []})
            pick["accuracies"].append(line["accuracy"])
            pick["undecided"] += [line["accuracy"]] if line["undecided"] else []
    return list(made.values())


def rendered(template: str, found: dict[str, dict[str, Any]], **more: Any) -> str:
    """A template of what all studies found, with the classes of problems, what to take, and further names."""
    entries = classes(found)
    more |= {"classes": entries, "cases": cases_of(found), "takes": takes(found, entries)}
    more["by_kind"] = by_kind(found.get("work_precision", {}))
    return render(template, found, {}, default=found.get("work_precision", {}).get("default", ""), **more)


def first_screen(folder: Path, quick: bool) -> str:
    """The text of README.md of a folder of reports."""
    studies = []
    for name in STUDIES:
        about = (module_of(name).__doc__ or "").splitlines()[0].rstrip(".").split(":")[0]
        names = ("compare.html",) if name == "compare_page" else (f"{name}.md", f"{name}.png")
        files = [each for each in names if (folder / each).is_file()]
        studies.append({"name": name, "about": about, "file": files[0] if files else None})
    found = findings(folder)
    entries = classes(found)
    more: dict[str, Any] = {"studies": studies}
    told = [at[which] for entry in entries for at in entry["at"] for which in WHOSE if at[which]]
    more["from_python"] = any(best["called_from"] == "Python" for best in told)
    return rendered("index", found, quick=quick, docs="../docs/", reports=".", every=True, **more)


def write_index(output: Output) -> None:
    """Write README.md of the folder anew."""
    output.write("README.md", first_screen(output.path, output.call.quick))


def readme_block(found: dict[str, dict[str, Any]]) -> str:
    """The generated piece of the project's README."""
    return rendered("readme", found, docs="docs/", reports="reports", every=False)


def put_in_readme(folder: Path, readme: Path) -> None:
    """Write the generated piece of the project's README, between its two marks, from the findings in a folder."""
    found = findings(folder)
    if "work_precision" not in found:
        lacks = f"there is no work_precision.json in {folder} with times of the whole call"
        raise StudyError(f"{lacks}; run python -m studies.work_precision")
    begin, end = "<!-- generated: begin -->\n", "<!-- generated: end -->"
    before, rest = readme.read_text().split(begin, 1)
    readme.write_text(f"{before}{begin}{readme_block(found)}{end}{rest.split(end, 1)[1]}")
