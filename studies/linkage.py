"""Pictures of the four-bar linkage in its motion: both geometries over half a period."""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np

from references.paper.four_bar_minimal import MinimalFourBar
from studies.bench import figures, study
from studies.bench.cases.four_bar import SECOND
from studies.bench.store import Output
from twoloop import solve_dae
from twoloop.mechanisms import Problem, four_bar

INSTANTS = 9


def draw(axes: plt.Axes, problem: Problem) -> None:
    """Draw the bars at equal intervals over half a period, from the start (dark) to the other position of rest."""
    half = 0.5 * MinimalFourBar.from_parameters(problem.parameters).period
    times = np.linspace(0.0, half, INSTANTS)
    result = solve_dae(problem.system, (0.0, half), problem.q0, problem.v0, t_eval=times)
    fine = solve_dae(problem.system, (0.0, half), problem.q0, problem.v0, t_eval=np.linspace(0.0, half, 200))
    axes.plot(fine.q[6], fine.q[7], color=figures.RED, lw=1.2, label="centre of bar 3")
    for k in range(INSTANTS):
        x, y = problem.drawing.at(result.q[:, k]).T  # type: ignore[union-attr]
        shade = plt.cm.viridis(0.9 * k / (INSTANTS - 1))
        axes.plot(x, y, "-o", color=shade, lw=2.4 if k == 0 else 1.3, ms=3.5)
        if k == 0:
            for i in range(3):
                middle = (0.5 * (x[i] + x[i + 1]), 0.5 * (y[i] + y[i + 1]))
                box = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}  # other positions pass behind it
                axes.annotate(f"bar {i + 1}", middle, (4, 5), textcoords="offset points", fontsize=8, bbox=box)
    axes.plot([0.0, problem.parameters["L"]], [0.0, 0.0], "^", color="black", ms=9, zorder=5)
    axes.annotate("O", (0.0, 0.0), (-12, 6), textcoords="offset points")
    axes.annotate("A", (problem.parameters["L"], 0.0), (6, 6), textcoords="offset points")
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", title=f"{problem.name}: half a period, {half:.3f} s")
    axes.legend(loc="lower left", fontsize=8)


def _work(output: Output) -> None:
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
    for one, problem in zip(axes, (four_bar(), four_bar(**SECOND)), strict=True):  # type: ignore[arg-type]
        draw(one, problem)
    figure.suptitle("Released from rest (dark, thick); equal intervals of time, later is lighter", fontsize=9)
    figures.save(figure, output, "linkage")


def main(words: Sequence[str] | None = None) -> None:
    """Draw `linkage.png` and `linkage.svg`."""
    study.run("linkage", __doc__, words, _work)


if __name__ == "__main__":
    main()
