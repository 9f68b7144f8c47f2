"""What a check found: rows, and the report of them."""

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """A property of a simulator on a problem.

    Attributes
    ----------
    problem, property : str
    measured : float or str
        A number, or what happened instead.
    allowed : float or str
        The largest number that passes (of an order, the smallest), or what had to happen.
    passed : bool
    hint : str
        What the pattern of errors points to; empty where it passed.
    """

    problem: str
    property: str
    measured: float | str
    allowed: float | str
    passed: bool
    hint: str = ""


@dataclass(frozen=True)
class Failure:
    """A property that does not hold: problem, property, what was measured and what is allowed, and a hint."""

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
    """What `check_simulator` found.

    Attributes
    ----------
    findings : tuple of Finding
        Every property of every problem, also those that hold.
    skipped : tuple of (str, str, str)
        Problem, property and why it was not measured.
    """

    findings: tuple[Finding, ...]
    skipped: tuple[tuple[str, str, str], ...] = ()

    @property
    def passed(self) -> bool:
        """Whether every property that was measured holds."""
        return not self.failures

    @property
    def failures(self) -> tuple[Failure, ...]:
        """Those that do not, in the order of the problems."""
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
        """The report as tables in Markdown: failures with hints, then everything that was measured."""
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
    """A number with three digits, or words as they are."""
    return value if isinstance(value, str) else f"{value:.3g}"
