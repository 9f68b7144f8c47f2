"""Write docs/errors.md from the cases of `tests/bad_input`, each of which is run: python -m tests.errors_page."""

import re
from functools import cache
from pathlib import Path

from tests.bad_input.case import Case
from tests.bad_input.cases import CASES
from twoloop import Status

PAGE = Path(__file__).parents[1] / "docs" / "errors.md"
LONGEST = 400  # characters of a message
BEGINNING = """# Error messages

This list is for searching. [When it fails](when_it_fails.md) explains what can go wrong, and what to do.

Wrong input raises an exception before any work. The message names the argument, what was given and what is expected.
Each table below belongs to one function or class.

<!-- Written by `python -m tests.errors_page` from `tests/bad_input`, which raises every message: do not edit it. -->
"""
# what stands above the table of a group
MEANT = {
    "result.certify": """\
If a certificate passes, a different method has recomputed the run, and no state is more than 100 tolerances from the
recomputed one. If it does not pass, a `CertificateWarning` says where. [The certificate](certificate.md) explains
what it proves and what it can miss.
"""
}


@cache
def error_of(case: Case) -> Exception | None:
    """Return what a mistake raises; the tests of all cases and the page share it."""
    try:
        case.call()
    except Exception as error:
        return error
    return None


def message(case: Case) -> str:
    """Return the type of the error and its message, without what differs between machines."""
    error = error_of(case)
    text = re.sub(r"\s+", " ", str(error))
    text = re.sub(r" at 0x[0-9a-f]+", "", text)
    text = re.sub(r"'\S*/(run\.npz)'", r"'\1'", text)
    text = re.sub(r", in `[^`]*` \([^()]*, line \d+\)", "", text)
    text = re.sub(r"error of about \S+", "error of about ...", text)
    return f"`{type(error).__name__}`: {text if len(text) <= LONGEST else f'{text[:LONGEST]} ...'}"


def cell(text: str) -> str:
    """Escape text for a table of Markdown; in backticks only the bar needs it."""
    parts = text.replace("|", "\\|").split("`")
    parts[::2] = [part.replace("<", "&lt;").replace("*", "\\*") for part in parts[::2]]
    return "`".join(parts)


MEANINGS: dict[Status, str] = {
    Status.REACHED_END: "the end of t_span was reached",
    Status.EVENT: "an event ended the run",
    Status.STEP_TOO_SMALL: "the step size fell below the spacing of floating-point numbers",
    Status.MAX_STEPS: "max_steps accepted steps were taken",
    Status.NOT_CONVERGED: "a step of fixed size did not converge, or gamma by differences misses the tolerance",
    Status.NOT_FINITE: "a callback returned a value that is not finite, or the state overflowed",
    Status.RANK_LOST: "the constraint Jacobian lost rank: no choice of independent coordinates exists",
    Status.SOLVER_FAILED: "a solver of another project failed, or reached the time limit of its adapter",
    Status.INTERRUPTED: "the run was interrupted from the keyboard",
    Status.STAGNATED: "the steps became so short that the end is out of reach",
    Status.WRONG_DERIVATIVE: "a derivative that the system gives is wrong, or M not symmetric, at a state of the run",
    Status.TIME_LIMIT: "the run reached its time_limit",
    Status.ROWS_CONTRADICT: "a constraint that depended on others at the start is violated",
    Status.RATE_JUMPS: "constraint_rate or nonholonomic_rate jumps, and no impulse gives velocities that are allowed",
    Status.WRONG_TRACE: "a callback gives other values than the operations that were recorded of it, or than before",
}


def statuses() -> list[str]:
    rows = ["| `result.status` | What it means |", "|---|---|"]
    for status in Status:
        name = f"`{status.name}` = {int(status)}"
        if status < 0:
            name = f"[{name}](when_it_fails.md#{status.name.lower()})"
        rows.append(f"| {name} | {cell(MEANINGS[status])} |")
    return rows


def groups() -> dict[str, list[Case]]:
    """Return the cases by their groups, in the order in which these first appear."""
    found: dict[str, list[Case]] = {}
    for case in CASES:
        found.setdefault(case.group, []).append(case)
    return found


def page() -> str:
    parts = [BEGINNING, "## How a run ends\n", *statuses(), ""]
    for group, cases in groups().items():
        parts += [f"## {group}\n", *([MEANT[group]] if group in MEANT else [])]
        parts += ["| What you did | What you get | What to do |", "|---|---|---|"]
        parts += [f"| {cell(case.what)} | {cell(message(case))} | {cell(case.advice)} |" for case in cases]
        parts.append("")
    return "\n".join(parts)


if __name__ == "__main__":
    PAGE.parent.mkdir(exist_ok=True)
    PAGE.write_text(page(), encoding="utf-8")
