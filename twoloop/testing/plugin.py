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
    from twoloop.testing.problem import KnownProblem, Motion
    from twoloop.testing.properties import Finding, Settings


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the command-line options, and the list of known failures in pyproject.toml."""
    group = parser.getgroup("twoloop", "check of a simulator of mechanisms")
    group.addoption(
        "--simulator", metavar="MODULE:FUNCTION", help="simulate(problem, times, tolerance or step) to check"
    )
    group.addoption("--simulator-problems", metavar="NAMES", default="smoke", help="smoke, all, or names with commas")
    group.addoption("--simulator-steps", metavar="N,N,...", help="for fixed steps: numbers of steps over the span")
    group.addoption("--simulator-order", type=float, metavar="P", help="for fixed steps: the order of the method")
    limit_help = "seconds of a run, 0 for no limit (to debug)"
    group.addoption("--simulator-time-limit", type=float, default=120.0, metavar="S", help=limit_help)
    group.addoption("--simulator-report", metavar="FILE", help="write all measurements as Markdown")
    failures_help = "known failures of --simulator, one per line: PROBLEM: PROPERTY"
    parser.addini("simulator_known_failures", failures_help, type="linelist", default=[])


@pytest.fixture
def reference_motion() -> "Callable[[str], Motion]":
    """reference_motion("four_bar") -> the known motion: t, q, v, lam, digits, growth (twoloop.testing.Motion)."""

    def motion(name: str) -> "Motion":
        from twoloop.testing.mechanisms import MAKERS

        makers = {problem_name: maker for problem_name, maker in MAKERS.items() if maker().reference is not None}
        if name not in makers:
            raise ValueError(f"reference_motion takes a name of {', '.join(makers)}; given {name!r}")
        reference = makers[name]().reference
        assert reference is not None
        return reference

    return motion


def pytest_configure(config: pytest.Config) -> None:
    """If a report is requested, collect the measurements of all processes."""
    path = config.getoption("simulator_report")
    if path is not None and not hasattr(config, "workerinput"):
        config.pluginmanager.register(_ReportWriter(Path(path)), "twoloop_simulator_report")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(session: pytest.Session, config: pytest.Config, items: list[pytest.Item]) -> None:
    """Add the tests before -k selects among them."""
    if config.getoption("simulator") is None:
        return
    from twoloop.testing.conformance import check_settings, property_names
    from twoloop.testing.mechanisms import select_problems

    simulate = _load_simulator(config.getoption("simulator"), config.invocation_params.dir)
    names, steps = config.getoption("simulator_problems"), config.getoption("simulator_steps")
    try:
        settings = check_settings(
            (1e-4, 1e-6, 1e-8),
            None if steps is None else [int(part) for part in steps.split(",")],
            config.getoption("simulator_order"),
            config.getoption("simulator_time_limit") or None,
        )
        problems = select_problems(names if names in ("smoke", "all") else names.split(","))
    except ValueError as error:
        raise pytest.UsageError(f"--simulator: {error}") from None
    lines = config.getini("simulator_known_failures")
    known_failures = {tuple(part.strip() for part in line.split(":", 1)) for line in lines}
    for problem in problems:
        suite = _Suite.from_parent(session, name=problem.name, nodeid=f"simulator::{problem.name}")
        suite.arguments = (simulate, problem, settings)
        for name in property_names(problem, settings):
            item = _Property.from_parent(suite, name=name)
            if (problem.name, name) in known_failures:
                item.add_marker(pytest.mark.xfail(reason="a known failure", strict=True))
            items.append(item)


def _load_simulator(location: str, folder: Path) -> Callable[..., Any]:
    """Return the function named by "module:function" or "file.py:function"."""
    module_name, _, function_name = location.rpartition(":")
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
        function = getattr(module, function_name)
    except (ImportError, OSError, AttributeError) as error:
        raise pytest.UsageError(f"--simulator {location}: {type(error).__name__}: {error}") from None
    if not callable(function):
        raise pytest.UsageError(f"--simulator {location}: not a function but {type(function).__name__}")
    return function  # type: ignore[no-any-return]


class PropertyFailed(Exception):
    """A property of the simulator that fails."""


class _Suite(pytest.Collector):
    """One problem; the first of its tests runs the simulator on it."""

    arguments: "tuple[Callable[..., Any], KnownProblem, Settings]"
    _results: "tuple[dict[str, Finding], dict[str, str]] | None" = None

    def collect(self) -> list[pytest.Item]:
        return []

    @property
    def results(self) -> "tuple[dict[str, Finding], dict[str, str]]":
        """Return the findings by property, and the reasons why other properties were not measured."""
        if self._results is None:
            from twoloop.testing.conformance import check_problem

            findings, skipped = check_problem(*self.arguments)
            self._results = {finding.property: finding for finding in findings}, {name: why for _, name, why in skipped}
        return self._results


class _Property(pytest.Item):
    """One property of the simulator on a problem."""

    def runtest(self) -> None:
        findings, skipped = self.parent.results  # type: ignore[union-attr]
        finding = findings.get(self.name)
        if finding is None:
            pytest.skip(skipped.get(self.name) or next(iter(skipped.values()), "not measured: not returned, or exact"))
        names = "problem", "property", "measured", "allowed", "hint"
        self.user_properties += [(name, getattr(finding, name)) for name in names]
        if not finding.passed:
            from twoloop.testing.properties import outcome_text

            raise PropertyFailed(f"{outcome_text(finding)}\n{finding.hint}".rstrip())

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        if isinstance(excinfo.value, PropertyFailed):
            return f"{self.parent.name}: {self.name}: {excinfo.value}"  # type: ignore[union-attr]
        return super().repr_failure(excinfo, style)

    def reportinfo(self) -> tuple[Path, int | None, str]:
        return self.path, None, self.nodeid


class _ReportWriter:
    """Collect the findings of a session for the report."""

    def __init__(self, path: Path):
        self._path, self._rows = path, list[tuple[dict[str, Any], bool]]()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        properties = dict(report.user_properties)
        if report.when == "call" and report.nodeid.startswith("simulator::") and "measured" in properties:
            self._rows.append((properties, report.outcome == "passed"))

    def pytest_sessionfinish(self) -> None:
        from twoloop.testing.properties import Finding, Report

        findings = tuple(Finding(**properties, passed=passed) for properties, passed in self._rows)
        self._path.write_text(Report(findings).to_markdown(), encoding="utf-8")
