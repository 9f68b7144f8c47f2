"""BibTeX for results: the paper always, the sources of the method, and no entry twice."""

import re
from pathlib import Path

import numpy as np
import pytest

import twoloop
from tests.problems import swing
from twoloop import Result, RungeKutta, Statistics, Status, citation
from twoloop.methods.presets import PRESETS
from twoloop.methods.tableaux import gauss, lobatto_iiie
from twoloop.result.result import SOURCES, bibliography

ROOT = Path(__file__).parents[1]
ENTRIES = bibliography()


def keys(text):
    return re.findall(r"^@\w+\{(\w+),$", text, re.MULTILINE)


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_has_a_source_of_its_own(name):
    result = swing(0.1, method=name)
    text, cited = citation(result), keys(citation(result))
    assert f'(method="{name}")' in text.splitlines()[0]
    assert cited[0] == "zhang2016twoloop" and cited[-1] == "twoloop" and len(cited) > 2
    assert len(cited) == len(set(cited)) and twoloop.__version__ in text


OPTIONS = [
    (RungeKutta(gauss(3), outer="newton"), ["butcher1964", "hairer1996"]),
    (RungeKutta(lobatto_iiie(3)), ["hairer2006"]),
]


@pytest.mark.parametrize(("method", "cited"), OPTIONS)
def test_options_that_have_sources(method, cited):
    assert keys(citation(swing(0.1, method=method, step_size=0.01)))[1:-1] == cited


@pytest.mark.parametrize("entry", ENTRIES.values(), ids=ENTRIES)
def test_entries_are_well_formed(entry):
    assert entry.count("{") == entry.count("}")
    fields = dict(re.findall(r"^  (\w+) = \{(.*)\},?$", entry, re.MULTILINE))
    assert {"title", "author", "year"} <= set(fields)
    assert entry.splitlines()[-1] == "}" and len(fields) == len(entry.splitlines()) - 2


def test_entries_are_all_used_and_agree_with_the_citation_file():
    assert {key for keys in SOURCES.values() for key in keys} | {"paper"} == set(ENTRIES)
    given = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.search(r"doi: (\S+)", given)[1] in ENTRIES["paper"]
    assert re.search(r"year: (\d+)", given)[1] in ENTRIES["paper"]
    plain = ENTRIES["paper"].replace("{", "").replace("}", "").replace("--", "–")
    assert re.search(r"type: article\n    title: (.*)", given)[1] in plain


def test_what_cannot_be_cited():
    row = np.zeros((1, 2))
    foreign = Result(row[0], row, row, row, row, row[0], Status.REACHED_END, "", Statistics())
    with pytest.raises(ValueError, match="this result was made by another solver"):
        citation(foreign)
