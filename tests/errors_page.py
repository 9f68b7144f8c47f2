"""Writes docs/errors.md from the cases of `tests/bad_input`, each really run: python -m tests.errors_page."""

import re
from functools import cache
from itertools import groupby
from pathlib import Path

from tests.bad_input.case import Case
from tests.bad_input.cases import CASES
from twoloop import Status
from twoloop.result import result

PAGE = Path(__file__).parents[1] / "docs" / "errors.md"
LONGEST = 400  # characters of a message
BEGINNING = """# What happens at what mistake

Wrong input raises before any work, and the message names the argument, what was given and what to do. What goes wrong
later ends the run with a status: `result.status`, `result.message`, and what was computed so far.

Every line below is a test. Written by `python -m tests.errors_page` from `tests/bad_input`, with the messages
as they were raised; do not edit it by hand.
"""
# what stands above the table of a group
MEANT = {
    "result.certify": """\
A certificate that passes means: recomputed by a different method, which evaluated the equations at places no further
apart than `certificate.gap`, no step of the run ends more than 200 tolerances from where they lead. What lasts less
than the gap may be missed, and so may what moves every step by less than that. How errors of steps grow over the run
is not bounded, and whether the model is right is not known. One that does not pass gives a `CertificateWarning` that
says where. [The certificate](certificate.md) has the details.
"""
}


@cache
def error_of(case: Case) -> Exception | None:
    """What a mistake raises; each is made once, by the tests of all cases or for the page."""
    try:
        case.call()
    except Exception as error:
        return error
    return None


def message(case: Case) -> str:
    """What a mistake gets: the type of the error and its message, without what differs between machines."""
    error = error_of(case)
    text = re.sub(r"\s+", " ", str(error))
    text = re.sub(r" at 0x[0-9a-f]+", "", text)
    text = re.sub(r"'\S*/(run\.npz)'", r"'\1'", text)
    text = re.sub(r", in `[^`]*` \([^()]*, line \d+\)", "", text)
    text = re.sub(r"error of about \S+", "error of about ...", text)
    return f"`{type(error).__name__}`: {text if len(text) <= LONGEST else f'{text[:LONGEST]} ...'}"


def cell(text: str) -> str:
    """Text that a table of Markdown shows as it is: code in backticks needs no escapes but that of the bar."""
    parts = text.replace("|", "\\|").split("`")
    parts[::2] = [part.replace("<", "&lt;").replace("*", "\\*") for part in parts[::2]]
    return "`".join(parts)


def statuses() -> list[str]:
    """The ways in which a run ends, with their meanings where result.py gives them."""
    meanings = getattr(result, "MEANINGS", {})
    rows = ["| `result.status` | What it means |", "|---|---|"]
    for status in Status:
        meaning = meanings.get(status, status.name.replace("_", " ").lower())
        rows.append(f"| `{status.name}` = {int(status)} | {cell(meaning)} |")
    return rows


def page() -> str:
    """The whole page."""
    parts = [BEGINNING, "## How a run ends\n", *statuses(), ""]
    for group, cases in groupby(CASES, key=lambda case: case.group):
        parts += [f"## {group}\n", *([MEANT[group]] if group in MEANT else [])]
        parts += ["| What you did | What you get | What to do |", "|---|---|---|"]
        parts += [f"| {cell(case.what)} | {cell(message(case))} | {cell(case.advice)} |" for case in cases]
        parts.append("")
    return "\n".join(parts)


if __name__ == "__main__":
    PAGE.parent.mkdir(exist_ok=True)
    PAGE.write_text(page(), encoding="utf-8")
