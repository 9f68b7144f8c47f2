"""Plots of a result: coordinates, energy, violation of the constraints."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from twoloop.checks.arguments import Array, check_path
from twoloop.checks.optional import needed
from twoloop.problem.description import name_and_unit
from twoloop.run.record import Record

WIDTH, HEIGHT = 8.0, 2.2  # inches; height of a panel
LEGEND_MOST = 12  # largest number of coordinates in a legend


def plot(result: Record, path: str | os.PathLike[str] | None) -> Any:
    """Return a figure of a result, see `Result.plot`."""
    file = None if path is None else check_path(path)
    if result.t.size == 0:
        raise ValueError(f"plot needs a result with output; this one has none: {result.message}")
    # without pyplot: needs no display and leaves the user's backend alone
    figure_class = needed("matplotlib.figure", "matplotlib", "plot").Figure
    units: dict[str, list[int]] = {}
    for k, coordinate in enumerate(result.coordinates):
        units.setdefault(name_and_unit(coordinate)[1], []).append(k)
    known = result.description
    n_panels = len(units) + (known.energy is not None) + (result.system is not None)
    figure = figure_class(figsize=(WIDTH, HEIGHT * n_panels + 0.5), layout="constrained")
    if file is not None and file.suffix and file.suffix[1:].lower() not in figure.canvas.get_supported_filetypes():
        raise ValueError(f"path must end in .png, .svg, .pdf or another format of matplotlib; given {str(path)!r}")
    panels = list(np.atleast_1d(figure.subplots(n_panels, 1, sharex=True)))
    rest = iter(panels)
    for unit, chosen in units.items():
        _coordinates(next(rest), result, unit, chosen)
    if known.energy is not None:
        energy, panel = result.energy, next(rest)
        panel.plot(result.t, energy - energy[0] if known.conserved else energy, color="tab:red")
        panel.set_ylabel("energy − start (J)" if known.conserved else "energy (J)")
    if result.system is not None:
        _violation(next(rest), result)
    panels[-1].set_xlabel("t (s)")
    name = "" if result.system is None else result.system.name
    figure.suptitle(name if result.success else f"{name}: {result.status.name}", fontsize="medium")
    if file is not None:
        figure.savefig(file, dpi=150)
    return figure


def _coordinates(panel: Any, result: Record, unit: str, chosen: list[int]) -> None:
    for k in chosen:
        panel.plot(result.t, result.q[k], lw=1.0, label=name_and_unit(result.coordinates[k])[0])
    panel.set_ylabel(f"q ({unit})" if unit else "q")
    if len(chosen) <= LEGEND_MOST:
        panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize="x-small")
    else:
        panel.set_title(f"{len(chosen)} coordinates", fontsize="x-small")


def _violation(panel: Any, result: Record) -> None:
    positions, velocities = violation(result)
    for values, label in ((positions, "|C|"), (velocities, "|d/dt C|, |A v + b|")):
        if (values > 0.0).any():  # a logarithmic axis cannot show zeros
            panel.semilogy(result.t, np.where(values > 0.0, values, np.nan), lw=1.0, label=label)
        else:
            panel.plot([], [], label=f"{label}: 0")
    panel.set_ylabel("largest violation")
    panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize="x-small")


def violation(result: Record) -> tuple[Array, Array]:
    """Return the largest violations of the position and of the velocity constraints, (n_t,) each."""
    system: Any = result.system
    states = list(zip(result.t.tolist(), result.q.T, result.v.T, strict=True))
    positions = [np.abs(system.constraint(t, q)).max(initial=0.0) if system.n_c else 0.0 for t, q, _ in states]
    velocities = [np.abs(system.velocity_constraint(t, q, v)).max(initial=0.0) for t, q, v in states]
    return np.array(positions), np.array(velocities)
