"""Machine code on disk: read again when nothing changed, rebuilt when anything did, never a reason to fail."""

import hashlib
import math
import os
import pickle
import shutil
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numba import njit
from numba.core.caching import _CacheLocator

from tests.processes import ROOT, run_python
from twoloop.kernels.compile import caches as ownership
from twoloop.kernels.compile import callbacks
from twoloop.kernels.compile.caches import (
    UNWRITABLE_CACHE_WARNING,
    CodeFiles,
    cache_folder,
    digests_of,
    make_trusted_folder,
    reason_to_distrust,
    trusted_folder,
)
from twoloop.kernels.evaluation import inner_loop as calls


def with_kernels(cache):
    """Fill a folder for NUMBA_CACHE_DIR with what every run needs: the inner loop, and what stands for callbacks."""
    for module, names in ((calls, "inner_loop.inner_loop-*"), (callbacks, "callbacks.zero_callback.*")):
        folder = cache / _CacheLocator.get_suitable_cache_subpath(module.__file__)
        folder.mkdir(parents=True)
        for file in cache_folder(module).glob(names):
            shutil.copy(file, folder)
    return cache


# what a mechanism's file looks like: a callback for each value, some of which enclose a global
MECHANISM = """
import numpy as np
import numba
from typing import NamedTuple
from twoloop import callback
import constants, helpers
from constants import *
from helpers import *

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

    def values(self, source=RUN):
        """{name: (value, how often its machine code was read)}."""
        rows = [line.split() for line in self.run(source).splitlines()]
        return {name: (float(value), int(hits)) for name, value, hits in rows}


@pytest.fixture
def folder(tmp_path):
    return Folder(tmp_path)


VALUES = {"a_float": "FLOAT", "an_attribute_of_a_module": "constants.FLOAT", "a_helper": "helper(q[0])"}
VALUES |= {"a_helper_of_a_module": "helpers.helper(q[0])", "the_default_of_a_helper": "with_default()"}
VALUES |= {"the_helper_of_a_helper": "outer(q[0])", "the_global_of_a_helper": "named(q[0])"}
VALUES |= {"an_enclosed_value": "enclosed;FLOAT", "an_enclosed_helper": "enclosed(q[0]);helper"}
VALUES |= {"what_cannot_be_watched": "overloaded(q[0])", "nothing": "q[0]"}
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


@pytest.mark.slow
def test_what_changes_in_other_files_and_damage_make_machine_code_stale(folder):
    folder.mechanism(**VALUES)
    folder.write("kernels", KERNELS)  # does not change
    folder.write("systems", SYSTEMS)
    for factor in (1, 2):
        for name, text in {"constants": CONSTANTS, "helpers": HELPERS, "inner": INNER}.items():
            folder.write(name, text.format(factor))
        kept = factor - 1  # what names none of it is read from the disk the second time
        same = {"nothing": (1.0, kept), "mass_1": (1.0, kept), "mass_10": (10.0, kept)}
        changed = {name: (factor, 0) for name in VALUES} | {"force_1": (factor, 0), "force_10": (10.0 * factor, 0)}
        assert folder.values(f"import kernels\n{RUN}\nimport systems") == changed | same
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
    files, data = CodeFiles(tmp_path, "numbers", "stamp"), np.arange(20.0).tobytes()
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


@pytest.mark.slow
def test_without_a_writable_folder_callbacks_and_kernels_run_and_say_so_once(folder):
    folder.mechanism(one="q[0]", two="q[0]")
    blocked = block_caches(folder)
    folder.write("kernels", KERNELS)
    values = folder.run(f"from kernels import *; print(twice(1.0), thrice(1.0))\n{RUN}", **blocked)
    assert (
        values.split() == ["2.0", "3.0", "one", "1.0", "0", "two", "1.0", "0"]
        and folder.said.count(UNWRITABLE_CACHE_WARNING) == 1
    )


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
        stamp = digests_of(names_a_dictionary.py_func)
        assert stamp == digests_of(names_a_dictionary.py_func)
        seen.add(stamp)
    assert len(seen) == 16 and None not in seen
    monkeypatch.setitem(globals(), "NAMED", object())
    assert digests_of(names_a_dictionary.py_func) is None


# --- code is loaded from what no other user can write, as ssh asks of keys; what others can write is compiled anew
pytestmark = pytest.mark.skipif(os.name != "posix", reason="rights on other systems are not in the mode")


class Planted:
    """A pickle that makes a file when it is read."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@pytest.fixture(autouse=True)
def first_warning(monkeypatch):
    monkeypatch.setattr(ownership, "_warnings", [])
    trusted_folder.cache_clear()
    yield
    trusted_folder.cache_clear()


@pytest.fixture
def user(tmp_path):
    """Runs of a mechanism with caches of its own: its value, how often it was read, and what was said."""
    folder, home = Folder(tmp_path), tmp_path / "home"
    folder.mechanism(force="2.0 * q[0]")

    def run(umask=0o022):
        _, value, hits = folder.run(f"import os; os.umask({umask})\n{RUN}", XDG_CACHE_HOME=str(home)).split()
        return float(value), int(hits), folder.said

    run.cache, run.home, run.planted = folder.cache, home, tmp_path / "planted"
    run.file = lambda: next(folder.cache.glob("*/mechanism.force-*.nbc"))
    return run


def plant(path, mark):
    """What whoever can write a file does: other content, and the right checksum."""
    content = pickle.dumps(("", pickle.dumps(Planted(mark)), Planted(mark)))
    path.write_bytes(hashlib.sha256(content).digest() + content)


@pytest.mark.slow
def test_what_others_can_write_is_not_loaded(user, monkeypatch):
    assert user(umask=0)[:2] == (2.0, 0)
    assert user.file().stat().st_mode & 0o022 == user.file().parent.stat().st_mode & 0o022 == 0
    plant(user.file(), user.planted)
    user.file().chmod(0o666)
    value, hits, said = user()
    assert (value, hits) == (2.0, 0) and not user.planted.exists()
    assert said.count("can be written by everybody (mode 666), and is not loaded but compiled again") == 1
    assert user() == (2.0, 1, "")  # repaired
    plant(user.file(), user.planted)
    user.cache.chmod(0o777)  # above the folder of the file
    monkeypatch.setenv("XDG_CACHE_HOME", str(user.home))
    for folder in set(user.cache.iterdir()) - {user.file().parent}:  # of the kernels, which would be compiled again
        shutil.copytree(folder, trusted_folder(folder))
    value, hits, said = user()
    assert (value, hits) == (2.0, 0) and not user.planted.exists()
    assert said.count("twoloop: no code is loaded from") == 1 and "set NUMBA_CACHE_DIR to a folder of your own" in said
    assert user()[:2] == (2.0, 1)  # from the folder of this user's caches


def test_generated_source_that_others_can_write_is_not_run(tmp_path, monkeypatch, capsys):
    generated = pytest.importorskip("twoloop.problem.compiled_functions")
    monkeypatch.setattr(generated, "sources_folder", lambda: tmp_path)
    code = generated.GeneratedCode("key", "def energy(t, q, v, p):\n    return 0.0\n")
    generated.replace_trusted(tmp_path / "equations_key.py", f"{generated._head(code.source)}\n{code.source}".encode())
    assert generated.GeneratedCode.stored("key") == code
    (tmp_path / "equations_key.py").chmod(0o646)
    assert generated.GeneratedCode.stored("key") is None
    assert "equations_key.py can be written by everybody" in capsys.readouterr().err


OTHER = 4242  # neither root nor us


def seen_as(monkeypatch, path, **changes):
    """Let a file or folder look as if it had another owner, group or mode."""
    real = os.stat

    def stat(where, *arguments, **options):
        found = real(where, *arguments, **options)
        if isinstance(where, (str, Path)) and Path(where) == path:
            values = list(found)[:10]
            for name, place in {"mode": 0, "uid": 4, "gid": 5}.items():
                values[place] = changes.get(name, values[place])
            found = os.stat_result(values)
        return found

    monkeypatch.setattr(os, "stat", stat)


DOUBTS = [({}, ""), ({"uid": 0}, ""), ({"uid": OTHER}, f"belongs to user {OTHER}")]
DOUBTS += [({"mode": 0o040777}, "can be written by everybody (mode 777)"), ({"mode": 0o040755, "gid": OTHER}, "")]
DOUBTS += [({"mode": 0o040775, "gid": OTHER}, f"can be written by group {OTHER} (mode 775)")]


@pytest.mark.parametrize(("changes", "why"), DOUBTS)
@pytest.mark.parametrize("above", [False, True])
def test_whose_folders_are_in_doubt(tmp_path, monkeypatch, changes, why, above):
    folder = tmp_path / "above" / "folder"
    make_trusted_folder(folder)
    at = folder.parent if above else folder
    seen_as(monkeypatch, at, **changes)
    assert reason_to_distrust(folder) == (f"{at} {why}" if why else "") and (trusted_folder(folder) == folder) == (
        not why
    )


@njit
def takes_an_attribute(x):
    return math.log(x)


def test_an_attribute_is_not_the_global_of_the_same_name(monkeypatch):
    """A callback that calls `math.log` was not kept where its file had something else that is called `log`."""
    stamp = digests_of(takes_an_attribute.py_func)
    monkeypatch.setitem(globals(), "log", object())
    assert digests_of(takes_an_attribute.py_func) == stamp is not None
