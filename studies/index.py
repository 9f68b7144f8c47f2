"""The first screen, reports/README.md: which method to take, from the findings of all studies in the folder."""

import importlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from studies.cli import StudyError
from studies.render import environment, number, power, table
from studies.store import Output

STUDIES = (
    "linkage",
    "work_precision",
    "table3",
    "motion",
    "step_size",
    "violation",
    "energy",
    "beam",
    "claims",
)  # claims reads the others' rows
CLASSES = {  # tags of a case and the class of problem that they stand for, in the order of the first screen
    ("smooth",): "smooth, rigid",
    ("stiff", "vibrations irrelevant"): "stiff, vibrations irrelevant",
    ("stiff", "vibrations wanted"): "stiff, vibrations wanted",
}
LONG = "long and conservative"
COSTS = ("solver", "cpu_s", "n_evaluations", "violation_q", "called_from", "keeps")


def findings(folder: Path) -> dict[str, dict[str, Any]]:
    """What NAME.json of each study holds, for those that have been run into the folder.

    Raises
    ------
    StudyError
        If a file is damaged.
    """
    found = {}
    for name in STUDIES:
        path = folder / f"{name}.json"
        if path.is_file():
            try:
                found[name] = json.loads(path.read_text())
            except ValueError as error:
                raise StudyError(f"{path} cannot be read ({error}); run python -m studies.{name} again") from None
    return found


def cases_of(found: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """The mechanisms compared, in the order of their classes."""
    known = list(CLASSES)
    cases = [(tuple(case["tags"]), case) for case in found.get("work_precision", {}).get("cases", [])]
    cases.sort(key=lambda pair: known.index(pair[0]) if pair[0] in known else len(known))
    return [case for _, case in cases]


def classes(found: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """One entry a class of problem and mechanism: the cheapest of ours and of others at each accuracy."""
    made = [
        _entry(
            CLASSES.get(tuple(case["tags"]), ", ".join(case["tags"]) or "other"), case, list(map(_at_error, case["at"]))
        )
        for case in cases_of(found)
    ]
    if "energy" in found:
        long = found["energy"]["long"]
        case = {"name": "four-bar, " + str(long["case"]), "t_end": long["t_end"]}
        made.append(_entry(LONG, case, [_at_energy(at) for at in long["at"]]))
    return made


def _entry(label: str, case: dict[str, Any], at: list[dict[str, Any]]) -> dict[str, Any]:
    ratios = [line["ida_s"] / line["ours"]["cpu_s"] for line in at if line["ida_s"] and line["ours"]]
    return {
        "class": label,
        "name": case["name"],
        "t_end": case["t_end"],
        "at": at,
        "picks": picks(at),
        "ida_over": [min(ratios), max(ratios)] if ratios else [],
        "ida_misses": [line["accuracy"] for line in at if line["ours"] and not line["ida_s"] and line["ida_told"]],
    }


def _at_error(at: dict[str, Any]) -> dict[str, Any]:
    """The line of a largest position error."""
    line: dict[str, Any] = {"accuracy": power(at["error"]), "ida_told": True}
    line["ida_s"] = at["ida"]["cpu_s"] if at["ida"] else None
    for which in ("ours", "others"):
        best = at[which]
        if best is not None:
            energy = "not conserved" if best["energy"] is None else number(abs(best["energy"]))
            best = {key: best[key] for key in COSTS} | {"energy": energy}
        line[which] = best
    return line


def _at_energy(at: dict[str, Any]) -> dict[str, Any]:
    """The line of a largest energy error, with a drift or without."""
    line: dict[str, Any] = {"accuracy": f"{number(at['energy'])} J", "ida_told": False, "ida_s": None}
    for which in ("ours", "others"):
        runs = [run for run in (at["no_drift"][which], at["drift"][which]) if run is not None]
        best = min(runs, key=lambda run: float(run["cpu_s"]), default=None)
        if best is not None:
            drift = "no drift" if best["calm"] else "drifts" if best["drifts"] else "irregular"
            energy = f"{number(best['energy'])} ({drift})"
            best = {key: best[key] for key in COSTS} | {"solver": best["name"], "energy": energy}
        line[which] = best
    return line


def picks(at: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The cheapest solvers of all, each with the accuracies at which it is that, and what the other kind costs."""
    made: list[dict[str, Any]] = []
    for line in at:
        runs = [(line[which]["cpu_s"], which) for which in ("ours", "others") if line[which] is not None]
        if not runs:
            continue
        which = min(runs)[1]
        best, other = line[which], line["others" if which == "ours" else "ours"]
        over = None if other is None else other["cpu_s"] / best["cpu_s"]
        pick = next((known for known in made if known["solver"] == best["solver"]), None)
        if pick is None:
            pick = {
                "solver": best["solver"],
                "keeps": best["keeps"],
                "ours": which == "ours",
                "accuracies": [],
                "over": [],
            }
            made.append(pick)
        pick["accuracies"].append(line["accuracy"])
        pick["over"] += [] if over is None else [over]
    return made


def choice(entries: Sequence[dict[str, Any]]) -> str:
    """The table of the first screen: two lines for each class of problem and accuracy, ours and others."""
    header = ["class of problem", "error", "cheapest", "CPU (s)", "evaluations", "max abs C", "energy error (J)"]
    lines = []
    for entry in entries:
        for k, at in enumerate(entry["at"]):
            label = f"{entry['class']}: {entry['name']}, {number(entry['t_end'])} s" if k == 0 else ""
            for which, whose in (("ours", "ours"), ("others", "other")):
                first = [label, at["accuracy"]] if which == "ours" else ["", ""]
                lines.append([*first, *_cells(whose, at[which])])
    return table([*header, "called from"], lines)


def _cells(whose: str, best: dict[str, Any] | None) -> list[str]:
    if best is None:
        return [f"{whose}: none reaches it", "", "", "", "", ""]
    evaluations = "not told" if best["n_evaluations"] is None else number(best["n_evaluations"])
    drifts = "" if best["keeps"] else " (drifts off)"
    costs = [number(best["cpu_s"]), evaluations, number(best["violation_q"])]
    return [f"{whose}: `{best['solver']}`{drifts}", *costs, best["energy"], best["called_from"]]


def dominated(found: dict[str, dict[str, Any]]) -> str:
    """The table of solvers that some one other beats everywhere, each with the row in which it does best."""
    header = [
        "solver",
        "called from",
        "beaten by",
        "errors",
        "time: at least",
        "where it does best",
        "CPU (s)",
        "against",
    ]
    lines = []
    for line in found.get("work_precision", {}).get("dominated", []):
        where = f"{power(line['error'])}, {line['case']}"
        cells = [
            f"`{line['solver']}`",
            line["called_from"],
            f"`{line['by']}`",
            line["n"],
            f"× {number(line['factor'])}",
        ]
        evaluations = "not told" if line["evaluations"] is None else f"× {number(line['evaluations'])}"
        lines.append([*cells, where, line["cpu_s"], line["by_s"], evaluations])
    return table([*header, "evaluations there"], lines) if lines else ""


def out_of_phase(found: dict[str, dict[str, Any]]) -> str:
    """The table of settings at which a solver is out of phase, the finest of each."""
    lines = []
    for case in cases_of(found):
        for run in case["astray"]:
            setting = f"{run['setting']} = {power(run['value'])}"
            lines.append([f"`{run['solver']}`", case["name"], setting, run["error_q"], run["cpu_s"]])
    return table(["solver", "mechanism", "finest such setting", "error", "CPU (s)"], lines) if lines else ""


def per_evaluation(entries: Sequence[dict[str, Any]]) -> dict[str, list[float]]:
    """Least and largest CPU time of an evaluation in µs in the table's first class, by what calls the mechanism."""
    times: dict[str, list[float]] = {}
    for entry in entries:
        for best in (at[which] for at in entry["at"] for which in ("ours", "others")):
            if entry["class"] == entries[0]["class"] and best is not None and best["n_evaluations"]:
                times.setdefault(best["called_from"], []).append(1e6 * best["cpu_s"] / best["n_evaluations"])
    return {called: [min(each), max(each)] for called, each in times.items()}


def _render(template: str, folder: Path, **more: Any) -> str:
    found = findings(folder)
    entries = classes(found)
    compared: dict[str, Any] = {"classes": entries, "cases": cases_of(found)}
    compared["default"] = found.get("work_precision", {}).get("default")
    text = environment().get_template(template).render(s=found, **compared, choice=choice(entries), **more)
    while "\n\n\n" in text:
        text = text.replace("\n\n\n", "\n\n")
    return text.strip("\n") + "\n"


def first_screen(folder: Path, quick: bool) -> str:
    """The text of README.md of a folder of reports."""
    studies = []
    for name in STUDIES:
        about = (importlib.import_module(f"studies.{name}").__doc__ or "").splitlines()[0]
        files = [f"{name}.{suffix}" for suffix in ("md", "png") if (folder / f"{name}.{suffix}").is_file()]
        studies.append({"name": name, "about": about, "file": files[0] if files else None})
    figure = (folder / "energy_cost.png").is_file()
    found = findings(folder)
    bad = {"dominated": dominated(found), "out_of_phase": out_of_phase(found)}
    times = per_evaluation(classes(found))
    return _render("index.md.j2", folder, studies=studies, quick=quick, energy_figure=figure, times=times, bad=bad)


def write_index(output: Output) -> None:
    """Write README.md of the folder anew."""
    output.write("README.md", first_screen(output.path, output.call.quick))


def put_in_readme(folder: Path, readme: Path) -> None:
    """Write the generated piece of the project's README, between its two marks, from the findings in a folder."""
    entries = classes(findings(folder))
    if "work_precision" not in findings(folder):
        raise StudyError(f"there is no work_precision.json in {folder}; run python -m studies.work_precision")
    lines = []
    for entry in entries:
        for at in entry["at"]:
            best = (at[which] for which in ("ours", "others"))
            cells = [
                "none reaches it" if one is None else f"`{one['solver']}` {number(one['cpu_s'])} s" for one in best
            ]
            lines.append([f"{entry['class']}: {entry['name']}", at["accuracy"], *cells])
    short = table(["class of problem", "error", "cheapest of ours", "cheapest of others"], lines)
    text = _render("readme.md.j2", folder, short=short)
    begin, end = "<!-- generated: begin -->\n", "<!-- generated: end -->"
    before, rest = readme.read_text().split(begin, 1)
    readme.write_text(f"{before}{begin}{text}{end}{rest.split(end, 1)[1]}")
