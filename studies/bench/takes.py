"""The table "your mechanism, take": what is the cheapest for a class of problem or a kind of mechanism, by its call."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from operator import itemgetter
from typing import Any

from studies.bench.names import call
from studies.bench.render import listed, number, one_digit, power
from studies.bench.solvers import DEFAULT, HEYOKA

DECIDED = ("ahead", "behind", "alone", "missed")  # verdicts by which one solver is the cheapest
NAMED = 2  # of ours, the most often cheapest, at singular positions
TIGHTEST = 1e-9  # error down to which advice by error goes; the report has all
SMOOTH, STIFF, SINGULAR, LONG = "short smooth motion", "stiff", "singular", "long and conservative"
FOUR_BARS = "four-bar linkages, over 10 s"  # which have no tags
KINDS = {  # tags of mechanisms, and what a user calls them; a mechanism of several counts for the first
    STIFF: "stiff springs and dampers",
    SINGULAR: "motion through singular positions",
    "driven": "driven by a given motion",
    "non-holonomic": "rolling or a knife edge",
    "redundant": "redundant constraints",
    "spatial": "other spatial mechanisms",
}
IN_ANGLES = {"loops": "loops solvable in closed form", "pendulums": "pendulums"}  # what a user calls these
BEAMS = {  # of the study of the beam, and their classes
    "moderately stiff": "stiff beam (tip), vibrations irrelevant",
    "very flexible": "flexible beam (tip), vibrations wanted",
}
NONE, UNCLEAR = "no solver compared reaches these errors", "no clear choice"
BEAM_CLASSES = ("stiff, vibrations irrelevant", "stiff, vibrations wanted")  # which the beam's report judges by the tip


def takes(found: Mapping[str, Any], entries: Sequence[dict[str, Any]]) -> list[dict[str, str]]:
    """For each class of problem (`entries`, those of `index.classes`) and kind of mechanism, what is the cheapest."""
    made = found.get("work_precision", {})
    rivals = made.get("rivals", {})
    with_code = set(rivals.get("with_code", []))
    classes: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for entry in entries:
        classes[entry["class"]].append(entry)
    rows = _of_kinds(rivals, with_code)
    rows += [_of_class(name, own, with_code) for name, own in classes.items() if name not in (*BEAM_CLASSES, LONG)]
    rows += [_by_the_tip(case) for case in found.get("beam", {}).get("cases", []) if case["name"] in BEAMS]
    rows += [_of_energy(entry, coded(("four-bar",), with_code)) for entry in classes[LONG]]
    rows += _at_once(found.get("ensembles", {}).get("cases", []))
    paying = (f"{DEFAULT}, compiled", HEYOKA)
    paid = [_paid(line) for line in made.get("first_calls", []) if line["pays"] and line["solver"] in paying]
    singly = {"what": "many single calls", "take": f"{' and '.join(paid)}, against `compiled=False`"}
    in_angles = [row for each in made.get("minimal", []) for row in _in_angles(each)]
    return rows + [singly] * bool(paid) + in_angles


def coded(cases: Iterable[str], with_code: set[str]) -> bool | None:
    """Whether the default makes code for mechanisms; None: for some of them."""
    made = {case in with_code for case in cases}
    return made.pop() if len(made) == 1 else None


def _of_class(name: str, entries: Sequence[dict[str, Any]], with_code: set[str]) -> dict[str, str]:
    """At how many errors, on all mechanisms of a class, each solver is the cheapest."""
    made = coded((entry["name"].partition(",")[0] for entry in entries), with_code)  # whatever its lengths
    won: Counter[str] = Counter()
    for pick in (pick for entry in entries for pick in entry["picks"]):
        won.update({pick["solver"]: len(pick["accuracies"]) - len(pick["undecided"]), "": len(pick["undecided"])})
    times = listed(dict.fromkeys(number(entry["t_end"]) for entry in entries))
    names = list(dict.fromkeys(entry["name"] for entry in entries))
    alike = len(names) > 1 and len({each.partition(",")[0] for each in names}) == 1
    what = f"{name} ({f'{len(names)} geometries' if alike else listed(names)}, {times} s)"
    return {"what": what, "take": _shares(won, "errors", made) or NONE}


def _shares(won: Mapping[str, int], of: str, made: bool | None) -> str:
    """Each solver with how often it is the cheapest ("": none is told from the others), the most often first."""
    total, ranked = sum(won.values()), sorted(won.items(), key=lambda item: -item[1])
    counts = [(call(solver, made), n) for solver, n in ranked if solver and n]
    if counts and 2 * counts[0][1] <= total:
        return f"no clear choice (of {total} {of}: {', '.join(f'{who} {n}' for who, n in counts)})"
    said = [f"{who} ({n}{'' if k else f' of {total} {of}'})" for k, (who, n) in enumerate(counts)]
    return ", ".join(said) or ("no clear choice" if total else "")


def _by_the_tip(case: Mapping[str, Any]) -> dict[str, str]:
    """The cheapest on a beam by the error of its tip; several where none is clearly cheaper."""
    by: dict[frozenset[str], list[str]] = defaultdict(list)
    words: dict[frozenset[str], str] = {}
    for at in case["at"]:
        if at["best"] is not None:
            undecided = at.get("verdict") == "undecided"
            names = [at[which]["solver"] for which in (("ours", "others") if undecided else ("best",))]
            either = dict.fromkeys((*names, *at.get("ties", ())))
            who = frozenset(either)
            words.setdefault(who, " or ".join(call(name, False) for name in either))
            by[who].append(f"{power(at['error'])} m")
    take = ", ".join(f"{words[who]} ({', '.join(errors)})" for who, errors in by.items())
    return {"what": BEAMS[case["name"]], "take": take or NONE}


def _of_energy(entry: Mapping[str, Any], made: bool | None) -> dict[str, str]:
    """The cheapest for an error of the energy over a long time, and the cheapest whose energy does not drift."""
    told = [_decided(entry[which], made) for which in ("picks", "without_drift")]
    drifts = " (drifts)" if told[0] != UNCLEAR else ""
    without = f"{drifts}; without drift {told[1]}" if entry["without_drift"] and told[1] != UNCLEAR else ""
    what = f"energy over {power(entry['t_end'])} s (four-bar)"
    return {"what": what, "take": told[0] + without}


def _decided(picks: Sequence[Mapping[str, Any]], made: bool | None) -> str:
    """The solvers that are the cheapest wherever this is decided."""
    names = [call(pick["solver"], made) for pick in picks if len(pick["undecided"]) < len(pick["accuracies"])]
    return listed(dict.fromkeys(names)) if names else UNCLEAR if picks else NONE


def _of_kinds(rivals: Mapping[str, Any], with_code: set[str]) -> list[dict[str, str]]:
    """Of each kind of mechanism who is the cheapest; kinds on most of whose mechanisms one solver is, in one row."""
    kinds: dict[str, list[Mapping[str, Any]]] = {kind: [] for kind in ("", *KINDS, FOUR_BARS)}
    for each in rivals.get("mechanisms", []):
        kinds[next((kind for kind in KINDS if kind in each["tags"]), "") if each["tags"] else FOUR_BARS].append(each)
    groups: dict[str, list[str]] = defaultdict(list)
    rows = []
    for kind, own in kinds.items():
        if kind == SINGULAR and own:
            rows.append({"what": KINDS[kind], "take": _crossed(rivals, own)})
        elif kind == STIFF and own:
            names = [each["case"].removeprefix("A05 ") for each in own]  # its number among IFToMM's benchmarks
            rows += [
                {"what": f"{KINDS[kind]} ({name})", "take": _by_error(each["at"], coded((each["case"],), with_code))}
                for name, each in zip(names, own, strict=True)
            ]
        elif kind == FOUR_BARS and own:
            won = Counter(_cheapest(each["at"]) for each in own)
            made = coded((each["case"] for each in own), with_code)
            rows.append({"what": kind, "take": _shares(won, "geometries", made)})
        elif own:
            most = Counter(_cheapest(each["at"]) for each in own).most_common(1)[0]
            groups[most[0] if 2 * most[1] > len(own) else ""].append(kind)
    first = []
    for of in (kinds_of for _, kinds_of in sorted(groups.items(), key=lambda item: not item[0])):
        these = [each for kind in of for each in kinds[kind]]
        won = Counter(_cheapest(each["at"]) for each in these)
        made = coded((each["case"] for each in these), with_code)
        words = "; ".join(KINDS.get(kind, SMOOTH) for kind in of)
        first.append({"what": words, "take": _shares(won, "mechanisms", made)})
    return first + rows


def _crossed(rivals: Mapping[str, Any], own: Sequence[Mapping[str, Any]]) -> str:
    """Who is ahead where the motion crosses singular positions."""
    verdicts = [at["verdict"] for each in own for at in each["at"]]
    ahead, behind = verdicts.count("ahead"), verdicts.count("behind")
    ranges = {each["name"].partition(" ")[0]: each["standings"][0] for each in rivals.get("ranges", [])}
    default = ""
    if SINGULAR in ranges:
        default = "; {missed} errors the default does not reach".format(**ranges[SINGULAR])
    won = Counter(at["ours"]["solver"] for each in own for at in each["at"] if at["verdict"] in ("ahead", "alone"))
    made = coded((each["case"] for each in own), set(rivals.get("with_code", [])))
    named = " or ".join(call(name, made) for name, _ in won.most_common(NAMED))
    whose = (named or "one of ours") if ahead > behind else "another project's solver"
    return f"{whose} (our best is ahead in {ahead}, behind in {behind} comparisons{default})"


def _by_error(at: Sequence[Mapping[str, Any]], made: bool | None) -> str:
    """The cheapest from one error to another down to TIGHTEST, in order; where none is, nothing is told."""
    reached = [(line, run) for line in at if line["error"] > 0.9 * TIGHTEST and (run := _first(line))]
    told = [(call(run["solver"], made) if line["verdict"] in DECIDED else "", line["error"]) for line, run in reached]
    spans: dict[str, list[str]] = defaultdict(list)
    for who, errors in ((who, [error for _, error in own]) for who, own in groupby(told, key=itemgetter(0))):
        spans[who] += [power(errors[0]) + (f" to {power(errors[-1])}" if len(errors) > 1 else "")]
    said = [f"{who} ({', '.join(own)})" for who, own in spans.items() if who]
    return ", ".join(said) or NONE


def _first(line: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The cheapest of ours and of others at an error."""
    runs = [run for run in (line["ours"], line["others"]) if run]
    return min(runs, key=lambda run: run["call_s"], default=None)


def _cheapest(at: Sequence[Mapping[str, Any]]) -> str:
    """The cheapest solver at more than half of the errors that any solver reaches on a mechanism; "": there is none.

    Errors at which ours and others cannot be ranked, or others were not run, count for none.
    """
    won: Counter[str] = Counter()
    for line in at:
        best = _first(line)
        won.update([best["solver"] if line["verdict"] in DECIDED else ""] if best else [])
    solver, n = won.most_common(1)[0] if won else ("", 0)
    return solver if 2 * n > won.total() else ""


def _at_once(cases: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Whether an ensemble is ahead of others' batches where many runs are one call."""
    verdicts = Counter(at["verdict"] for each in cases for at in each["at"] if at["verdict"] != "none")
    ahead, behind = verdicts["ahead"], verdicts["behind"]
    if not ahead + behind:
        return []
    who, other = ("`ensemble`", "heyoka's batches") if ahead > behind else ("`heyoka`, batches", "`ensemble`")
    told = f"ahead of {other} in {max(ahead, behind)}, behind in {min(ahead, behind)} of {verdicts.total()} comparisons"
    return [{"what": "many runs in one call", "take": f"{who} ({told})"}]


def _paid(line: Mapping[str, Any]) -> str:
    """After about how many runs code has paid, to one digit: single first calls scatter."""
    first, last = one_digit(min(line["pays"])), one_digit(max(line["pays"]))
    after = first if first == last else f"{first} to {last}"
    on = f" on {line['n'] - line['never']} of {line['n']} mechanisms" if line["never"] else ""
    return f"{call(line['solver'])} after some {after} calls{on}"


def _in_angles(minimal: Mapping[str, Any]) -> list[dict[str, str]]:
    """An ODE in minimal coordinates beside our best with constraints, on the mechanisms of a kind."""
    if not minimal["n"] or minimal["n_behind"] <= minimal["n_ahead"]:
        return []
    faster = (at for each in minimal["mechanisms"] for at in each["at"] if at["verdict"] == "behind")
    by = Counter(at["rival"]["solver"].partition(",")[0] for at in faster)
    slower = f", slower in {minimal['n_ahead']}" if minimal["n_ahead"] else ""
    told = f"faster in {minimal['n_behind']}{slower} of {minimal['n']} comparisons"
    start = " from horizontal rest" if minimal.get("level") else ""  # where terms of heyoka's series vanish
    for each in minimal["wrong_by"]:
        wrong = f"silently wrong by over {number(minimal['wrong_from'])} in {each['n']} of {each['asked']} runs{start}"
        told += f"; `{each['solver'].partition(',')[0]}` {wrong}"
    others = minimal["asked"] - sum(each["asked"] for each in minimal["wrong_by"])
    if minimal["wrong_by"] and others:
        told += f", others in 0 of {others}"
    who = f"an ODE in angles by {' or '.join(f'`{name}`' for name, _ in by.most_common())}"
    clear = 2 * minimal["n_behind"] > minimal["n"]
    take = f"{who} ({told})" if clear else f"no clear choice ({who} is {told})"
    return [{"what": IN_ANGLES[minimal["kind"]], "take": take}]
