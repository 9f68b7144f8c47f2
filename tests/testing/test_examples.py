"""The integrators of docs/examples pass their suites, and a fresh process needs numpy only for them."""

import os
import subprocess
import sys
from pathlib import Path

from tests.testing.planted import EXAMPLES

ROOT = Path(__file__).parents[2]
WITHOUT = "import sys; sys.modules.update(dict.fromkeys(['numba', 'scipy', 'llvmlite'])); import pytest; "


def test_the_suites_pass_where_numba_and_scipy_are_missing():
    program = WITHOUT + f"sys.exit(pytest.main(['-q', '-p', 'no:cacheprovider', {str(EXAMPLES)!r}]))"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTEST_ADDOPTS": "--rootdir=. -c /dev/null"}
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, cwd=EXAMPLES, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "4 passed" in done.stdout
