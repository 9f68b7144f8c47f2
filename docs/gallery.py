"""The gallery of the ready mechanisms, from what they say of themselves, each in its motion where it can be drawn."""

import inspect
import warnings
from collections.abc import Iterator
from pathlib import Path

from twoloop import ConstraintWarning, Result, mechanisms, solve_dae
from twoloop.mechanisms import Problem

LONGEST = 10.0  # s of a motion that is shown

BEGINNING = """# Ready mechanisms

`from twoloop.mechanisms import four_bar`, and so on: each is a function that returns a
[`Problem`](../reference.md#ready-mechanisms) with compiled callbacks, a consistent start, a usual time span, the energy
and a reference, of which it is known how many digits hold. This page is written from the mechanisms whenever the
documentation is built.
"""


def write(page: Path, animations: Path) -> None:
    """Write the page, and an animation of each mechanism into the folder that the page finds as ../animations."""
    animations.mkdir(parents=True, exist_ok=True)
    parts = [BEGINNING]
    for name, summary, problem in problems():
        parts.append(entry(name, summary, problem))
        if hasattr(Result, "animate"):
            motion(problem).animate(animations / f"{name}.html")
            frame = f'<iframe src="../animations/{name}.html" title="{name} in its motion" width="100%" height="560"'
            parts.append(f'```{{raw}} html\n{frame} loading="lazy" style="border: 0"></iframe>\n```\n')
    page.write_text("\n".join(parts), encoding="utf-8")


def problems() -> Iterator[tuple[str, str, Problem]]:
    """Of each ready mechanism its name, the first line of its docstring, and the problem."""
    for name in mechanisms.__all__:
        maker = getattr(mechanisms, name)
        if inspect.isfunction(maker) and all(
            each.default is not each.empty for each in inspect.signature(maker).parameters.values()
        ):  # a beam of one's own asks for numbers
            yield name, (inspect.getdoc(maker) or "").splitlines()[0], maker()


def motion(problem: Problem) -> Result:
    """The run that is shown; that rows are redundant is said in the text."""
    end = min(problem.t_span[1], LONGEST)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConstraintWarning)
        result = solve_dae(problem.system, (0.0, end), problem.q0, problem.v0, rtol=1e-6, atol=1e-6, dense_output=True)
    if not result.success:
        raise RuntimeError(f"{problem.name}: {result.message}")
    return result


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
