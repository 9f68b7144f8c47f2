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
        measured, allowed = shown(self.measured), shown(self.allowed)
        return f"{self.problem}: {self.property}: {measured}, allowed {allowed}. {self.hint}".rstrip()


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
            Failure(each.problem, each.property, each.measured, each.allowed, each.hint)
            for each in self.findings
            if not each.passed
        )

    def __str__(self) -> str:
        names = _in_order(each.problem for each in self.findings)
        lines = [f"{len(self.findings)} properties on {len(names)} problems: {_count(len(self.failures))}"]
        for name in names:
            own = [each for each in self.findings if each.problem == name]
            failed = [each for each in own if not each.passed]
            lines.append(f"  {name}: {'passed' if not failed else f'{len(failed)} of {len(own)} failed'}")
            lines += [f"    {each.property}: {shown(each.measured)}, allowed {shown(each.allowed)}" for each in failed]
            hints = _in_order(each.hint for each in failed if each.hint)
            lines += [f"    -> {hint}" for hint in hints]
        return "\n".join(lines)

    def to_markdown(self) -> str:
        """Return the report as Markdown tables: failures with hints, then all measured properties."""
        lines = [f"# Simulator check: {_count(len(self.failures))}", ""]
        if self.failures:
            lines += ["| problem | property | measured | allowed | hint |", "|---|---|--:|--:|---|"]
            lines += [
                _line(each.problem, each.property, each.measured, each.allowed, each.hint) for each in self.failures
            ]
            lines.append("")
        lines += ["| problem | property | measured | allowed | |", "|---|---|--:|--:|---|"]
        for each in self.findings:
            verdict = "passed" if each.passed else "**failed**"
            lines.append(_line(each.problem, each.property, each.measured, each.allowed, verdict))
        lines += [_line(*each[:2], "not measured", "", each[2]) for each in self.skipped]
        return "\n".join(lines) + "\n"


def _line(problem: str, name: str, measured: float | str, allowed: float | str, last: str) -> str:
    cells = (problem, name, shown(measured), shown(allowed), last)
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"


def _count(n_failures: int) -> str:
    return "all hold" if n_failures == 0 else f"{n_failures} do{'es' * (n_failures == 1)} not hold"


def _in_order(names: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(names))


def shown(value: float | str) -> str:
    """Return a number with three digits, or a text unchanged."""
    return value if isinstance(value, str) else f"{value:.3g}"
