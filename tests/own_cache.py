"""Files of a mechanism, and caches of machine code with the kernels in them, for the processes of a test."""

import os
import shutil

from numba.core.caching import _CacheLocator

from tests.processes import ROOT, run_python
from twoloop.kernels.compile import callbacks
from twoloop.kernels.compile.caches import folder_of
from twoloop.kernels.evaluation import calls


def with_kernels(cache):
    """Fill a folder for NUMBA_CACHE_DIR with what every run needs: the inner loop, and what stands for callbacks."""
    for module, names in ((calls, "calls.inner_loop-*"), (callbacks, "callbacks.stand_in.*")):
        folder = cache / _CacheLocator.get_suitable_cache_subpath(module.__file__)
        folder.mkdir(parents=True)
        for file in folder_of(module).glob(names):
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

    def values(self, source=RUN):
        """{name: (value, how often its machine code was read)}."""
        rows = [line.split() for line in self.run(source).splitlines()]
        return {name: (float(value), int(hits)) for name, value, hits in rows}
