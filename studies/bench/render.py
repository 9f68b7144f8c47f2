"""Reports from templates: Jinja2 that fails on what is not defined, and one style of numbers."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2

from studies.bench import names

TEMPLATES = Path(__file__).parents[1] / "templates"


def number(value: Any, digits: int = 2) -> str:
    """Return a number as text with `digits` significant digits, "–" if it is missing: 0.012, 3.4, 120, 2.4e-5, 1e-9."""
    if value is None or value != value:
        return "–"
    if isinstance(value, bool) or not isinstance(value, int | float):
        value = float(value)  # a numpy scalar; anything else raises
    if value == 0:
        return "0"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    if isinstance(value, int) and abs(value) < 10_000:
        return f"{value}".replace("-", "−")
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    place = int(exponent)
    if -2 <= place <= 3:
        text = f"{float(f'{mantissa}e{place}'):.{max(digits - 1 - place, 0)}f}"
    else:
        mantissa = mantissa.rstrip("0").rstrip(".") if "." in mantissa else mantissa
        text = f"{mantissa}e{place}"
    return f"−{text[1:]}" if text[0] == "-" else text


def power(value: float) -> str:
    """A tolerance or an error level: one digit and a power of ten, 1e-2."""
    mantissa, exponent = f"{value:.0e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def brief(stamp: str) -> str:
    """Command, date, commit and machine of a stamp; the first line of the CSV has the versions, too."""
    parts = [""]
    for part in stamp.split("; "):  # those in parentheses belong together
        if parts[-1].count("(") > parts[-1].count(")"):
            parts[-1] += f"; {part}"
        else:
            parts.append(part)
    return "; ".join(parts[1:5])


def percent(share: float) -> str:
    """A share as a percentage of two significant digits."""
    return f"{number(100.0 * share)} %"


def listed(words: Iterable[str]) -> str:
    """ "a", "a and b", "a, b and c"."""
    texts = list(words)
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} and {texts[-1]}" if texts else "none"


def table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A markdown table; texts are printed as they are, numbers by `number`; the first column to the left."""
    lines = ["| " + " | ".join(header) + " |", "|---" + "|--:" * (len(header) - 1) + "|"]
    for row in rows:
        cells = [cell if isinstance(cell, str) else number(cell) for cell in row]
        if len(cells) != len(header):
            raise ValueError(f"a row of {len(cells)} cells under {len(header)} headings: {cells}")
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines)


def environment() -> jinja2.Environment:
    """The environment of all templates: `table(header, rows)`, and filters for numbers, lists, code and stamps."""
    how: dict[str, Any] = dict.fromkeys(("trim_blocks", "lstrip_blocks", "keep_trailing_newline"), True)
    how |= {"undefined": jinja2.StrictUndefined, "autoescape": False}  # markdown, from our own data
    made = jinja2.Environment(loader=jinja2.FileSystemLoader(TEMPLATES), **how)
    made.filters |= {"code": names.call, "label": names.label, "project": names.project, "brief": brief}
    made.filters |= {"num": number, "power": power, "pct": percent, "listed": listed}
    made.globals |= {"table": table}
    return made


def render(name: str, findings: Mapping[str, Any], tables: Mapping[str, str], **more: Any) -> str:
    """Return the text of templates/NAME.md.j2; raise jinja2.UndefinedError if it uses an undefined name.

    `findings`: `f` in the template, the numbers and booleans of NAME.json. `tables`: ready markdown. `**more`: further
    names, such as the stamp.
    """
    text = environment().get_template(f"{name}.md.j2").render(f=findings, tables=tables, **more)
    text = re.sub(r"\n{3,}", "\n\n", text)  # left by conditions that did not hold
    text = re.sub(r"(?m)^\|.*\|$", lambda line: re.sub(r" *(?<!\\)\| *", "|", line[0]), text)  # rows of tables
    return text.strip("\n") + "\n"
