"""pytest plugin: `--simulator MODULE:FUNCTION` adds a test for each problem and property; fixture `reference_motion`.

pytest imports it in every run where twoloop is installed, so numpy is imported on first use only.
"""

import importlib
import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from twoloop.testing.findings import Finding
    from twoloop.testing.known_problem import KnownProblem, Motion
    from twoloop.testing.measuring import Settings


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the command-line options, and the list of known failures in pyproject.toml."""
    group = parser.getgroup("twoloop", "check of a simulator of mechanisms")
    group.addoption(
        "--simulator", metavar="MODULE:FUNCTION", help="simulate(problem, times, tolerance or step) to check"
    )
    group.addoption("--simulator-problems", metavar="NAMES", default="smoke", help="smoke, all, or names with commas")
    group.addoption("--simulator-steps", metavar="N,N,...", help="for fixed steps: numbers of steps over the span")
    group.addoption("--simulator-order", type=float, metavar="P", help="for fixed steps: the order of the method")
    limit = "seconds of a run, 0 for no limit (to debug)"
    group.addoption("--simulator-time-limit", type=float, default=120.0, metavar="S", help=limit)
    group.addoption("--simulator-report", metavar="FILE", help="write all measurements as Markdown")
    known = "known failures of --simulator, one per line: PROBLEM: PROPERTY"
    parser.addini("simulator_known_failures", known, type="linelist", default=[])


@pytest.fixture
def reference_motion() -> "Callable[[str], Motion]":
    """reference_motion("four_bar") -> the known motion: t, q, v, lam, digits, growth (twoloop.testing.Motion)."""

    def motion(name: str) -> "Motion":
        from twoloop.testing.known_problems import MAKERS

        moving = {each: maker for each, maker in MAKERS.items() if maker().reference is not None}
        if name not in moving:
            raise ValueError(f"reference_motion takes a name of {', '.join(moving)}; given {name!r}")
        found = moving[name]().reference
        assert found is not None
        return found

    return motion


def pytest_configure(config: pytest.Config) -> None:
    """With a report, collect the measurements, including those of other processes."""
    path = config.getoption("simulator_report")
    if path is not None and not hasattr(config, "workerinput"):
        config.pluginmanager.register(_Findings(Path(path)), "twoloop_simulator_report")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(session: pytest.Session, config: pytest.Config, items: list[pytest.Item]) -> None:
    """Add the tests before -k selects among them."""
    if config.getoption("simulator") is None:
        return
    from twoloop.testing.conformance import properties_of, settings_of
    from twoloop.testing.known_problems import named

    simulate = _loaded(config.getoption("simulator"), config.invocation_params.dir)
    chosen, steps = config.getoption("simulator_problems"), config.getoption("simulator_steps")
    try:
        settings = settings_of(
            (1e-4, 1e-6, 1e-8),
            None if steps is None else [int(part) for part in steps.split(",")],
            config.getoption("simulator_order"),
            config.getoption("simulator_time_limit") or None,
        )
        problems = named(chosen if chosen in ("smoke", "all") else chosen.split(","))
    except ValueError as error:
        raise pytest.UsageError(f"--simulator: {error}") from None
    known = {tuple(part.strip() for part in line.split(":", 1)) for line in config.getini("simulator_known_failures")}
    for problem in problems:
        suite = _Suite.from_parent(session, name=problem.name, nodeid=f"simulator::{problem.name}")
        suite.ask = (simulate, problem, settings)
        for name in properties_of(problem, settings):
            item = _Property.from_parent(suite, name=name)
            if (problem.name, name) in known:
                item.add_marker(pytest.mark.xfail(reason="a known failure", strict=True))
            items.append(item)


def _loaded(where: str, folder: Path) -> Callable[..., Any]:
    """Return the function named by "module:function" or "file.py:function"."""
    module_name, _, function = where.rpartition(":")
    try:
        if not module_name:
            raise ImportError("expected MODULE:FUNCTION or FILE.py:FUNCTION")
        if module_name.endswith(".py"):
            spec = importlib.util.spec_from_file_location(Path(module_name).stem, folder / module_name)
            assert spec is not None and spec.loader is not None
            module = importlib.util.module_from_spec(spec)
            sys.modules.setdefault(spec.name, module)
            spec.loader.exec_module(module)
        else:
            sys.path.insert(0, str(folder))
            module = importlib.import_module(module_name)
        found = getattr(module, function)
    except (ImportError, OSError, AttributeError) as error:
        raise pytest.UsageError(f"--simulator {where}: {type(error).__name__}: {error}") from None
    if not callable(found):
        raise pytest.UsageError(f"--simulator {where}: not a function but {type(found).__name__}")
    return found  # type: ignore[no-any-return]


class DoesNotHold(Exception):
    """A property of the simulator that fails."""


class _Suite(pytest.Collector):
    """One problem, whose runs are made by the first of its tests."""

    ask: "tuple[Callable[..., Any], KnownProblem, Settings]"
    _found: "tuple[dict[str, Finding], dict[str, str]] | None" = None

    def collect(self) -> list[pytest.Item]:
        return []

    @property
    def found(self) -> "tuple[dict[str, Finding], dict[str, str]]":
        """Return the findings by property, and the reasons why others were not measured."""
        if self._found is None:
            from twoloop.testing.conformance import check_problem

            findings, skipped = check_problem(*self.ask)
            self._found = {each.property: each for each in findings}, {name: why for _, name, why in skipped}
        return self._found


class _Property(pytest.Item):
    """One property of the simulator on a problem."""

    def runtest(self) -> None:
        findings, skipped = self.parent.found  # type: ignore[union-attr]
        finding = findings.get(self.name)
        if finding is None:
            pytest.skip(skipped.get(self.name) or next(iter(skipped.values()), "not measured: not returned, or exact"))
        told = {"measured": finding.measured, "allowed": finding.allowed, "hint": finding.hint}
        self.user_properties += [("problem", finding.problem), ("property", finding.property), *told.items()]
        if not finding.passed:
            from twoloop.testing.findings import shown

            raise DoesNotHold(f"{shown(finding.measured)}, allowed {shown(finding.allowed)}\n{finding.hint}".rstrip())

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        if isinstance(excinfo.value, DoesNotHold):
            return f"{self.parent.name}: {self.name}: {excinfo.value}"  # type: ignore[union-attr]
        return super().repr_failure(excinfo, style)

    def reportinfo(self) -> tuple[Path, int | None, str]:
        return self.path, None, self.nodeid


class _Findings:
    """Collects the findings of a session for the report."""

    def __init__(self, path: Path):
        self._path, self._rows = path, list[tuple[dict[str, Any], bool]]()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        told = dict(report.user_properties)
        if report.when == "call" and report.nodeid.startswith("simulator::") and "measured" in told:
            self._rows.append((told, report.outcome == "passed"))

    def pytest_sessionfinish(self) -> None:
        from twoloop.testing.findings import Finding, Report

        findings = tuple(Finding(**told, passed=passed) for told, passed in self._rows)
        self._path.write_text(Report(findings).to_markdown(), encoding="utf-8")
