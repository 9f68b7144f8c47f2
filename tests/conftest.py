"""Hypothesis without deadlines (the first call may compile) and always with the same examples; shared problems."""

import gc
import signal
import sys
from importlib.util import find_spec

import pytest
from hypothesis import settings

from tests.problems import LINKAGES
from twoloop import solve

# not collected where the packages of the studies, or of the documentation, are not installed: `make test-oldest`
NEED_STUDIES = (
    *("general/test_cost.py", "kernels/test_augmented.py", "kernels/test_factors.py", "kernels/test_saddle_point.py"),
    *("symbolic/test_from_lagrangian.py", "symbolic/test_matrices.py", "test_differential.py"),
    *("test_docs.py", "test_rooms.py"),
)
LONG_AND_LATE = {"test_docs.py", "test_check.py", "test_examples.py"}
collect_ignore = [] if find_spec("pandas") and find_spec("matplotlib") else list(NEED_STUDIES)
settings.register_profile("twoloop", deadline=None, derandomize=True, max_examples=25)
settings.load_profile("twoloop")


@pytest.fixture(autouse=True)
def no_figures_stay():
    """Matplotlib warns of many that are open, of whichever tests a worker has run."""
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Nothing of what is imported is garbage."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()


def pytest_collection_modifyitems(items):
    """The longest of the files that would come last come first, so that neither of two workers waits for one."""
    items.sort(key=lambda item: item.path.name not in LONG_AND_LATE)


def pytest_collection_finish():
    """What the tests have imported stays: Python need not look through it for cycles again and again."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)


@pytest.fixture(scope="session")
def default_four_bar():
    return LINKAGES["default"]


@pytest.fixture(scope="session")
def collinear_four_bar():
    return LINKAGES["collinear"]


@pytest.fixture
def collected_alone():
    """A collection of cycles looks at what the test makes: of all else a worker has, it takes seconds."""
    gc.freeze()


@pytest.fixture
def interruptible():
    """Python's own handler of Ctrl-C, without which shells start jobs in the background."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def taken(monkeypatch):
    """How calls were made: True by the arrays of a run before."""
    made, ways = solve.record_again, []

    def watched(*asked):
        record = made(*asked)
        ways.append(record is not None)
        return record

    monkeypatch.setattr(solve, "record_again", watched)
    return ways
