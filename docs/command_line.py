"""The page of the command line, from the parser of `python -m twoloop`."""

import argparse
from collections.abc import Iterator

from twoloop.__main__ import parser

BEGINNING = """# Command line

`python -m twoloop COMMAND --help` prints the same. After a wrong argument, a command prints one
line and ends with a status other than zero.

<!-- Written by `python docs/generate.py`: do not edit it. -->
"""
ENDING = """## Compare solvers and make reports

In a clone, or where the extra `bench` is installed:

| Command | What it does |
|---|---|
| `python -m studies.compare FILE.py:FUNCTION` | compares solvers on your mechanism: [all options](../compare.md) |
| `python -m studies` | lists the studies |
| `python -m studies NAME --quick` | runs a small version of a study into `reports/quick` |
| `python -m studies NAME --redraw` | writes report and figures again from the saved rows |
| `make help` | lists the commands for developers |
"""


def text() -> str:
    """Return the page."""
    parts = [BEGINNING]
    for name, about, command in commands(parser()):
        parts.append(f"## python -m twoloop {name}\n\n{sentence(about)}\n")
        options = [action for action in command._actions if action.dest != "help"]
        if options:
            rows = [f"| `{spelling(action)}` | {action.help or ''} |" for action in options]
            parts.append("\n".join(["| Argument | Meaning |", "|---|---|", *rows, ""]))
    return "\n".join([*parts, ENDING])


def commands(of: argparse.ArgumentParser, prefix: str = "") -> Iterator[tuple[str, str, argparse.ArgumentParser]]:
    """Yield name, help and parser of each command that has no commands of its own."""
    for action in of._actions:
        if isinstance(action, argparse._SubParsersAction):
            about = {choice.dest: choice.help or "" for choice in action._choices_actions}
            for name, command in action.choices.items():
                inner = list(commands(command, f"{prefix}{name} "))
                yield from inner or [(f"{prefix}{name}", about[name], command)]


def spelling(action: argparse.Action) -> str:
    """Return how an argument is written."""
    value = action.metavar or action.dest.upper()
    value = f"{value} ..." if action.nargs == "+" else str(value)
    if not action.option_strings:
        return value
    return action.option_strings[-1] if action.nargs == 0 else f"{action.option_strings[-1]} {value}"


def sentence(about: str) -> str:
    """Return a help text as a sentence."""
    return f"{about[0].upper()}{about[1:]}."
