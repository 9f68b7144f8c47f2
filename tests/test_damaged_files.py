"""Files of results with anything in them: a `ValueError` that names the field, and never a crash."""

import json

import numpy as np
import pytest

import twoloop
from tests.problems import at_one, run
from tests.processes import run_python
from twoloop.mechanisms import four_bar


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "run.npz"
    run(four_bar(), 0.5, method="Gauss12", dense_output=True, events=at_one()).save(path)
    return path


def changed(saved, folder, change):
    """The file with other contents, as a file of before there were check sums."""
    with np.load(saved) as file:
        arrays = {name: file[name] for name in file.files}
    words = json.loads(str(arrays.pop("words")))
    del words["check_sums"]
    change(arrays, words)
    path = folder / "changed.npz"
    np.savez(path, words=np.array(json.dumps(words)), **arrays)
    return path


def entry(name, place, value):
    def change(arrays, words):
        arrays[name][place] = value

    return change


def array(name, make):
    def change(arrays, words):
        arrays[name] = make(arrays[name])

    return change


def word(name, value):
    return lambda arrays, words: words.update({name: value})


def gone(name):
    return lambda arrays, words: (arrays if name in arrays else words).pop(name)


def in_each_others_place(one, other):
    def change(arrays, words):
        arrays[one], arrays[other] = arrays[other], arrays[one]

    return change


CASES = {
    "no times": ("t ", gone("t")),
    "a time that is none": ("t ", entry("t", 2, np.nan)),
    "an endless time": ("sol_t", entry("sol_t", 2, np.inf)),
    "times out of order": ("t ", array("t", lambda t: t[::-1].copy())),
    "times of a table out of order": ("sol_t", array("sol_t", lambda t: t[::-1].copy())),
    "a time twice": ("sol_t", entry("sol_t", slice(2, 4), 0.01)),
    "fewer columns": ("v ", array("v", lambda v: v[:, :-1])),
    "rows for columns": ("q ", array("q", lambda q: q.T)),
    "fewer coordinates": ("a ", array("a", lambda a: a[:-1])),
    "single precision": ("q ", array("q", lambda q: q.astype(np.float32))),
    "the other byte order": ("sol_states", array("sol_states", lambda x: x.astype(">f8"))),
    "text": ("lam", array("lam", lambda lam: lam.astype("U5"))),
    "a shorter table": ("sol_states", array("sol_states", lambda x: x[:-1])),
    "narrower rows": ("sol_states", array("sol_states", lambda x: x[:, :-1])),
    "a state that is no number": ("sol_states", entry("sol_states", (1, 3), np.nan)),
    "a kind below all": ("sol_kinds", entry("sol_kinds", 0, -1)),
    "a kind beyond all": ("sol_kinds", entry("sol_kinds", 0, 4)),
    "kinds for more steps": ("sol_kinds", array("sol_kinds", lambda kinds: np.append(kinds, 2))),
    "kinds as floats": ("sol_kinds", array("sol_kinds", lambda kinds: kinds.astype(float))),
    "interior times without states": ("sol_interior_states", gone("sol_interior_states")),
    "interior times elsewhere": ("sol_interior_t", entry("sol_interior_t", (1, 0), 0.123456)),
    "interior times in disorder": ("sol_interior_t", entry("sol_interior_t", (1, 1), -1.0)),
    "interior states that are no numbers": ("sol_interior_states", entry("sol_interior_states", (1, 1, 0), np.nan)),
    "no rank": ("sol_ranks", word("sol_ranks", [3, 8])),
    "ranks beyond the rows": ("sol_ranks", word("sol_ranks", [8, 10**9])),
    "ranks below none": ("sol_ranks", word("sol_ranks", [-1, 8])),
    "an end outside": ("sol_end", word("sol_end", 1e9)),
    "a tolerance that is none": ("sol_rtol", word("sol_rtol", float("nan"))),
    "a number of any digits": ("sol_rtol", word("sol_rtol", 10**400)),
    "counts below zero": ("rejected_error", entry("rejected_error", 0, -1)),
    "counts as floats": ("partitioned", array("partitioned", lambda counts: counts.astype(float))),
    "rows that are none": ("redundant", array("redundant", lambda rows: np.array([99]))),
    "events that are missing": ("t_events_1", word("n_events", 2)),
    "events below none": ("n_events", word("n_events", -1)),
    "events of other coordinates": ("q_events_0", array("q_events_0", lambda q: q[:, :-1])),
    "a status of none": ("status", word("status", 17)),
    "a rank beyond the rows": ("rank", word("rank", 100)),
    "statistics of none": ("stats", word("stats", {"n_accepted": -3})),
    "no message": ("message", gone("message")),
    "sizes of steps below zero": ("h ", entry("h", 0, -1.0)),
}


@pytest.mark.parametrize("case", CASES)
def test_what_a_field_may_not_hold(case, saved, tmp_path):
    field, change = CASES[case]
    path = changed(saved, tmp_path, change)
    with pytest.raises(ValueError, match=f"(?s){field}.*(must be|are)"):
        twoloop.load(path, four_bar().system)


def test_ranks_that_are_not_those_of_the_system(saved, tmp_path):
    def change(arrays, words):
        words["sol_ranks"], words["rank"] = [3, 8], None
        del arrays["redundant"]

    with pytest.raises(ValueError, match=r"ranks of its constraints are \[8, 8\].*sol_ranks in the file are \[3, 8\]"):
        twoloop.load(changed(saved, tmp_path, change), four_bar().system)


@pytest.mark.parametrize("pair", [("q", "v"), ("v", "a"), ("q", "lam"), ("t_events_0", "sol_t")])
def test_arrays_in_each_others_place(pair, saved, tmp_path):
    with np.load(saved) as file:
        arrays = {name: file[name] for name in file.files}
    in_each_others_place(*pair)(arrays, {})
    np.savez(tmp_path / "mixed.npz", **arrays)
    with pytest.raises(ValueError, match=f"({pair[0]}|{pair[1]}) in .* must be what was saved under this name"):
        twoloop.load(tmp_path / "mixed.npz")


def test_a_field_whose_bytes_changed_is_named(saved, tmp_path):
    content = bytearray(saved.read_bytes())
    content[content.index(b"lam.npy") + 400] ^= 1
    path = tmp_path / "flipped.npz"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"flipped.npz' is none: lam cannot be read"):
        twoloop.load(path)


FUZZ = """
import json, sys
import numpy as np
import twoloop
from twoloop.mechanisms import four_bar

saved, folder, n = sys.argv[1], sys.argv[2], int(sys.argv[3])
system, rng, content = four_bar().system, np.random.default_rng(4), open(saved, "rb").read()
with np.load(saved) as file:
    arrays = {name: file[name] for name in file.files}
words = json.loads(str(arrays.pop("words")))
del words["check_sums"]
odd = [-1, 0, 3, 10**9, -(10**12), 1e308, float("nan"), None, "x", [], {}, True, [8, 8], [3, 8], [0, 0], [9, 9]]


def flipped():
    other = bytearray(content)
    for _ in range(rng.integers(1, 4)):
        other[rng.integers(len(other))] ^= 1 << rng.integers(8)
    return bytes(other[: rng.integers(len(other))] if rng.random() < 0.3 else other)


def altered():
    own, said = {name: array.copy() for name, array in arrays.items()}, dict(words)
    name = list(own)[rng.integers(len(own))]
    array, way = own[name], rng.integers(7)
    if way == 0:
        said[list(said)[rng.integers(len(said))]] = odd[rng.integers(len(odd))]
    elif way == 1:
        own[name] = array.astype([np.float32, np.int64, np.complex128, bool][rng.integers(4)])
    elif way == 2:
        own[name] = array[..., : rng.integers(array.shape[-1] + 1)]
    elif way == 3:
        own[name] = array.T if array.ndim > 1 else array[::-1]
    elif way == 4:
        other = list(own)[rng.integers(len(own))]
        own[name], own[other] = own[other], own[name]
    elif array.size:
        own[name] = array = np.ascontiguousarray(array)
        bytes_of = array.view(np.uint8).reshape(-1)
        bytes_of[rng.integers(bytes_of.size)] ^= 1 << rng.integers(8)
    np.savez(folder + "/fuzzed.npz", words=np.array(json.dumps(said)), **own)


refused = read = 0
for k in range(n):
    if k % 2:
        altered()
    else:
        open(folder + "/fuzzed.npz", "wb").write(flipped())
    try:
        result = twoloop.load(folder + "/fuzzed.npz", system)
    except ValueError:
        refused += 1
        continue
    read += 1
    if result.sol is not None:
        state = result.sol(np.linspace(result.sol.t_min, result.sol.t_max, 20))
        assert state.a.shape == (9, 20) and state.lam.shape == (8, 20)
print(refused, read)
"""


def test_nothing_in_a_file_ends_the_process(saved, tmp_path):
    refused, read = map(int, run_python(FUZZ, saved, tmp_path, 240, PYTHONWARNINGS="ignore").stdout.split())
    assert refused > 120 and read > 10  # both ways were tried
