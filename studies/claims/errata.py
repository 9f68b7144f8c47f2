"""Misprints and slips of the paper, and equations that were checked and are right: the texts are in errata.toml."""

import tomllib
from pathlib import Path

from studies.render import table


def entries() -> dict[str, list[dict[str, str]]]:
    """The texts, in two lists: errata and confirmed."""
    return tomllib.loads(Path(__file__).with_name("errata.toml").read_text())


def tables() -> dict[str, str]:
    """Both lists as tables, each line with the test that checks it."""
    errata = [[entry[key] for key in ("place", "printed", "should", "test")] for entry in entries()["errata"]]
    confirmed = [[entry[key] for key in ("place", "what", "test")] for entry in entries()["confirmed"]]
    return {
        "errata": table(["where", "printed", "should be", "checked by"], errata),
        "confirmed": table(["where", "what", "checked by"], confirmed),
    }
