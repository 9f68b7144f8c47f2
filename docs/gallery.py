"""The gallery of the ready mechanisms, from what they say of themselves."""

import inspect
from collections.abc import Iterator
from pathlib import Path

from twoloop import mechanisms
from twoloop.mechanisms import Problem

BEGINNING = """# Ready mechanisms

`from twoloop.mechanisms import four_bar`, and so on: each is a function that returns a
[`Problem`](../reference.md#ready-mechanisms) with compiled callbacks, a consistent start, a usual time span, the energy
and a reference, of which it is known how many digits hold. This page is written from the mechanisms whenever the
documentation is built.
"""


def write(folder: Path) -> None:
    """Write gallery.md into the folder."""
    parts = [BEGINNING]
    parts += [entry(*each) for each in problems()]
    (folder / "gallery.md").write_text("\n".join(parts), encoding="utf-8")


def problems() -> Iterator[tuple[str, str, Problem]]:
    """Of each ready mechanism its name, the first line of its docstring, and the problem."""
    for name in mechanisms.__all__:
        maker = getattr(mechanisms, name)
        if inspect.isfunction(maker) and all(
            each.default is not each.empty for each in inspect.signature(maker).parameters.values()
        ):  # a beam of one's own asks for numbers
            yield name, (inspect.getdoc(maker) or "").splitlines()[0], maker()


def entry(name: str, summary: str, problem: Problem) -> str:
    """The section of one mechanism."""
    system = problem.system
    rows = f"{system.n_q} coordinates, {system.n_c} constraints"
    rows += f", {system.n_a} non-holonomic rows" if system.n_a else ""
    facts = {
        "Tests": problem.purpose,
        "Kind": f"{', '.join(problem.tags)}; {rows}; usually run to {problem.t_span[1]:g} s" if problem.tags else rows,
        "Posed by": problem.source,
        "Reference": problem.reference and f"{problem.reference.source}; {problem.reference.verified}".rstrip("; "),
        "Note": problem.note,
        "Joints": ", ".join(f"`{joint.name}`" for joint in problem.joints),
    }
    lines = [f"## {name}\n", f"{summary}\n"]
    lines += [f"- *{what}*: {text}" for what, text in facts.items() if text]
    return "\n".join(lines) + "\n"
