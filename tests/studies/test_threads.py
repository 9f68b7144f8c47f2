"""Studies on one thread: what BLAS and XLA have started once they have worked, in a process of its own."""

import os
import subprocess
import sys

import pytest

from studies.bench.cli import ROOT

NAMES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS", "NPROC", "XLA_FLAGS")
THREADS = "[open(f'/proc/self/task/{task}/comm').read().strip() for task in os.listdir('/proc/self/task')]"
pytestmark = pytest.mark.skipif(not os.path.isdir("/proc/self/task"), reason="threads are counted in /proc")


def printed(code, **environment):
    kept = {name: value for name, value in os.environ.items() if name not in NAMES} | environment
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=kept, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_blas_has_one_thread_whatever_the_caller_set():
    code = f"import os, studies, numpy; a = numpy.ones((300, 300)); a @ a; numpy.linalg.eigh(a); print(len({THREADS}))"
    assert printed(code, OMP_NUM_THREADS="4", OPENBLAS_NUM_THREADS="4") == "1"


@pytest.mark.parametrize("given", [{}, {"NPROC": "4", "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=true"}])
def test_xla_has_one_thread_to_compute_with(given):
    """Its flags alone left a pool with one for every core."""
    pytest.importorskip("jax")
    work = "a = jax.numpy.ones((300, 300)); (a @ a).block_until_ready()"
    code = f"import os, studies, jax; {work}; print({THREADS}.count('tf_XLAEigen'))"
    assert printed(code, **given) == "1"
