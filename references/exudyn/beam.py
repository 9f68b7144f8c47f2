"""The beam on a moving base with Exudyn's own models: a cable without shear, or a geometrically exact beam.

Only the data of the beam and its base are shared with twoloop. Both are models of slender beams with E A, E I and, in
the second, G A, without thickness deformation or other effects of Poisson's ratio. For Poisson's ratio 0, the elements
of `twoloop.mechanisms.ancf_beam` converge to them as the mesh is refined and the section becomes slender. Otherwise
the elements lock and converge to a cable of (lambda + 2 mu)/E times the stiffness; tests/references/test_exudyn.py
measures how closely.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from references.driver import check_problem
from references.exudyn.model import add_sensors, check_steps, exu, items, run
from twoloop.checks.arguments import check_choice
from twoloop.problem.problem import Array, Problem
from twoloop.result.result import Result

MODELS = {
    "cable": "ANCFCable2D: cubic, the section stays normal to the centre line and has no rotary inertia",
    "shear": "BeamGeometricallyExact2D: linear, the section turns by itself; shear stiffness G A uncorrected",
}


def solve_exudyn_beam(
    problem: Problem,
    t_end: float,
    n_steps: int,
    model: str = "cable",
    *,
    solver: str = "GeneralizedAlpha",
    store_every: int = 1,
    time_limit: float | None = None,
) -> Result:
    """Run the beam on its moving base with one of Exudyn's implicit solvers, with a fixed step.

    Parameters
    ----------
    problem : Problem
        Problem of `twoloop.mechanisms.ancf_beam`; only its `parameters` are used.
    t_end, n_steps, solver, store_every, time_limit : see `references.exudyn.mechanisms.solve_exudyn`
    model : {"cable", "shear"}
        `MODELS` has a description of each for tables. The first converges much faster with mesh refinement.

    Returns
    -------
    Result
        q, v, a (6 (n_elements + 1), n_t) in the order of `ancf_beam`, as required by its `tip_height` and
        `midpoint_deflection`. Quantities missing in the model are NaN: the directors, with "shear" also the slopes.
        `lam` (2, n_t) is NaN too. Otherwise as in `references.exudyn.mechanisms.solve_exudyn`.
    """
    check_problem(problem, "youngs_modulus", "a beam of twoloop.mechanisms.ancf_beam")
    steps = check_steps(problem, t_end, n_steps, solver, store_every, time_limit)
    check_choice("model", model, tuple(MODELS))
    _container, mbs, sensors, reference = _model(problem.parameters, model)
    n_nodes = len(reference)
    kept = 4 if model == "cable" else 2  # of x, y, slopes the first model has all, the second x, y and an angle

    def among_six(coordinates: Array) -> Array:
        """Insert Exudyn's coordinates into six coordinates per node."""
        ours = np.full((n_nodes, 6, coordinates.shape[1]), np.nan)
        ours[:, :kept] = coordinates.reshape(n_nodes, -1, coordinates.shape[1])[:, :kept]
        return ours.reshape(-1, coordinates.shape[1])

    return run(mbs, sensors, reference.ravel(), steps, lambda q, v, a: (among_six(q), among_six(v), among_six(a)))


def _model(p: dict[str, Any], model: str) -> tuple[Any, Any, list[list[int]], Array]:
    """Return Exudyn's container, its system, the sensors [node][output], and the reference coordinates [node]."""
    container = exu.SystemContainer()
    mbs = container.AddSystem()
    n_elements = p["n_elements"]
    length = p["length"] / n_elements
    node_type, straight = (items.NodePoint2DSlope1, [1.0, 0.0]) if model == "cable" else (items.NodeRigidBody2D, [0.0])
    reference = np.array([[k * length, 0.0, *straight] for k in range(n_elements + 1)])
    start = np.zeros_like(reference)
    start[: 1 if p["start"] == "node" else None, 0] = p["amplitude"] * p["angular_frequency"]
    nodes = [
        mbs.AddNode(node_type(referenceCoordinates=position.tolist(), initialVelocities=velocity.tolist()))
        for position, velocity in zip(reference, start, strict=True)
    ]
    element = _element(p, model, length)
    for k in range(n_elements):
        whole = mbs.AddMarker(items.MarkerBodyMass(bodyNumber=mbs.AddObject(element(nodes[k : k + 2]))))
        mbs.AddLoad(items.LoadMassProportional(markerNumber=whole, loadVector=[0.0, -p["gravity"], 0.0]))
    _hold(mbs, p, nodes[0])
    sensors = [add_sensors(mbs, node) for node in nodes]
    mbs.Assemble()
    return container, mbs, sensors, reference


def _element(p: dict[str, Any], model: str, length: float) -> Callable[[list[int]], Any]:
    """Return an element of the beam between two nodes."""
    area, second_moment = p["height"] * p["width"], p["width"] * p["height"] ** 3 / 12.0
    section = {"length": length, "massPerLength": p["density"] * area}
    section |= {"bendingStiffness": p["youngs_modulus"] * second_moment, "axialStiffness": p["youngs_modulus"] * area}
    if model == "cable":
        return lambda ends: items.ObjectANCFCable2D(nodeNumbers=ends, **section)
    # without shear correction factor, as in twoloop's element
    section |= {"shearStiffness": 0.5 * p["youngs_modulus"] / (1.0 + p["poisson_ratio"]) * area}
    section |= {"crossSectionInertia": p["density"] * second_moment}
    return lambda ends: items.ObjectBeamGeometricallyExact2D(nodeNumbers=ends, **section)


def _hold(mbs: Any, p: dict[str, Any], node: int) -> None:
    """Prescribe a node's motion, amplitude sin(angular_frequency t) along x and zero along y."""
    amplitude, frequency = p["amplitude"], p["angular_frequency"]

    def place(mbs: Any, t: float, itemNumber: int, lOffset: float) -> float:
        return float(amplitude * math.sin(frequency * t))

    def speed(mbs: Any, t: float, itemNumber: int, lOffset: float) -> float:
        return float(amplitude * frequency * math.cos(frequency * t))

    ground = mbs.AddMarker(items.MarkerNodeCoordinate(nodeNumber=mbs.AddNode(items.NodePointGround()), coordinate=0))
    along, across = (mbs.AddMarker(items.MarkerNodeCoordinate(nodeNumber=node, coordinate=k)) for k in range(2))
    moved = {"offsetUserFunction": place, "offsetUserFunction_t": speed}
    mbs.AddObject(items.ObjectConnectorCoordinate(markerNumbers=[ground, along], **moved))
    mbs.AddObject(items.ObjectConnectorCoordinate(markerNumbers=[ground, across]))
