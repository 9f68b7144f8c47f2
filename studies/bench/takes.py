"""The table "your mechanism, take": what is the cheapest for a class of problem or a kind of mechanism, by its call."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

from studies.bench.render import listed, number
from studies.bench.solvers import COMPILED, DEFAULT
from twoloop.methods.presets import PRESETS

_UNDECIDED = "the default: no solver is told apart from the others"
DECIDED = ("ahead", "behind", "alone")  # verdicts by which one is the cheapest
SUFFIX = " (twoloop)"  # of our solvers, in the findings of honesty
KINDS = {  # tags of mechanisms, and what a user calls them
    "redundant": "redundant constraints",
    "spatial": "spatial",
    "driven": "driven by a given motion",
    "non-holonomic": "rolling, or sliding on an edge: non-holonomic",
}

OTHER_KINDS = {*KINDS, "singular", "stiff"}  # of which the table says more


def takes(found: Mapping[str, Any], groups: Sequence[Sequence[dict[str, Any]]]) -> list[dict[str, str]]:
    """For each class of problem (`groups`, those of `index.advice`) and kind of mechanism, what is the cheapest."""
    rows, made = [], found.get("work_precision", {})
    with_code = set(made.get("rivals", {}).get("with_code", []))
    for group in groups:
        coded = with_code.issuperset(entry["name"].partition(",")[0] for entry in group)  # whatever its lengths
        motions = "; ".join(f"{entry['name']}, {number(entry['t_end'])} s" for entry in group)
        what = f"{group[0]['class']} ({motions})"
        named = [(call(pick["solver"], coded), listed(pick["accuracies"])) for pick in group[0]["picks"]]
        picks = [f"{solver} for errors of {errors}" for solver, errors in named]
        open_at = dict.fromkeys(at for entry in group for pick in entry["picks"] for at in pick["undecided"])
        doubt = f" (undecided: {listed(open_at)})" if open_at else ""
        picks = picks or ["no solver compared reaches these errors"]
        free = group[0].get("without_drift", [])
        calm = [f"{call(pick['solver'])} for {listed(pick['accuracies'])}" for pick in free]
        without = f"; its energy drifts or wanders; without drift: {'; '.join(calm)}" if calm else ""
        rows.append({"what": what, "take": "; ".join(picks) + doubt + without})
    often = [*_often(made.get("first_calls", [])), *_at_once(found.get("ensembles", {}).get("cases", []))]
    mechanisms = made.get("rivals", {}).get("mechanisms", [])
    short = [each for each in mechanisms if each.get("tags") and not OTHER_KINDS & {*each["tags"]}]
    rows += [*_of_short_calls(short, with_code), *_of_kinds(mechanisms, with_code)]
    return rows + ([{"what": "run many times", "take": "; ".join(often)}] if often else [])


def _of_short_calls(mechanisms: Sequence[Mapping[str, Any]], with_code: set[str]) -> list[dict[str, str]]:
    """Who is the cheapest on the other smooth mechanisms, whose calls take milliseconds."""
    cheapest = Counter(_cheapest(each["at"]) for each in mechanisms)
    cheapest.pop("", None)
    if not cheapest:
        return []
    coded = with_code.issuperset(each["case"] for each in mechanisms)
    parts = [f"{call(solver, coded)} on {n}" for solver, n in cheapest.most_common()]
    times = [run["call_s"] for each in mechanisms for line in each["at"] if (run := _first(line))]
    least, most = number(1e3 * min(times)), number(1e3 * max(times))
    n, what = len(mechanisms), f"other smooth, rigid mechanisms, in calls of {least} to {most} ms"
    return [{"what": what, "take": f"of {n} mechanisms, the cheapest at most errors: {', '.join(parts)}"}]


def _first(line: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The cheapest of ours and of others at an error."""
    runs = [run for run in (line["ours"], line["others"]) if run]
    return min(runs, key=lambda run: run["call_s"], default=None)


def _of_kinds(mechanisms: Sequence[Mapping[str, Any]], with_code: set[str]) -> list[dict[str, str]]:
    """Of each kind who is the cheapest on all mechanisms; of the other kinds who is it on which mechanism."""
    open_kinds, told = [], set()
    closed: dict[str, list[tuple[str, set[str]]]] = defaultdict(list)
    others: dict[str, Sequence[Mapping[str, Any]]] = {}
    for kind, words in KINDS.items():
        own = [each for each in mechanisms if kind in each.get("tags", ())]
        these = [each["at"] for each in own]
        cheapest = Counter(_cheapest(at) for at in these)
        solver, n = max(cheapest.items(), key=lambda item: (item[0] != "", item[1]), default=("", 0))
        if solver and n == len(these):
            cases = {each["case"] for each in own}
            closed[solver].append((words, cases))
            told |= cases
        elif these:
            open_kinds.append(words)
            others |= {each["case"]: each["at"] for each in own}
    rows = []
    for solver, kinds in closed.items():
        every = set().union(*(cases for _, cases in kinds))
        n = len(every)
        said = f"{call(solver, with_code >= every)}, the cheapest at most errors on {n} of {n} such mechanisms"
        rows.append({"what": "; ".join(words for words, _ in kinds), "take": said})
    left = {case: at for case, at in others.items() if case not in told}
    by_solver: dict[str, list[str]] = defaultdict(list)
    for case, at in left.items():
        by_solver[_cheapest(at)].append(case)
    open_ones = by_solver.pop("", [])
    if open_kinds:
        ranked = sorted(by_solver.items(), key=lambda item: -len(item[1]))
        parts = [f"{call(solver, with_code.issuperset(cases))} on {listed(cases)}" for solver, cases in ranked]
        parts += [f"none is the cheapest at most errors on {listed(open_ones)}"] if open_ones else []
        rows.append({"what": "; ".join(open_kinds), "take": "; ".join(parts) if by_solver else _UNDECIDED})
    return rows


def _won(at: Sequence[Mapping[str, Any]]) -> Counter[str]:
    """At how many errors that any solver reaches on one mechanism each solver is the cheapest.

    Errors at which ours and others are not told apart, or others were not asked, count for "".
    """
    won: Counter[str] = Counter()
    for line in at:
        best, decided = _first(line), line["verdict"] in ("ahead", "behind", "alone", "missed")
        won.update([best["solver"] if decided else ""] if best else [])
    return won


def _cheapest(at: Sequence[Mapping[str, Any]]) -> str:
    """The cheapest solver at more than half of the errors on one mechanism; "" where there is none."""
    won = _won(at)
    solver, n = won.most_common(1)[0] if won else ("", 0)
    return solver if 2 * n > won.total() else ""


def _often(first_calls: Sequence[Mapping[str, Any]]) -> list[str]:
    """By which run what is built has paid, by the first calls: the default's code, and the cheapest later call."""
    paying = [line for line in first_calls if line["pays"] and line["solver"] != DEFAULT]
    cheapest = min(paying, key=lambda line: float(line["call_s"]), default=None)
    told = [line for line in paying if line["solver"] == f"{DEFAULT}, compiled" or line is cheapest]
    parts = [f"{_paid(line)}{', the cheapest later call' if line is cheapest else ''}" for line in told]
    return [f"in single calls with an error of 1e-8: {'; '.join(parts)}"] if parts else []


def _paid(line: Mapping[str, Any]) -> str:
    first, last = min(line["pays"]), max(line["pays"])
    by = f"run {first:.0f}" if first == last else f"run {first:.0f} to {last:.0f}"
    return f"code of {call(line['solver'])} pays from {by} on {line['n'] - line['never']} of {line['n']} mechanisms"


def _at_once(cases: Sequence[Mapping[str, Any]]) -> list[str]:
    """Who is the cheapest at most errors where many runs are one call, by mechanism."""
    by_way: dict[str, list[str]] = {}
    for each in cases:
        won = Counter(min(at["run_s"], key=at["run_s"].get) if at["verdict"] in DECIDED else "" for at in each["at"])
        if won:
            by_way.setdefault(won.most_common(1)[0][0], []).append(each["case"])
    ways = sorted(by_way.items(), key=lambda item: (item[0] == "", -len(item[1])))
    parts = [f"{f'`{way}`' if way else 'undecided'} on {listed(names)}" for way, names in ways]
    return [f"in one call {', '.join(parts)}"] if any(by_way) else []


def call(solver: str, coded: bool = False) -> str:
    """How a user asks for a solver of the reports: the argument of `solve_dae` where there is one.

    `coded`: on mechanisms for which the default makes code.
    """
    name, _, compiled = solver.removesuffix(SUFFIX).partition(", ")
    if name not in PRESETS or compiled not in ("", "compiled"):
        return f"`{solver}`"
    words = [] if name == DEFAULT else [f'method="{name}"']
    if name in COMPILED.values() and bool(compiled) is not coded:
        words.append(f"compiled={bool(compiled)}")
    return f"`{', '.join(words)}`" if words else "the default"
