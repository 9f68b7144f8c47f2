"""The first screen of the README: every number is derived again from rows; the committed one is up to date."""

import json
import re
from itertools import zip_longest
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from studies.bench import headline, index, tables
from studies.bench.collector import Case
from studies.bench.render import number, render
from studies.honesty import study as honesty
from studies.honesty.traps import FORCE
from studies.table3 import study as table3
from studies.work_precision import first_calls, rivals
from studies.work_precision import study as work_precision
from tests.studies.of_study import found_of, median
from tests.studies.test_index import energy
from tests.studies.test_table3 import rows as rows_of_table3
from twoloop.mechanisms import four_bar
from twoloop.rows.equal_error import LOOSEST

ROOT = Path(__file__).parents[2]
BEGIN, END = "<!-- generated: begin -->\n", "<!-- generated: end -->"
FOUR_BAR, BRICARD = rivals.HEADLINE, "A04 Bricard"
N = len(rivals.DECADES)
# solver: family, called from, keeps the constraints, ms on the four-bar, ms on Bricard (None: refused)
SOLVERS = {
    "auto": ("two-loop", "compiled", True, 3.1, 40.0),
    "auto, compiled": ("two-loop", "compiled", True, 0.52, 7.0),
    "Taylor": ("two-loop", "compiled", True, 2.7, 60.0),
    "heyoka": ("heyoka", "compiled", False, 1.4, None),
    "CVODE from C, Adams": ("SUNDIALS", "compiled", False, 2.3, None),
    "CVODE from C, BDF": ("SUNDIALS", "compiled", False, 6.4, None),
    "IDA from C, stabilised": ("SUNDIALS", "compiled", True, 8.8, 5.9),
    "DOP853, index 1": ("SciPy", "Python", False, 19.0, 210.0),
    "LSODA, index 1": ("SciPy", "Python", False, 15.0, 330.0),
}
FIRST = {"auto": 0.0042, "auto, compiled": 1.3, "heyoka": 0.77, "CVODE from C, Adams": 2.6}


def rows(solvers=SOLVERS, place=3, case=FOUR_BAR, **changed):
    """Medians of five equal repetitions at the loosest setting, which are exact: each price holds at every error."""
    made = []
    for solver, (family, called_from, keeps, *ms) in solvers.items():
        time = ms[place - 3] and 1e-3 * ms[place - 3]
        told = {"group": rivals.GROUP, "case": case, "family": family, "called_from": called_from, "tol": LOOSEST}
        told |= {"keeps_constraints": keeps, "inside_s": time and 0.2 * time, "times": (time,) * 5 if time else ()}
        told |= {"violation_q": 1e-15, "t_end": 10.0, "processor": "AMD EPYC"}
        told |= {"status": "REACHED_END" if time else "RAISED"}
        made.append(median(solver, 1e-14 if time else None, time, **told) | changed)
    return pd.DataFrame(made)


def first_rows(times=FIRST):
    lines = [{"case": FOUR_BAR, "solver": name, "first_call_s": time, "tol": 1e-8} for name, time in times.items()]
    return pd.DataFrame(lines).assign(group=first_calls.GROUP)


def of_table3(paper=(3.0, 9.0, 12.0), explicit=(0.2, 0.25, 0.25)):
    """The finding on explicit methods, of runs at the three errors of the report."""
    lines = {"PaperIRK, Atol = Rtol varied": paper, "Taylor": explicit, "Adams": [2.0 * s for s in explicit]}
    made = []
    for solver, times in lines.items():
        for k, (error, time) in enumerate(zip(table3.TARGETS, times, strict=True)):
            line = {"solver": solver, "error_q": 0.5 * error, "call_s": time, "tol": 10.0 ** -(k + 3), "floor": 1e-12}
            made.append(line | {"err_in": np.nan, "group": "comparison"})
    return {"explicit": table3._explicit(pd.DataFrame(made))}


def of_honesty():
    """Findings of honesty as far as the screen needs them; the counts are made from outcomes."""
    wrong = {"the default (twoloop)": 1, "auto, compiled (twoloop)": 2, "Taylor (twoloop)": 3, "IDA from C": 4}
    wrong |= {"IDA from C, max_step": 5, "heyoka, Taylor": 6, "heyoka, Taylor, max_step": 7}
    lines = []
    for k, (solver, n) in enumerate(wrong.items()):
        outcomes = [honesty.SILENT] * (n - 1) + [honesty.HANG] + [honesty.RIGHT] * (60 + k)
        outcomes += [honesty.NOT_RUN] * 5  # refused
        lines += [{"solver": solver, "outcome": outcome, "asked": True} for outcome in outcomes]
        lines += [{"solver": solver, "outcome": honesty.SILENT, "asked": False} for _ in range(6 if k == 0 else 0)]
    rows = pd.DataFrame(lines).assign(group=FORCE, status="RAISED", error=1.0)
    rows.loc[rows["solver"] == "IDA from C", "error"] = 1e-4
    fewer = rows[rows["outcome"] != honesty.SILENT]
    held_out = {"trust": honesty.trust_in(fewer), "solvers": honesty.totals(fewer)}
    held_out["ran"] = [kind for kind in honesty.KINDS[:-1] if held_out["trust"][kind]["n"]]
    forces = {"n_families": 17, "n_gusts": 4, "n_frictions": 2, "mechanisms": ["a", "b", "c"]}
    made = {"n_traps": 23, "looseness": 1e3, "exact": 1e-3, "off": 1e-5, "usual": 1e-8}
    made |= {"forces": forces, "forces_only": ["auto, compiled (twoloop)"] * 14}
    forces["trust"] = honesty.trust_in(rows)
    short = {}
    for k, shape in enumerate(("gust", "pulse")):
        at = [{"gross": gross, "n": 20} for gross in (7, 8, 3)]
        short[shape] = {"n": 120, "widths": [1e-4, 3e-4, 1e-2], "solvers": [{"solver": "IDA from C", "at": at}]}
        short[shape]["solvers"].append({"solver": "the default (twoloop)", "at": at})
        none = {"n": 60 + k, "gross": 0, "widths": [3e-4, 1e-2]}
        short[shape]["default"] = {"none": none, "some": {"n": 40, "gross": 3 + k, "widths": [1e-4]}}
    return made | {
        "trust": honesty.trust_in(rows),
        "held_out": held_out,
        "look": 5e-4,
        "short": short,
        "forces_end": 3.0,
    }


def of_sharp(error):
    """Findings of robustness on sharp forces: the default is off so much on one mechanism."""
    wrong = [{"what": "gust of 3 ms", "name": "chain", "tol": 1e-6, "error": error}]
    within = {"tolerances": 1000.0, "n": 144, "within": 141, "failed": 2, "beyond": 1}
    return {
        "default": {"n": 144, "wrong": wrong},
        "within_thousand": within,
        "allowed": [{"tol": 1e-4}, {"tol": 1e-12}],
    }


def findings():
    """Of all studies of which the first screen says something."""
    both = pd.concat([rows(), rows(place=4, case=BRICARD)], ignore_index=True)
    four = rows(case="crane").assign(astray=False)
    known = [Case("crane", four_bar(), 10.0, tags=("smooth",))]
    made = work_precision.findings_of(four, known) | {"rivals": rivals.findings_of(both)}
    made["price"] = headline.price(both, first_rows(), FOUR_BAR)
    told = {"work_precision": made, "table3": of_table3(), "honesty": of_honesty()}
    told["beam"] = {
        "cases": [
            {"name": "very flexible", "at": [{"error": 1e-2, "best": {"solver": "CVODE", "setting": "tol 1e-4"}}]}
        ]
    }
    return told | {"robustness": {"sharp": of_sharp(0.06)}, "energy": energy()}


def block_of(folder, found):
    for name, each in found.items():
        (folder / f"{name}.json").write_text(json.dumps(each | {"timed": index.WHOLE_CALL}))
    readme = folder / "front.md"
    readme.write_text(BEGIN + END)
    index.put_in_readme(folder, readme)
    return readme.read_text().removeprefix(BEGIN).removesuffix(END)


def numbers(text):
    """What of a text has digits and is no name in code nor a link."""
    text = re.sub(r"`[^`]*`|\]\([^)]*\)|\[Table 3", "", text)
    return re.findall(r"\S*\d\S*", text)


def test_every_number_of_the_screen_is_made_again_from_the_rows(tmp_path):
    text = block_of(tmp_path, findings())
    ms = {name: line[3:] for name, line in SOLVERS.items()}
    ours = [name for name, line in SOLVERS.items() if line[0] == "two-loop"]
    n_others = len(SOLVERS) - len(ours)

    def count(names):
        """Of both mechanisms, each at N errors: ahead and behind."""
        mine = [min(ms[each][k] for each in ours) if names is None else ms[names[k]][k] for k in (0, 1)]
        least = [min(ms[each][k] for each in ms if each not in ours and ms[each][k]) for k in (0, 1)]
        ahead = sum(a < b for a, b in zip(mine, least, strict=True))
        return ahead * N, (2 - ahead) * N

    kinds = {"CVODE from C": 2.3, "IDA from C": 8.8, "SciPy's best": 15.0}
    prices = [ms["auto, compiled"][0], ms["auto"][0], ms["heyoka"][0], *kinds.values()]
    cells = " | ".join([*(number(price) for price in prices[:3]), "not run", *(number(price) for price in prices[3:])])
    first = " | ".join(number(1e3 * FIRST[name]) for name in ("auto, compiled", "auto", "heyoka"))
    trust = {line["solver"]: line for line in of_honesty()["held_out"]["solvers"]}
    held_out = [f"{line['gross']} of {line['n']}" for line in map(trust.get, ("IDA from C", "the default (twoloop)"))]
    n_in = [len(errors) for name, errors in rivals.RANGES.items() if errors and name != rivals.ROUNDING]
    standings = []
    for who in (("auto, compiled", "auto"), ("auto, compiled",) * 2, None):
        ahead, behind = count(who)
        standings.append(" | ".join(f"{ahead * n // N} / {behind * n // N}" for n in n_in) + " | 0 / 0 |")
    ratios = [ms["heyoka"][0] / ms["auto, compiled"][0], ms["IDA from C, stabilised"][1] / ms["auto"][1]]
    typical = f"{number(np.median(ratios))} ({number(min(ratios))} to {number(max(ratios))})"

    def both(who):
        """Cells of a solver that is the fastest on one mechanism at all errors of both ranges."""
        return " | ".join(f"{who if who == 'the default' else f'`{who}`'} {n} of {n}" for n in n_in[:2])

    expected = [
        "The table counts comparisons, each on one of 2 mechanisms at one error at the end, against the "
        f"fastest of up to {n_others} rival configurations, on an AMD EPYC:",
        "| faster / slower | errors of 1e-3 to 1e-6 | errors of 1e-7 to 1e-10 | singular positions (all errors) |",
        f"| the default | {standings[0]}",
        f"| `compiled=True` everywhere | {standings[1]}",
        f"| the best of our {len(ours)} configurations, chosen afterwards | {standings[2]}",
        f"median (range) | {typical} at 1e-4 | {typical} at 1e-8 | – |",
        f"below {100.0 * (tables.LEAST - 1.0):.0f} % or within the scatter",
        f"neither count. At 1e-3 to 1e-6 the default is faster on {FOUR_BAR} only. At 1e-7 to 1e-10 the default is",
        "most often the fastest at 1e-3 to 1e-6 | most often the fastest at 1e-7 to 1e-10 |",
        f"| redundant constraints ({BRICARD}) | {both('IDA from C, stabilised')} |",
        f"| four-bar linkages, over 10 s ({FOUR_BAR}) | {both('the default')} |",
        "on the four-bar, over 10 s, among the mechanisms most favourable to us:",
        f"\n| 1e-4 | {cells} |\n| 1e-6 | {cells} |\n",
        f"| first call | {first} | – | {number(1e3 * FIRST['CVODE from C, Adams'])} | – | – |\n",
        "First calls, at 1e-8, were timed once",
        "were drawn on 22 and 23 November 2026; our methods",
        "The table splits b and durations at this interval.",
        "runs of 3.0 s that report success at a tolerance of 1e-8 with an error over 1e-3:",
        "| | IDA from C | the default |",
        f"| 17 kinds of sharp forces (4 gusts, 2 frictions, 11 others) | {' | '.join(held_out)} |",
        "| gusts exp(−((t − t₀)/b)²) at random times t₀, b about 1e-4 to 3e-4 s / 0.010 s |"
        + 2 * " 15 of 40 / 3 of 20 |",
        "| constant pulses at random times, duration about 1e-4 to 3e-4 s / 0.010 s |" + 2 * " 15 of 40 / 3 of 20 |",
        "every 5e-4 of a run (here 1.5e-3 s), other forces",
        "rivals are silently wrong in 2 of 132 runs of the first row.",
    ]
    for said in expected:
        assert said in text, said
        text = text.replace(said, "", 1)
    assert numbers(text) == [] and tables.NEARLY == 1.25
    assert "Of these, only IDA from C keeps the constraints." in text
    assert "`CVODE from C, BDF`" not in text and "`DOP853, index 1`" not in text


def test_the_order_of_the_screen(tmp_path):
    text = block_of(tmp_path, findings())
    places = [text.index(words) for words in ("the default", "| Your mechanism", "**Price**", "**Silently wrong**")]
    assert places == sorted(places) and "index 3" not in text and "index-3" not in text


@pytest.mark.parametrize(
    ("explicit", "said"),
    [
        ((0.2, 0.25, 0.25), "faster at all three errors"),
        ((4.0, 4.0, 4.0), "faster at some errors"),
        ((99.0,) * 3, "at no"),
    ],
)
def test_the_sentence_on_explicit_methods_turns_with_the_rows(explicit, said):
    found = of_table3(explicit=explicit)["explicit"]
    ratios = sorted(paper / own for paper, own in zip((3.0, 9.0, 12.0), explicit, strict=True))
    text = render("explicit", {}, {}, explicit=found, reports=".")
    span = f"{number(ratios[0])} to {number(ratios[-1])} times"
    assert said in text and f"takes {span} as long" in text and "not the paper's procedure" in text


def test_the_paper_is_not_made_slow_by_runs_that_were_not_made():
    made = of_table3(paper=(np.nan, 9.0, 12.0))["explicit"]
    assert made["errors"] == ["1e-4", "1e-6"] and made["over"] == pytest.approx([36.0, 48.0])


def test_a_price_that_is_missing_says_why():
    table = rows()
    loose = table["solver"] == "heyoka"
    table.loc[loose, ["error_q", "tol"]] = [1e-5, 1e-6]  # it was not asked for more
    exhausted = table["solver"].str.startswith("CVODE from C")
    table.loc[exhausted, ["error_q", "tol"]] = [1e-5, tables.TIGHTEST]
    table.loc[table["family"] == "SciPy", ["error_q", "call_s", "status"]] = [np.nan, np.nan, "NOT_AVAILABLE"]
    found = headline.price(table, first_rows({}), FOUR_BAR)
    why = {line["name"]: [at["why"] for at in line["at"]] for line in found["lines"]}
    assert why["auto"] == [None, None] and why["heyoka"] == [None, "not asked"]
    assert why["CVODE from C"] == [None, "not reached"] and why["SciPy's best"] == ["not run", "not run"]
    text = render("price", {}, {}, price=found, rivals={}, reports=".")
    assert (
        "| not asked | not run | not reached |" in text and "first call" not in text and "keeps the constraints" in text
    )
    assert headline.price(table, first_rows(), "no such mechanism") is None


@pytest.mark.parametrize(
    ("changed", "verdict"),
    [
        ({"status": "RAISED", "error_q": None}, "unasked"),  # our adapter refuses
        ({"status": "TIME_LIMIT", "error_q": None}, "unasked"),  # our limit
        ({"status": "SOLVER_FAILED", "error_q": None, "tol": tables.TIGHTEST}, "alone"),
        ({"error_q": 0.1, "tol": tables.TIGHTEST}, "alone"),
        ({"error_q": 0.1, "tol": 1e-3}, "unasked"),
    ],
)
def test_ours_alone_is_said_only_where_others_were_asked(changed, verdict):
    mine = {name: line for name, line in SOLVERS.items() if line[0] == "two-loop"}
    table = pd.concat([rows(mine), rows({"heyoka": SOLVERS["heyoka"]}, **changed)], ignore_index=True)
    found = headline.of_errors(table, [1e-4])[0]
    assert {standing["verdict"] for standing in found.values()} == {verdict}
    line = headline.counted([[found]])[0]
    assert (line["alone"], line["unasked"], line["missed"]) == (int(verdict == "alone"), int(verdict == "unasked"), 0)
    made = rivals.findings_of(table)
    assert made["alone"] == [FOUR_BAR] and made["not_put"] == ([FOUR_BAR] if verdict == "unasked" else [])


def test_a_single_run_is_marked_where_it_is_the_price():
    table = rows().assign(repeats=[1 if name == "heyoka" else 5 for name in SOLVERS])
    text = render("price", {}, {}, price=headline.price(table, first_rows(), FOUR_BAR), rivals={})
    assert "| 1.4 (once) |" in text and text.count("(once)") == 2


def differing(readme, folder):
    """Pairs of lines that differ, of a README's block and of what the findings in a folder give.

    But for what is said of Table 3, which may have been run again (`make table3`).
    """
    texts = readme.split(BEGIN)[1].split(END)[0], index.readme_block(index.findings(folder))
    stands, given = ([line for line in text.splitlines() if line and "table3.md" not in line] for text in texts)
    return [pair for pair in zip_longest(stands, given) if pair[0] != pair[1]]


def test_the_committed_screen_is_that_of_the_committed_findings():
    if "work_precision" not in index.findings(ROOT / "reports"):
        pytest.skip("reports/work_precision.json has times of before the whole call: python -m studies.work_precision")
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert differing(readme, ROOT / "reports") == [], "run `python -m studies readme`"


def test_table_3_may_be_run_again_and_no_other_study(tmp_path):
    readme = BEGIN + block_of(tmp_path, findings()) + END
    for again in ({"table3": of_table3(paper=(7.0, 8.0, 9.0))}, {"table3": of_table3(paper=(np.nan,) * 3)}):
        block_of(tmp_path, again)
        assert differing(readme, tmp_path) == []
    again = of_honesty()
    again["held_out"]["solvers"][0]["gross"] += 1
    block_of(tmp_path, {"honesty": again})
    (pair,) = differing(readme, tmp_path)
    assert all("kinds of sharp forces" in line for line in pair)


def test_odes_in_angles_are_counted_from_the_rows():
    """From the committed rows, by another way than the findings: the sentence is of all kinds together."""
    made = json.loads((ROOT / "reports" / "work_precision.json").read_text(encoding="utf-8"))["minimal"]
    standings = [at["verdict"] for kind in made for mechanism in kind["mechanisms"] for at in mechanism["at"]]
    standings = ["behind" if verdict == "missed" else verdict for verdict in standings]  # what only the ODE reaches
    decided = [verdict for verdict in standings if verdict in ("ahead", "behind", "undecided")]
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    told = f"faster than our best in {decided.count('behind')} of {len(decided)} comparisons"
    assert told in " ".join(readme.split()) and told in (ROOT / "reports" / "README.md").read_text(encoding="utf-8")
    (singular,) = [kind for kind in made if kind["kind"] == "singular"]
    own = [at["verdict"] for mechanism in singular["mechanisms"] for at in mechanism["at"]]
    own = [
        "behind" if verdict == "missed" else verdict for verdict in own if verdict not in ("none", "alone", "unasked")
    ]
    assert (
        f"in its one angle, not counted, an ODE is faster than our best in {own.count('behind')} of {len(own)}."
        in " ".join(readme.split())
    )


def test_the_screen_has_few_words_and_sixty_lines_at_most(tmp_path):
    front = (ROOT / "README.md").read_text(encoding="utf-8").split("## Use it")[0]
    block = front.split(BEGIN)[1].split(END)[0]
    fixed = len(front.splitlines()) - len(block.splitlines())
    words = [word for word in block.replace("|", " ").split() if set(word) - set("-:")]
    assert len(words) <= 945
    assert fixed + max(len(each.splitlines()) for each in (block, block_of(tmp_path, findings()))) <= 60
    assert "index-3" not in front and "two-loop" not in front.split(BEGIN)[0]


def test_the_report_on_table_3_has_the_same_sentence(tmp_path):
    ratios = found_of(table3, tmp_path, rows_of_table3().replace({"solver": {"Gauss12": "Taylor"}}))["explicit"]["over"]
    text = (tmp_path / "table3.md").read_text()
    methods = (f'`method="{name}"`' for name in ("DOP853", "Taylor", "Adams"))
    assert "\n- {}, {} and {} integrate all coordinates explicitly".format(*methods) in text
    assert min(ratios) > 1.0 and "faster at both errors" in text and f"takes {number(min(ratios))} times" in text


def test_a_run_that_nearly_gets_there_is_told_beside_the_price():
    near = rows({"heyoka": SOLVERS["heyoka"]}, error_q=1.1e-6, call_s=4e-4, times=(4e-4,) * 5, tol=1e-5)
    table = pd.concat([rows(), near], ignore_index=True)
    at = {line["name"]: line["at"][1] for line in headline.price(table, first_rows(), FOUR_BAR)["lines"]}
    assert at["heyoka"]["near"] == {"asked": 1e-6, "error": 1.1e-6, "call_s": 4e-4} and at["auto"]["near"] is None
    text = render("price", {}, {}, price=headline.price(table, first_rows(), FOUR_BAR), rivals={})
    assert "| 1.4 (0.40 at 1.1e-6) |" in text and text.count(" at 1.") == 1
