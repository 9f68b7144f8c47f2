"""Configure hypothesis (no deadlines, as the first call may compile; always the same examples) and share fixtures."""

import gc
import signal
import sys
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest
from hypothesis import settings

# what takes long to import is imported where it is used: the process that distributes the tests needs none of it

# not collected where the packages of the studies, or of the documentation, are not installed: `make test-oldest`
NEED_STUDIES = (
    *("symbolic/test_from_lagrangian.py", "symbolic/test_matrices.py"),
    *("test_differential.py", "test_docs.py", "test_rooms.py"),
)
LONGEST = (  # seconds each; those that compile most in a fresh clone are first
    *("test_short_forces.py", "test_examples.py", "test_docs.py", "test_equations.py"),
    *("test_derivative_campaign.py", "test_lane_methods.py", "test_spring_functions.py", "test_motions.py"),
    *("test_sweeps.py", "test_check.py", "test_algebra.py", "test_claims.py", "test_newton.py"),
)
collect_ignore = [] if find_spec("pandas") and find_spec("matplotlib") else list(NEED_STUDIES)
settings.register_profile("twoloop", deadline=None, derandomize=True, max_examples=25)
settings.load_profile("twoloop")


@pytest.fixture(autouse=True)
def no_figures_stay():
    """Close all figures: Matplotlib warns when many are open."""
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")


def import_from_the_last(config):
    """Let the second of two workers begin at the other end: what one has compiled to bytecode, the other one reads."""
    worker = getattr(config, "workerinput", {}).get("workerid")
    if worker == "gw1" and config.args_source is config.ArgsSource.TESTPATHS:
        for path in sorted(Path(__file__).parent.rglob("test_*.py"), reverse=True):
            with suppress(Exception, pytest.skip.Exception):  # collection says what is wrong
                import_module(".".join(path.relative_to(config.rootpath).with_suffix("").parts))


@pytest.hookimpl(wrapper=True)
def pytest_collection(session):
    """Switch garbage collection off while modules are imported: nothing of it is garbage."""
    gc.disable()
    try:
        import_from_the_last(session.config)
        return (yield)
    finally:
        gc.enable()


def pytest_collection_modifyitems(items):
    """Run the longest files first, so that neither of two workers waits for the other at the end."""
    place = {name: k for k, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.name, len(LONGEST)))


def pytest_collection_finish():
    """Freeze what was imported: Python need not search it for cycles again and again."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)


@pytest.fixture(scope="session")
def default_four_bar():
    return import_module("tests.problems").LINKAGES["default"]


@pytest.fixture(scope="session")
def collinear_four_bar():
    return import_module("tests.problems").LINKAGES["collinear"]


@pytest.fixture
def collected_alone():
    """Let a collection of cycles search only what the test makes: all else takes seconds."""
    gc.freeze()


@pytest.fixture
def interruptible():
    """Set Python's own handler of Ctrl-C, which shells take away from jobs in the background."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def taken(monkeypatch):
    """Record for each call whether it used the arrays of an earlier run."""
    from twoloop import solve
    from twoloop.run import cached

    integrate, set_up, ways, new = solve.cached_result, cached.set_up, [], []

    def watched(*given):
        before = len(new)
        made = integrate(*given)
        ways.append(type(made) is tuple and len(new) == before)
        return made

    monkeypatch.setattr(cached, "set_up", lambda *given: new.append(1) or set_up(*given))
    monkeypatch.setattr(solve, "cached_result", watched)
    return ways


@pytest.fixture
def by_the_loop(monkeypatch):
    """Let all runs that follow take the integration loop from their start on."""

    def switch():
        monkeypatch.setattr("twoloop.solve.cached_result", lambda *given: None)

    return switch
