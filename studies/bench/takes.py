"""The table "more, take": what is the fastest for long motions, beams, energies and many runs, by its call."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from studies.bench.names import call
from studies.bench.render import listed, number, one_digit, power
from studies.bench.solvers import DEFAULT, HEYOKA

LONG = "long and conservative"
ORDERED, SCATTER = ("ahead", "behind"), 1.5  # ratio of ensembles below which other tolerances may turn the order
BEAMS = {  # of the study of the beam, and their classes
    "moderately stiff": "stiff, vibrations irrelevant",
    "very flexible": "flexible, vibrations wanted",
}
NEWEST = "CyRK"  # a rival that rows of some studies lack, as they were made before
NO_ANGLES = "ODEs in angles were not run"
NONE, UNCLEAR = "no solver compared reaches these errors", "no clear choice"
BEAM_CLASSES = ("stiff, vibrations irrelevant", "stiff, vibrations wanted")  # which the beam's report judges by the tip


def takes(found: Mapping[str, Any], entries: Sequence[dict[str, Any]]) -> list[dict[str, str]]:
    """For each class of problem (`entries`, those of `index.classes`) what is the fastest."""
    made = found.get("work_precision", {})
    rivals = made.get("rivals", {})
    with_code = set(rivals.get("with_code", []))
    classes: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for entry in entries:
        classes[entry["class"]].append(entry)
    rows = [_of_class(name, own, with_code) for name, own in classes.items() if name not in (*BEAM_CLASSES, LONG)]
    beam = found.get("beam", {})
    rows += _of_beams([case for case in beam.get("cases", []) if case["name"] in BEAMS], beam.get("banded", False))
    long = found.get("energy", {}).get("long", {})
    rows += [_of_energy(entry, coded(("four-bar",), with_code), long) for entry in classes[LONG]]
    for row in rows:
        row["take"] += _without(row["what"], made.get("lacking", []), entries)
    rows += _at_once(found.get("ensembles", {}).get("cases", []))
    paying = (f"{DEFAULT}, compiled", HEYOKA)
    paid = [_paid(line) for line in made.get("first_calls", []) if line["pays"] and line["solver"] in paying]
    singly = {"what": "many single calls", "take": f"{' and '.join(paid)}, against `compiled=False`"}
    return rows + _in_angles(made.get("minimal", [])) + [singly] * bool(paid)


def _without(what: str, lacking: Sequence[str], entries: Sequence[dict[str, Any]]) -> str:
    """That the newest rival was not run, and on which beams it is the fastest by all coordinates."""
    if not any(what.replace(",", "").startswith(each) for each in lacking):
        return ""
    won = [
        entry["name"]
        for entry in entries
        if entry["class"] in BEAM_CLASSES and any(pick["solver"].startswith(NEWEST) for pick in entry["picks"])
    ]
    more = f", which is the fastest on the {listed(won)} by the error of all coordinates" if won else ""
    return f"; without `{NEWEST}`{more if what.startswith('beams') else ''}"


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
    taken = _shares(won, "errors", made)
    return {"what": what, "take": f"{taken}, among solvers with constraints: {NO_ANGLES}" if taken else NONE}


def _shares(won: Mapping[str, int], of: str, made: bool | None) -> str:
    """Each solver with how often it is the cheapest ("": none is told from the others), the most often first."""
    total, ranked = sum(won.values()), sorted(won.items(), key=lambda item: -item[1])
    counts = [(call(solver, made), n) for solver, n in ranked if solver and n]
    if counts and 2 * counts[0][1] <= total:
        return f"no clear choice (of {total} {of}: {', '.join(f'{who} {n}' for who, n in counts)})"
    said = [f"{who} ({n}{'' if k else f' of {total} {of}'})" for k, (who, n) in enumerate(counts)]
    return ", ".join(said) or ("no clear choice" if total else "")


def _of_beams(cases: Sequence[Mapping[str, Any]], banded: bool) -> list[dict[str, str]]:
    """The cheapest by the error of the tip, and how loose the tolerances are with which they are that."""
    settings = [at["best"]["setting"].split() for case in cases for at in case["at"] if at["best"] is not None]
    loosest = max((float(value) for name, value in settings if name == "tol"), default=None)
    chosen = f" (tolerances chosen afterwards, up to {number(loosest)})" if loosest else ""
    apart = [] if banded else ["SUNDIALS had dense matrices, ours are banded"]
    told = "; ".join([*map(_by_the_tip, cases), *apart])
    return [{"what": f"beams, by the error of the tip{chosen}", "take": told}] * bool(cases)


def _by_the_tip(case: Mapping[str, Any]) -> str:
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
    return f"{BEAMS[case['name']]}: {take or NONE}"


def _of_energy(entry: Mapping[str, Any], made: bool | None, long: Mapping[str, Any]) -> dict[str, str]:
    """The cheapest for an error of the energy over a long time, and the cheapest whose energy shows no drift."""
    told = [_decided(entry[which], made) for which in ("picks", "without_drift")]
    first = told[0] if told[0] != UNCLEAR else _timed_once(long, made) or UNCLEAR
    drifts = " (drifts)" if first == told[0] != UNCLEAR else ""
    without = f"{drifts}; without a visible drift {told[1]}{_beside_drifting(long)}"
    without = without if told[1] not in (UNCLEAR, NONE) else ""
    taken = first + without
    if first not in (NONE, UNCLEAR):
        taken += f"; {NO_ANGLES}"
    return {"what": f"energy over {power(entry['t_end'])} s (four-bar)", "take": taken}


def _timed_once(long: Mapping[str, Any], made: bool | None) -> str:
    """The times of both sides for the smallest energy error, which are not ranked where each run was timed once."""
    if not long.get("at") or long.get("repeats", 1) > 1:
        return ""
    at = long["at"][-1]
    runs = [at["drift"][side] for side in ("ours", "others")]
    if not all(runs):
        return ""
    told = listed(f"{call(run['solver'], made)} {number(run['call_s'])} s" for run in runs)
    return f"not ranked, as timed once: {told} for at most {number(at['energy'])} J (both drift)"


def _between(values: Iterable[float]) -> str:
    least, most = min(known := list(values)), max(known)
    return f"{number(least)} to {number(most)}"


def _beside_drifting(long: Mapping[str, Any]) -> str:
    """What a run without drift costs of time, against ours that drift with energy errors as large."""
    calm = long.get("calm_ours", {})
    over, plain = calm.get("over_drifting"), calm.get("over_plain")
    without = f" ({_between(plain)} times that of `compiled=False`)" if plain else ""
    return f", at {_between(over)} times the time{without}" if over else ""


def _decided(picks: Sequence[Mapping[str, Any]], made: bool | None) -> str:
    """The solvers that are the cheapest wherever this is decided."""
    names = [call(pick["solver"], made) for pick in picks if len(pick["undecided"]) < len(pick["accuracies"])]
    return listed(dict.fromkeys(names)) if names else UNCLEAR if picks else NONE


def _at_once(cases: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Whether an ensemble is ahead of the fastest of the others, where many runs are one call."""
    verdicts = Counter(at["verdict"] for each in cases for at in each["at"] if at["verdict"] != "none")
    ahead, behind = verdicts["ahead"], verdicts["behind"]
    if not ahead + behind:
        return []
    fastest = Counter(at["rival"] for each in cases for at in each["at"] if at["verdict"] == "behind")
    ours = ahead > behind
    who, other = ("`ensemble`", "all that ran") if ours else (call(fastest.most_common(1)[0][0]), "`ensemble`")
    told = f"ahead of {other} in {max(ahead, behind)}, behind in {min(ahead, behind)} of {verdicts.total()} comparisons"
    if verdicts["undecided"]:
        told += f", undecided in {verdicts['undecided']}"
    if verdicts["missed"]:
        told += f", {verdicts['missed']} reached by others only"
    close = sum(1 / SCATTER < at["ratio"] < SCATTER for each in cases for at in each["at"] if at["verdict"] in ORDERED)
    told += f"; {close} of these {ahead + behind} by less than {SCATTER:g} times" if close else ""
    return [{"what": "many runs in one call", "take": f"{who} ({told}); {NO_ANGLES}"}]


def _paid(line: Mapping[str, Any]) -> str:
    """After about how many runs code has paid, to one digit: single first calls scatter."""
    first, last = one_digit(min(line["pays"])), one_digit(max(line["pays"]))
    after = first if first == last else f"{first} to {last}"
    on = f" on {line['n'] - line['never']} of {line['n']} mechanisms" if line["never"] else ""
    return f"{call(line['solver'])} after some {after} calls{on}"


def _in_angles(minimal: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """In how many comparisons an ODE in minimal coordinates is faster than our best with constraints."""
    told, by = [], Counter[str]()
    for kind in minimal:
        name = "singular positions" if kind["kind"] == "singular" else kind["kind"]
        told += [f"{name}: faster than our best in {kind['n_behind']} of {kind['n']} comparisons"] * bool(kind["n"])
        every = (at for each in kind["mechanisms"] for at in each["at"])
        by.update(at["rival"]["solver"].partition(",")[0] for at in every if at["ratio"] is not None)
        for each in kind["wrong_by"]:
            who, n = each["solver"].partition(",")[0], f"{each['n']} of {each['asked']} runs of {name}"
            start = ", which start horizontally from rest" if kind.get("level") else ""
            told.append(f"`{who}` is silently wrong by over {number(kind['wrong_from'])} in {n}{start}")
    names = " or ".join(f"`{who}`" for who, _ in by.most_common(2))
    take = f"an ODE in angles{f' by {names}' if by else ''} ({'; '.join(told)})"
    return [{"what": "loops that close by a formula, and pendulums", "take": take}] * bool(told)
