"""Machine code on disk: read again when nothing changed, rebuilt when anything did, never a reason to fail."""

from typing import NamedTuple

import numpy as np
import pytest
from numba import njit

from tests.own_cache import RUN, Folder, with_kernels
from tests.processes import run_python
from twoloop.kernels.compile.caches import UNWRITABLE, kept_when_called, watch
from twoloop.kernels.compile.dependencies import stands_for
from twoloop.kernels.compile.kept_files import Files


@pytest.fixture
def folder(tmp_path):
    return Folder(tmp_path)


VALUES = {
    "a_float": "FLOAT",
    "an_attribute_of_a_module": "constants.FLOAT",
    "a_helper": "helper(q[0])",
    "a_helper_of_a_module": "helpers.helper(q[0])",
    "the_default_of_a_helper": "with_default()",
    "the_helper_of_a_helper": "outer(q[0])",
    "the_global_of_a_helper": "named(q[0])",
    "what_a_helper_with_a_cache_of_its_own_calls": "own_cache(q[0])",
    "the_same_compiled_at_once": "own_cache_at_once(q[0])",
    "an_enclosed_value": "enclosed;FLOAT",
    "an_enclosed_helper": "enclosed(q[0]);helper",
    "what_cannot_be_watched": "overloaded(q[0])",
    "nothing": "q[0]",
}
CONSTANTS = "FLOAT = {0}.0"
HELPERS = """
import numba
import constants
from inner import inner
from numba.extending import overload
@numba.njit
def helper(x):
    return {0}.0 * x
@numba.njit
def with_default(x={0}.0):
    return x
@numba.njit
def outer(x):
    return inner(x)
@numba.njit
def named(x):
    return constants.FLOAT * x
def overloaded(x):
    pass
@overload(overloaded)
def _overloaded(x):
    return lambda x: {0}.0 * x
"""
OWN_CACHES = """
import numba
from inner import inner
@numba.njit(cache=True)
def own_cache(x):
    return inner(x)
@numba.njit("f8(f8)", cache=True)
def own_cache_at_once(x):
    return inner(x)
"""
KERNELS = """
from twoloop.kernels.data.common import kernel, f8
@kernel(f8(f8))
def twice(x):
    return 2.0 * x
@kernel(f8(f8))
def thrice(x):
    return 3.0 * x
"""
ANNOUNCED = "compiling the integrator"
# plain functions that from_python compiles, of one name and with other enclosed numbers
SYSTEMS = """
import numpy as np
import constants
from twoloop import ConstrainedSystem

def made(scale):
    return ConstrainedSystem.from_python(
        n_q=1, n_c=0, compile=True, mass=scale * np.eye(1), force=lambda t, q, v: scale * constants.FLOAT * q)

for scale in (1, 10):
    system = made(1.0 * scale)
    for kind, value in (("force", system.force(0.0, [1.0], [0.0])[0]), ("mass", system.mass(0.0, [1.0])[0, 0])):
        print(f"{kind}_{scale}", value, sum(getattr(system.functions, kind).stats.cache_hits.values()))
"""
INNER = "import numba\n@numba.njit\ndef inner(x):\n    return {0}.0 * x\n"


DAMAGES = {  # what stands in the file of a callback instead of its machine code
    "a_float": lambda data: b"",
    "a_helper": lambda data: data[: len(data) // 2],
    "a_helper_of_a_module": lambda data: bytes(len(data)),
}


def test_what_changes_in_other_files_and_damage_make_machine_code_stale(folder):
    folder.mechanism(**VALUES)
    folder.write("own_caches", OWN_CACHES + KERNELS)  # does not change
    folder.write("systems", SYSTEMS)
    for factor in (1, 2):
        for name, text in {"constants": CONSTANTS, "helpers": HELPERS, "inner": INNER}.items():
            folder.write(name, text.format(factor))
        kept = factor - 1  # what names none of it is read from the disk the second time
        same = {"nothing": (1.0, kept), "mass_1": (1.0, kept), "mass_10": (10.0, kept)}
        changed = {name: (factor, 0) for name in VALUES} | {"force_1": (factor, 0), "force_10": (10.0 * factor, 0)}
        assert folder.values(f"{RUN}\nimport systems") == changed | same
        assert folder.said.count(ANNOUNCED) == 1 - kept  # of the kernels

    def file(name):
        (found,) = folder.cache.glob(f"*/mechanism.{name}-*.nbc")
        return found

    for name, damage in DAMAGES.items():
        file(name).write_bytes(damage(file(name).read_bytes()))
    file("the_default_of_a_helper").write_bytes(file("nothing").read_bytes())  # that of another function
    damaged = {name: (2.0, 0) for name in (*DAMAGES, "the_default_of_a_helper")}
    known = {name: (2.0, 1) for name in VALUES} | {"nothing": (1.0, 1), "what_cannot_be_watched": (2.0, 0)}
    assert folder.values() == known | damaged
    assert folder.values() == known


def test_a_file_with_one_changed_bit_counts_as_missing(tmp_path):
    files, data = Files(tmp_path, "numbers", "stamp"), np.arange(20.0).tobytes()
    files.save("key", data)
    (path,) = tmp_path.iterdir()
    content = path.read_bytes()
    for place in range(0, len(content), 5):
        path.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
        assert files.load("key") is None, place
    path.write_bytes(content)
    assert files.load("key") == data


def block_caches(folder):
    """Stand files where numba wants to make folders; a folder without rights would not stop root."""
    for place in ("__pycache__", "home"):
        (folder.path / place).write_text("")
    home = str(folder.path / "home")
    return {"NUMBA_CACHE_DIR": home, "HOME": home, "XDG_CACHE_HOME": home}


def test_without_a_writable_folder_callbacks_and_kernels_run_and_say_so_once(folder):
    folder.mechanism(one="q[0]", two="q[0]")
    blocked = block_caches(folder)
    folder.write("kernels", KERNELS)
    values = folder.run(f"from kernels import *; print(twice(1.0), thrice(1.0))\n{RUN}", **blocked)
    assert values.split() == ["2.0", "3.0", "one", "1.0", "0", "two", "1.0", "0"] and folder.said.count(UNWRITABLE) == 1


# --- the digests themselves
NAMED = {"values": 1.0}


class Named(NamedTuple):
    one: float


@njit
def names_a_dictionary(x):
    return x + len(NAMED)


def test_a_digest_follows_the_values_of_any_type(monkeypatch):
    seen, numbers = set(), [1.0, 1, True, 1j, [1.0], (1.0,), (2.0,), Named(1.0), np.ones(1), 2.0 * np.ones(1)]
    for value in (*numbers, np.ones((1, 1)), "1", {"a": 1.0}, {"a": 2.0}, {1, 2}, None):
        monkeypatch.setitem(globals(), "NAMED", value)
        stamp = watch(names_a_dictionary.py_func)
        assert stamp == watch(names_a_dictionary.py_func)
        seen.add(stamp)
    assert len(seen) == 16 and None not in seen
    monkeypatch.setitem(globals(), "NAMED", object())
    assert watch(names_a_dictionary.py_func) is None


def scaled(scale, helper):
    @kept_when_called()
    def function(x):
        return scale * helper(x)

    return function


def test_closures_are_kept_by_what_they_enclose():
    one, two = (njit(lambda x, by=by: by * x) for by in (1.0, 2.0))
    for scale, helper, value in ((1.0, one, 1.0), (3.0, one, 3.0), (3.0, two, 6.0), (1.0, one, 1.0)):
        made = scaled(scale, helper)
        assert made(1.0) == value
    assert sum(made.stats.cache_hits.values()) == 1  # the last is the first
    named = njit(lambda x: OPEN_FILES[0] * x)
    assert scaled(1.0, named)._cache.cache_path is None  # it cannot be watched
    stands_for(named, "a name")
    assert scaled(1.0, named)._cache.cache_path is not None


OPEN_FILES = (object(),)
SYMBOL = """
import sys
from twoloop.problem.adapters import through_python

print(next(iter(through_python(sys.argv[1]).overloads.values())).fndesc.mangled_name)
"""


def test_closures_of_one_name_from_two_processes_have_symbols_of_their_own(tmp_path):
    # numba numbers symbols within a process: each of these two gives its only closure the same number
    cache = with_kernels(tmp_path / "cache")
    kinds = ("force_by_q", "reaction_by_q")
    assert len({run_python(SYMBOL, kind, NUMBA_CACHE_DIR=str(cache)).stdout for kind in kinds}) == 2
