"""The first screen, reports/README.md: which method to take, from the findings of all studies in the folder."""

import importlib
import json
from pathlib import Path
from typing import Any

from studies.cli import Call, StudyError
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


def findings(folder: Path) -> dict[str, dict[str, Any]]:
    """What NAME.json of each study holds, for those that have been run into the folder."""
    found = {}
    for name in STUDIES:
        path = folder / f"{name}.json"
        if path.is_file():
            found[name] = json.loads(path.read_text())
    return found


def choice(cases: list[dict[str, Any]]) -> str:
    """The table of the first screen: case and error by the cheapest of ours and of others."""
    header = ["problem", "error", "ours", "CPU (s)", "evaluations", "violation", "energy error (J)"]
    header += ["other", "CPU (s)", "evaluations", "violation", "energy error (J)", "called from"]
    lines = []
    for case in cases:
        for at in case["at"]:
            line = [f"{case['name']} ({', '.join(case['tags'])})" if case["tags"] else case["name"], power(at["error"])]
            for which in ("ours", "others"):
                best = at[which]
                line += ["none reaches it", "", "", "", ""] if best is None else _cells(best)
            lines.append([*line, "" if at["others"] is None else str(at["others"]["called_from"])])
    return table(header, lines)


def _cells(best: dict[str, Any]) -> list[str]:
    drifts = "" if best["keeps"] else " (drifts)"
    values = (best[key] for key in ("cpu_s", "n_evaluations", "violation_q", "energy"))
    return [f"`{best['solver']}`{drifts}", *(number(value) for value in values)]


def first_screen(folder: Path, quick: bool) -> str:
    """The text of README.md."""
    found = findings(folder)
    studies = []
    for name in STUDIES:
        about = (importlib.import_module(f"studies.{name}").__doc__ or "").splitlines()[0]
        files = [f"{name}.{suffix}" for suffix in ("md", "png") if (folder / f"{name}.{suffix}").is_file()]
        studies.append({"name": name, "about": about, "file": files[0] if files else None})
    cases = found.get("work_precision", {}).get("cases", [])
    template = environment().get_template("index.md.j2")
    text = template.render(s=found, studies=studies, cases=cases, choice=choice(cases), quick=quick)
    while "\n\n\n" in text:
        text = text.replace("\n\n\n", "\n\n")
    return text.strip("\n") + "\n"


def write_index(output: Output) -> None:
    """Write README.md of the folder anew."""
    output.write("README.md", first_screen(output.path, output.call.quick))


def put_in_readme(folder: Path, readme: Path) -> None:
    """Write the generated piece of the project's README, between its two marks, from the findings in a folder."""
    cases = findings(folder).get("work_precision", {}).get("cases", [])
    if not cases:
        raise StudyError(f"there is no work_precision.json in {folder}; run python -m studies.work_precision")
    lines = []
    for case in cases:
        for at in case["at"]:
            best = (at[which] for which in ("ours", "others"))
            cells = [
                "none reaches it" if one is None else f"`{one['solver']}` {number(one['cpu_s'])} s" for one in best
            ]
            lines.append([case["name"], power(at["error"]), *cells])
    text = (
        environment()
        .get_template("readme.md.j2")
        .render(table=table(["problem", "error", "cheapest of ours", "cheapest of others"], lines), cases=cases)
    )
    begin, end = "<!-- generated: begin -->\n", "<!-- generated: end -->"
    before, rest = readme.read_text().split(begin, 1)
    readme.write_text(f"{before}{begin}{text.strip()}\n{end}{rest.split(end, 1)[1]}")


def _short(best: dict[str, Any] | None) -> str:
    return "none reaches it" if best is None else f"`{best['solver']}` {number(best['cpu_s'])} s"


def put_in_index(call: Call, name: str, title: str | None, text: str, line: str) -> None:
    """Write the first screen at the end of a study that is not on the bench yet."""
    with Output(call) as output:
        write_index(output)
