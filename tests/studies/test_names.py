"""Names of solvers: those of the rows have one mapping to what a user calls, which no report goes around."""

import re

import pytest

from studies.bench.cli import ROOT
from studies.bench.names import call, label, looks_like
from studies.bench.solvers import CATALOGUE, COMPILED, GIVEN, OWN

RAW = re.compile(r"`auto\b|\bauto, (not )?compiled|\b(Taylor|Adams|DOP853), compiled\b(?!=)|\b[A-Za-z]\w* \(twoloop\)")


@pytest.mark.parametrize(
    ("solver", "mixed", "without", "with_code"),
    [
        ("the default", "the default", "the default", "the default"),
        ("the default (twoloop)", "the default", "the default", "the default"),
        ("auto", "`compiled=False`", "the default", "`compiled=False`"),
        ("auto, compiled", "`compiled=True`", "`compiled=True`", "the default"),
        ("auto, not compiled (twoloop)", *["`compiled=False`"] * 3),
        ("DOP853 (twoloop)", *(f'`method="DOP853"{word}`' for word in (", compiled=False", "", ", compiled=False"))),
        ("Taylor, compiled", *(f'`method="Taylor"{word}`' for word in (", compiled=True", ", compiled=True", ""))),
        ("TRBDF2", *['`method="TRBDF2"`'] * 3),
        ("DOP853, projected", *["`SciPy, DOP853, projected`"] * 3),
        ("BDF, index 1", *["`SciPy, BDF, index 1`"] * 3),
        ("Radau, solve_dae, stabilised", *["`Radau, solve_dae, stabilised`"] * 3),
        ("heyoka", *["`heyoka`"] * 3),
    ],
)
def test_a_solver_is_called_as_a_user_does(solver, mixed, without, with_code):
    """On several mechanisms, on those for which the default makes no code, and on those for which it does."""
    assert (call(solver), call(solver, coded=False), call(solver, coded=True)) == (mixed, without, with_code)
    for coded in (None, False, True):
        assert label(solver, coded) == re.sub('method=|["`]', "", call(solver, coded))


@pytest.mark.parametrize("coded", [None, False, True])
def test_no_two_solvers_have_one_name(coded):
    names = [name for name in CATALOGUE if name != GIVEN]
    assert len({label(name, coded) for name in names}) == len(names) and not any(map(RAW.search, map(label, names)))


def test_what_is_called_alike_looks_the_same_on_all_mechanisms():
    seen = {(label(name, coded), looks_like(name, coded)) for name in OWN for coded in (None, False, True)}
    assert len(seen) == len({called for called, _ in seen})
    ways = ["the default", *COMPILED.values()] + [f"compiled={value}" for value in (True, False)]
    assert set(ways) - {"auto"} < {called for called, _ in seen}
    plain = {coded: {label(name, coded): looks_like(name, coded) for name in OWN} for coded in (False, True)}
    for looks in plain.values():
        assert len(set(looks.values())) == len(looks)


def test_reports_and_the_readme_have_no_names_of_rows():
    """But where a report says what its CSV file calls a solver."""
    for path in (ROOT / "README.md", *(ROOT / "reports").glob("*.md")):
        lines = path.read_text(encoding="utf-8").splitlines()
        found = [line for line in lines if RAW.search(line) and ".csv" not in line]
        assert found == [], path.name
