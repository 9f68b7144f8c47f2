"""Findings of a check, and their report."""

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """Outcome for one property of a simulator on a problem.

    Attributes
    ----------
    problem, property : str
    measured : float or str
        A number, or a description.
    allowed : float or str
        Largest number that passes (for an order, the smallest), or the required outcome.
    passed : bool
    hint : str
        Likely cause; empty if passed.

    Examples
    --------
    >>> import numpy as np
    >>> from twoloop.testing import check_simulator
    >>> def simulate(problem, times, tolerance):
    ...     rows = np.tile(problem.q0, (len(times), 1))  # a simulator that does not move
    ...     return rows
    >>> report = check_simulator(simulate, "pendulum", tolerances=(1e-4, 1e-6))
    >>> finding = report.findings[0]
    >>> finding.problem, isinstance(finding.passed, bool)
    ('pendulum', True)
    """

    problem: str
    property: str
    measured: float | str
    allowed: float | str
    passed: bool
    hint: str = ""


@dataclass(frozen=True)
class Failure:
    """A failed property: problem, property, measured and allowed value, and a hint.

    Examples
    --------
    >>> import numpy as np
    >>> from twoloop.testing import check_simulator
    >>> def simulate(problem, times, tolerance):
    ...     rows = np.tile(problem.q0, (len(times), 1))  # a simulator that does not move
    ...     return rows
    >>> report = check_simulator(simulate, "pendulum", tolerances=(1e-4, 1e-6))
    >>> report.failures[0].problem
    'pendulum'
    """

    problem: str
    property: str
    measured: float | str
    allowed: float | str
    hint: str

    def __str__(self) -> str:
        return f"{self.problem}: {self.property}: {outcome_text(self)}. {self.hint}".rstrip()


@dataclass(frozen=True)
class Report:
    """Outcome of `check_simulator`.

    Attributes
    ----------
    findings : tuple of Finding
        All properties of all problems, passed or failed.
    skipped : tuple of (str, str, str)
        Problem, property and the reason why it was not measured.

    Examples
    --------
    >>> import numpy as np
    >>> from twoloop.testing import check_simulator
    >>> def simulate(problem, times, tolerance):
    ...     rows = np.tile(problem.q0, (len(times), 1))  # a simulator that does not move
    ...     return rows
    >>> report = check_simulator(simulate, "pendulum", tolerances=(1e-4, 1e-6))
    >>> report.passed, len(report.failures) > 0
    (False, True)
    """

    findings: tuple[Finding, ...]
    skipped: tuple[tuple[str, str, str], ...] = ()

    @property
    def passed(self) -> bool:
        """True if all measured properties passed."""
        return not self.failures

    @property
    def failures(self) -> tuple[Failure, ...]:
        """The failed properties, in the order of the problems."""
        return tuple(
            Failure(finding.problem, finding.property, finding.measured, finding.allowed, finding.hint)
            for finding in self.findings
            if not finding.passed
        )

    def __str__(self) -> str:
        names = _unique(finding.problem for finding in self.findings)
        lines = [f"{len(self.findings)} properties on {len(names)} problems: {_verdict(len(self.failures))}"]
        for name in names:
            findings = [finding for finding in self.findings if finding.problem == name]
            failed = [finding for finding in findings if not finding.passed]
            lines.append(f"  {name}: {'passed' if not failed else f'{len(failed)} of {len(findings)} failed'}")
            lines += [f"    {finding.property}: {outcome_text(finding)}" for finding in failed]
            lines += [f"    -> {hint}" for hint in _unique(finding.hint for finding in failed if finding.hint)]
        return "\n".join(lines)

    def to_markdown(self) -> str:
        """Return the report as Markdown tables: failures with hints, then all measured properties."""
        lines = [f"# Simulator check: {_verdict(len(self.failures))}", ""]
        if self.failures:
            lines += ["| problem | property | measured | allowed | hint |", "|---|---|--:|--:|---|"]
            lines += [*(_table_row(failure, failure.hint) for failure in self.failures), ""]
        lines += ["| problem | property | measured | allowed | |", "|---|---|--:|--:|---|"]
        for finding in self.findings:
            verdict = "passed" if finding.passed else "**failed**"
            lines.append(_table_row(finding, verdict))
        for problem, name, reason in self.skipped:
            lines.append(_table_row(Failure(problem, name, "not measured", "", ""), reason))
        return "\n".join(lines) + "\n"


def _table_row(row: Finding | Failure, last: str) -> str:
    cells = (row.problem, row.property, _format_value(row.measured), _format_value(row.allowed), last)
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"


def outcome_text(row: Finding | Failure) -> str:
    """Return the measured and the allowed value as text."""
    return f"{_format_value(row.measured)}, allowed {_format_value(row.allowed)}"


def _verdict(n_failures: int) -> str:
    return "all hold" if n_failures == 0 else f"{n_failures} do{'es' * (n_failures == 1)} not hold"


def _unique(names: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(names))


def _format_value(value: float | str) -> str:
    """Return a number with three digits, or a text unchanged."""
    return value if isinstance(value, str) else f"{value:.3g}"
