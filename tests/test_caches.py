"""Machine code on disk: read again when nothing changed, made anew when anything did, never a reason to fail."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba import njit

from twoloop.caches import UNWRITABLE, watch

ROOT = Path(__file__).parents[1]

# what a mechanism's file looks like: the callback under test, and the value that it gives
MECHANISM = """
import numpy as np
import numba
from twoloop import callback
import constants, helpers
from constants import *
from helpers import *

def within(inner):
    @callback("force")
    def force(t, q, v, p, Q):
        Q[0] = {enclosed}
    return force

@callback("force")
def force(t, q, v, p, Q):
    Q[0] = {value}

if {is_enclosed}:
    force = within(inner)

def value(function):
    Q = np.zeros(1)
    function(0.0, np.ones(1), np.ones(1), np.ones(1), Q)
    return float(Q[0])
"""
# the value, and how often its machine code was read from the disk
RUN = "import mechanism as m; print(m.value(m.force), sum(m.force.stats.cache_hits.values()))"


class Folder:
    """Files of a mechanism, and processes that run it with a cache of their own."""

    def __init__(self, path):
        self.path = path
        self.cache = path / "cache"
        self.write("constants", "")
        self.write("helpers", "")

    def write(self, name, text):
        (self.path / f"{name}.py").write_text(text)

    def mechanism(self, value, enclosed=None):
        self.write("mechanism", MECHANISM.format(value=value, enclosed=enclosed or 0.0, is_enclosed=enclosed is not None))

    def run(self, source=RUN, **environment):
        variables = {
            **os.environ,
            "NUMBA_CACHE_DIR": str(self.cache),
            "PYTHONPATH": f"{self.path}{os.pathsep}{ROOT}",
            "PYTHONDONTWRITEBYTECODE": "1",  # Python's own cache sees whole seconds only
            **environment,
        }
        command = [sys.executable, "-c", source]
        done = subprocess.run(command, env=variables, cwd=self.path, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        self.said = done.stderr
        return tuple(float(word) for word in done.stdout.split())


@pytest.fixture
def folder(tmp_path):
    return Folder(tmp_path)


HELPER = "import numba\nimport constants\n@numba.njit\ndef helper(x):\n    return {}\n"
# name: (the value in the callback, file that changes, before: 1, after: 2)
CHANGES = {
    "a float": ("FACTOR", "constants", "FACTOR = 1.0", "FACTOR = 2.0"),
    "an int": ("1.0 * FACTOR", "constants", "FACTOR = 1", "FACTOR = 2"),
    "a tuple": ("FACTORS[1]", "constants", "FACTORS = (0.0, 1.0)", "FACTORS = (0.0, 2.0)"),
    "an array": ("FACTORS[1]", "constants", "import numpy as np\nFACTORS = np.arange(2.0)", "import numpy as np\nFACTORS = 2.0 * np.arange(2.0)"),
    "a named tuple": (
        "FACTORS.one",
        "constants",
        "from typing import NamedTuple\nclass F(NamedTuple):\n    one: float\nFACTORS = F(1.0)",
        "from typing import NamedTuple\nclass F(NamedTuple):\n    one: float\nFACTORS = F(2.0)",
    ),
    "an attribute of a module": ("constants.FACTOR", "constants", "FACTOR = 1.0", "FACTOR = 2.0"),
    "a helper's code": ("helper(q[0])", "helpers", HELPER.format("x"), HELPER.format("x + 1.0")),
    "a helper's module": ("helpers.helper(q[0])", "helpers", HELPER.format("x"), HELPER.format("x + 1.0")),
    "a helper's default": (
        "helper()",
        "helpers",
        HELPER.format("x").replace("(x)", "(x=1.0)"),
        HELPER.format("x").replace("(x)", "(x=2.0)"),
    ),
}


@pytest.mark.parametrize("name", CHANGES)
def test_what_changes_in_another_file_makes_machine_code_stale(folder, name):
    value, file, before, after = CHANGES[name]
    folder.mechanism(value)
    folder.write(file, before)
    assert folder.run() == (1.0, 0)
    assert folder.run() == (1.0, 1)
    folder.write(file, after)
    assert folder.run() == (2.0, 0)
    assert folder.run() == (2.0, 1)


def test_what_a_helper_calls_in_turn_is_watched(folder):
    folder.mechanism("outer(q[0])")
    folder.write("helpers", "import numba, constants\nfrom inner import inner\n@numba.njit\ndef outer(x):\n    return inner(x)")
    inner = "import numba, constants\n@numba.njit\ndef inner(x):\n    return constants.FACTOR * x"
    folder.write("inner", inner)
    folder.write("constants", "FACTOR = 1.0")
    assert folder.run() == (1.0, 0)
    folder.write("constants", "FACTOR = 2.0")  # a global of the helper's helper
    assert folder.run() == (2.0, 0)
    folder.write("inner", inner + " + 1.0")  # its code
    assert folder.run() == (3.0, 0)
    assert folder.run() == (3.0, 1)


@pytest.mark.parametrize("inner", ["inner = {}.0", "import numba\n@numba.njit\ndef inner(x):\n    return {}.0 * x"])
def test_what_a_callback_encloses_is_watched(folder, inner):
    folder.mechanism("0.0", enclosed="inner" if inner.startswith("inner") else "inner(q[0])")
    for factor in (1, 2):
        folder.write("helpers", inner.format(factor))
        assert folder.run() == (factor, 0)
        assert folder.run() == (factor, 1)


def test_what_cannot_be_watched_is_not_kept(folder):
    folder.mechanism("plain(q[0])")
    overloaded = (
        "from numba.extending import overload\ndef plain(x):\n    pass\n"
        "@overload(plain)\ndef _(x):\n    return lambda x: {}.0 * x\n"
    )
    for factor in (1, 2):
        folder.write("helpers", overloaded.format(factor))
        assert folder.run() == (factor, 0)


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
@pytest.mark.parametrize("damage", [lambda data: b"", lambda data: data[: len(data) // 2], lambda data: bytes(len(data))])
def test_a_damaged_file_is_made_anew(folder, ending, damage):
    folder.mechanism("q[0]")
    assert folder.run() == (1.0, 0)
    files = list(folder.cache.glob(f"*/mechanism*.{ending}"))
    assert files
    for file in files:
        file.write_bytes(damage(file.read_bytes()))
    assert folder.run() == (1.0, 0)
    assert folder.run() == (1.0, 1)


def block_caches(folder):
    """Stand files where numba wants to make folders; a folder without rights would not stop root."""
    for place in ("__pycache__", "home"):
        (folder.path / place).write_text("")
    home = str(folder.path / "home")
    return {"NUMBA_CACHE_DIR": home, "HOME": home, "XDG_CACHE_HOME": home}


def test_without_a_writable_folder_callbacks_run_and_say_so_once(folder):
    folder.mechanism("q[0]")
    assert folder.run(**block_caches(folder)) == (1.0, 0)
    assert folder.said.count(UNWRITABLE) == 1


def test_without_a_writable_folder_kernels_run_and_say_so_once(folder):
    blocked = block_caches(folder)
    folder.write(
        "kernels",
        "from twoloop.kernels.common import kernel, f8\n"
        "@kernel(f8(f8))\ndef twice(x):\n    return 2.0 * x\n"
        "@kernel(f8(f8))\ndef thrice(x):\n    return 3.0 * x\n",
    )
    assert folder.run("from kernels import *; print(twice(1.0), thrice(1.0))", **blocked) == (2.0, 3.0)
    assert folder.said.count(UNWRITABLE) == 1


def test_a_kernel_is_announced_when_it_compiles_and_only_then(folder):
    folder.write("kernels", "from twoloop.kernels.common import kernel, f8\n@kernel(f8(f8))\ndef twice(x):\n    return 2.0 * x\n")
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
        n_q=2, n_c=1, compile=True, mass=scale * np.eye(2),
        force=lambda t, q, v: scale * FACTOR * q,
        constraint=lambda t, q: q[:1] - 1.0, jacobian=lambda t, q: np.array([[1.0, 0.0]]))
"""
RUN_SYSTEM = """
from system import made
one, two = made(1.0), made(10.0)
print(one.force(0.0, [1.0, 2.0], [0.0, 0.0])[0], two.force(0.0, [1.0, 2.0], [0.0, 0.0])[0], two.mass(0.0, [0.0, 0.0])[0, 0],
      sum(sum(getattr(each.functions, kind).stats.cache_hits.values()) for each in (one, two) for kind in each.given))
"""


def test_functions_that_from_python_compiles_are_kept(folder):
    folder.write("system", SYSTEM)
    folder.write("constants", "FACTOR = 1.0")
    assert folder.run(RUN_SYSTEM)[:3] == (1.0, 10.0, 10.0)
    assert folder.run(RUN_SYSTEM) == (1.0, 10.0, 10.0, 8)
    folder.write("constants", "FACTOR = 3.0")
    assert folder.run(RUN_SYSTEM)[:3] == (3.0, 30.0, 10.0)


# --- the digests themselves

NAMED = {"values": 1.0}


@njit
def names_a_dictionary(x):
    return x + len(NAMED)


def test_a_digest_follows_the_values_of_any_type(monkeypatch):
    seen = set()
    for value in (1.0, 1, True, "1", {"a": 1.0}, {"a": 2.0}, {1, 2}, [1.0], (1.0,), np.ones(1), np.ones((1, 1)), None, 1j):
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
