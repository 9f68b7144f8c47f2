"""The gallery of the ready mechanisms, from what they say of themselves: its text, pictures and animations."""

import inspect
import warnings
from collections.abc import Iterator
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from shapes import seen

from twoloop import ConstraintWarning, Result, mechanisms, solve_dae
from twoloop.mechanisms import Problem

LONGEST = 10.0  # s of a motion that is shown
SHOWN = 2.0  # s of a motion in a picture, in which more positions could not be told apart ...
POSITIONS = 9  # ... which shows so many ...
SOLID = 40, 3  # ... or, of bodies in space of so many lines, so few

BEGINNING = """# Gallery of mechanisms

Each of these functions of `twoloop.mechanisms` returns a [`Problem`](../reference.md#systems): a system with
compiled callbacks, a consistent start, a time span, the energy and, where one is known, a reference for the end.

```python
from twoloop import solve_dae
from twoloop.mechanisms import four_bar

problem = four_bar()
result = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0)
```

In the pictures, dark lines are the start and pale ones the motion that follows. The documentation that `make docs`
builds has animations.

<!-- Written by `python docs/generate.py`: do not edit it. -->
"""


def problems() -> Iterator[tuple[str, str, Problem]]:
    """Yield the name of each ready mechanism, the first line of its docstring, and the problem."""
    for name in mechanisms.__all__:
        maker = getattr(mechanisms, name)
        if inspect.isfunction(maker) and all(
            parameter.default is not parameter.empty for parameter in inspect.signature(maker).parameters.values()
        ):  # ancf_beam asks for numbers
            yield name, (inspect.getdoc(maker) or "").splitlines()[0], maker()


def text() -> str:
    """Return the page."""
    return "\n".join([BEGINNING, *(entry(*mechanism) for mechanism in problems())])


def entry(name: str, summary: str, problem: Problem) -> str:
    """Return the section of one mechanism."""
    system = problem.system
    size = f"{system.n_q} coordinates, {system.n_c} constraints"
    size += f", {system.n_a} non-holonomic rows" if system.n_a else ""
    facts = {
        "Tests": problem.purpose,
        "Kind": f"{', '.join(problem.tags)}; {size}; usually run to {problem.t_span[1]:g} s" if problem.tags else size,
        "Posed by": problem.source,
        "Reference": problem.reference and f"{problem.reference.source}; {problem.reference.verified}".rstrip("; "),
        "Note": problem.note,
        "Joints": ", ".join(f"`{joint.name}`" for joint in problem.joints),
    }
    lines = [f"## {name}\n", f"{summary}\n", f"![{name} in motion]({name}.png)\n"]
    lines += [f"- *{what}*: {text}" for what, text in facts.items() if text]
    return "\n".join(lines) + "\n"


def draw(folder: Path) -> None:
    """Draw each mechanism in several positions of its motion."""
    for name, _, problem in problems():
        picture(problem, motion(problem), folder / f"{name}.png")


def animate(folder: Path) -> None:
    """Write an animation of each mechanism."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, _, problem in problems():
        motion(problem).animate(folder / f"{name}.html")


def motion(problem: Problem) -> Result:
    """Return the run that is shown; the text says where rows are redundant."""
    end = min(problem.t_span[1], LONGEST)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConstraintWarning)
        result = solve_dae(problem.system, (0.0, end), problem.q0, problem.v0, rtol=1e-6, atol=1e-6, dense_output=True)
    if not result.success:
        raise RuntimeError(f"{problem.name}: {result.message}")
    return result


def picture(problem: Problem, result: Result, path: Path) -> None:
    """Draw the start dark and later positions paler, with the paths of marked points."""
    drawing = problem.drawing
    if drawing is None:
        raise ValueError(f"{problem.name} has no drawing")
    end = min(float(result.t[-1]), SHOWN)
    figure, axes = plt.subplots(figsize=(4.2, 3.0), layout="constrained")
    solid = len(drawing.bars) > SOLID[0] and drawing.at(problem.q0).shape[1] == 3
    count = SOLID[1] if solid else POSITIONS
    points = drawing.at(result.sol(np.linspace(0.0, end, count)).q)
    for number in reversed(range(count)):
        flat = seen(points[..., number])[0]
        alpha = 1.0 if number == 0 else 0.45 - 0.35 * number / count
        for first, second in drawing.bars:
            line = flat[[first, second]].T
            axes.plot(*line, "-", color="#4c3a8c", lw=1.8, alpha=alpha, solid_capstyle="round", zorder=3 - number / 10)
    paths = drawing.at(result.sol(np.linspace(0.0, end, 300)).q)
    for trace in drawing.traces:
        axes.plot(*seen(paths[trace].T)[0].T, "-", color="#c8641e", lw=0.9, alpha=0.8, zorder=1)
    axes.set_aspect("equal")
    axes.margins(0.05)
    axes.axis("off")
    figure.savefig(path, dpi=100, metadata={"Software": None})
    plt.close(figure)
