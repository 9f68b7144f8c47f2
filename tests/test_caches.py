"""Machine code on disk: read again when nothing changed, rebuilt when anything did, never a reason to fail."""

import os

import numpy as np
import pytest
from numba import njit

from tests.own_cache import with_kernels
from tests.processes import ROOT, run_python
from twoloop.kernels.compile.caches import UNWRITABLE, watch

# what a mechanism's file looks like: a callback for each value, some of which enclose a global
MECHANISM = """
import numpy as np
import numba
from typing import NamedTuple
from twoloop import callback
import constants, helpers
from constants import *
from helpers import *
from own_caches import *

class Callbacks:
    pass

{callbacks}

def value(function):
    Q = np.zeros(1)
    function(0.0, np.ones(1), np.ones(1), np.ones(1), Q)
    return float(Q[0])
"""
CALLBACK = """
@callback("force")
def {name}(t, q, v, p, Q):
    Q[0] = {value}
Callbacks.{name} = {name}
"""
ENCLOSING = """
def make_{name}(enclosed):
    @callback("force")
    def force(t, q, v, p, Q):
        Q[0] = {value}
    return force
Callbacks.{name} = make_{name}({enclosed})
"""
# names, values, and how often the machine code was read from the disk
RUN = """
import mechanism as m
for name, function in vars(m.Callbacks).items():
    if not name.startswith("_"):
        print(name, m.value(function), sum(function.stats.cache_hits.values()))
"""


class Folder:
    """Files of a mechanism, and processes that run it with a cache of their own."""

    def __init__(self, path):
        self.path = path
        self.cache = with_kernels(path / "cache")
        self.write("constants", "")
        self.write("helpers", "")
        self.write("own_caches", "")

    def write(self, name, text):
        (self.path / f"{name}.py").write_text(text)

    def mechanism(self, **values):
        """A callback for each value; what stands behind a semicolon is enclosed."""
        texts = []
        for name, value in values.items():
            text, _, enclosed = value.partition(";")
            texts.append((ENCLOSING if enclosed else CALLBACK).format(name=name, value=text, enclosed=enclosed))
        self.write("mechanism", MECHANISM.format(callbacks="".join(texts)))

    def run(self, source=RUN, **environment):
        variables = {
            "NUMBA_CACHE_DIR": str(self.cache),
            "PYTHONPATH": f"{self.path}{os.pathsep}{ROOT}",
            "PYTHONDONTWRITEBYTECODE": "1",  # Python's own cache sees whole seconds only
        }
        done = run_python(source, folder=self.path, **variables | environment)
        self.said = done.stderr
        return done.stdout

    def values(self, **environment):
        """{name: (value, how often its machine code was read)}."""
        rows = [line.split() for line in self.run(**environment).splitlines()]
        return {name: (float(value), int(hits)) for name, value, hits in rows}


@pytest.fixture
def folder(tmp_path):
    return Folder(tmp_path)


VALUES = {
    "a_float": "FLOAT",
    "an_int": "1.0 * INT",
    "a_tuple": "TUPLE[1]",
    "an_array": "ARRAY[1]",
    "a_named_tuple": "NAMED.one",
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
CONSTANTS = """
import numpy as np
from typing import NamedTuple
class Named(NamedTuple):
    one: float
FLOAT, INT, TUPLE, ARRAY, NAMED = {0}.0, {0}, (0.0, {0}.0), {0}.0 * np.arange(2.0), Named({0}.0)
"""
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
INNER = "import numba\n@numba.njit\ndef inner(x):\n    return {0}.0 * x\n"


def test_what_changes_in_other_files_makes_machine_code_stale(folder):
    folder.mechanism(**VALUES)
    folder.write("own_caches", OWN_CACHES)  # does not change
    for factor in (1, 2):
        for name, text in {"constants": CONSTANTS, "helpers": HELPERS, "inner": INNER}.items():
            folder.write(name, text.format(factor))
        kept = factor - 1  # what names none of it is read from the disk the second time
        assert folder.values() == {name: (factor, 0) for name in VALUES} | {"nothing": (1.0, kept)}
    never = {"what_cannot_be_watched": (2.0, 0)}
    assert folder.values() == {name: (2.0, 1) for name in VALUES} | {"nothing": (1.0, 1)} | never


DAMAGES = {
    "empty": lambda data: b"",
    "truncated": lambda data: data[: len(data) // 2],
    "zeros": lambda data: bytes(len(data)),
}


def test_damaged_files_and_those_of_other_functions_are_rebuilt(folder):
    folder.mechanism(**{name: "q[0]" for name in DAMAGES}, one="q[0]", two="2.0 * q[0]")
    folder.values()

    def file(name):
        (found,) = folder.cache.glob(f"*/mechanism.{name}-*.nbc")
        return found

    for name, damage in DAMAGES.items():
        file(name).write_bytes(damage(file(name).read_bytes()))
    file("one").write_bytes(file("two").read_bytes())
    sound = {name: 1.0 for name in (*DAMAGES, "one")}
    assert folder.values() == {name: (value, 0) for name, value in sound.items()} | {"two": (2.0, 1)}
    assert folder.values() == {name: (value, 1) for name, value in sound.items()} | {"two": (2.0, 1)}


def block_caches(folder):
    """Stand files where numba wants to make folders; a folder without rights would not stop root."""
    for place in ("__pycache__", "home"):
        (folder.path / place).write_text("")
    home = str(folder.path / "home")
    return {"NUMBA_CACHE_DIR": home, "HOME": home, "XDG_CACHE_HOME": home}


def test_without_a_writable_folder_callbacks_and_kernels_run_and_say_so_once(folder):
    folder.mechanism(one="q[0]", two="q[0]")
    blocked = block_caches(folder)
    folder.write(
        "kernels",
        "from twoloop.kernels.data.common import kernel, f8\n"
        "@kernel(f8(f8))\ndef twice(x):\n    return 2.0 * x\n"
        "@kernel(f8(f8))\ndef thrice(x):\n    return 3.0 * x\n",
    )
    values = folder.run(f"from kernels import *; print(twice(1.0), thrice(1.0))\n{RUN}", **blocked)
    assert values.split() == ["2.0", "3.0", "one", "1.0", "0", "two", "1.0", "0"]
    assert folder.said.count(UNWRITABLE) == 1


def test_a_kernel_is_announced_when_it_compiles_and_only_then(folder):
    folder.write(
        "kernels",
        "from twoloop.kernels.data.common import kernel, f8\n@kernel(f8(f8))\ndef twice(x):\n    return 2.0 * x\n",
    )
    source = "from kernels import *; print(twice(1.0))"
    folder.run(source)
    assert folder.said.count("compiling the integrator") == 1
    folder.run(source)
    assert folder.said == ""


SYSTEM = """
import numpy as np
from twoloop import ConstrainedSystem
from constants import FACTOR

def made(scale):
    return ConstrainedSystem.from_python(
        n_q=2, n_c=0, compile=True, mass=scale * np.eye(2), force=lambda t, q, v: scale * FACTOR * q)
"""
RUN_SYSTEM = """
from system import made
one, two = made(1.0), made(10.0)
q, v = [1.0, 2.0], [0.0, 0.0]
print(one.force(0.0, q, v)[0], two.force(0.0, q, v)[0], two.mass(0.0, q)[0, 0],
      sum(sum(getattr(each.functions, kind).stats.cache_hits.values()) for each in (one, two) for kind in each.given))
"""


def test_functions_that_from_python_compiles_are_kept(folder):
    folder.write("system", SYSTEM)
    folder.write("constants", "FACTOR = 1.0")
    assert folder.run(RUN_SYSTEM).split()[:3] == ["1.0", "10.0", "10.0"]
    folder.write("constants", "FACTOR = 3.0")
    assert folder.run(RUN_SYSTEM).split() == ["3.0", "30.0", "10.0", "2"]  # all but the two forces are read


# --- the digests themselves

NAMED = {"values": 1.0}


@njit
def names_a_dictionary(x):
    return x + len(NAMED)


def test_a_digest_follows_the_values_of_any_type(monkeypatch):
    seen = set()
    for value in (
        1.0,
        1,
        True,
        "1",
        {"a": 1.0},
        {"a": 2.0},
        {1, 2},
        [1.0],
        (1.0,),
        np.ones(1),
        np.ones((1, 1)),
        None,
        1j,
    ):
        monkeypatch.setitem(globals(), "NAMED", value)
        stamp = watch(names_a_dictionary.py_func)
        assert stamp == watch(names_a_dictionary.py_func)
        seen.add(stamp)
    assert len(seen) == 13
    assert None not in seen
    monkeypatch.setitem(globals(), "NAMED", object())
    assert watch(names_a_dictionary.py_func) is None


def test_digests_of_functions_that_name_themselves_end():
    @njit
    def again(x):
        return again(x - 1.0) if x > 0.0 else 0.0

    assert watch(again.py_func) == watch(again.py_func) is not None


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
