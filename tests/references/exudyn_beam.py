"""The beam on a moving base with Exudyn's own models: a cable without shear, or a geometrically exact beam.

Only the data of the beam and its base are shared with twoloop. Both are models of slender beams with E A, E I and, in
the second, G A, without thickness deformation or other effects of Poisson's ratio. For Poisson's ratio 0, the elements
of `twoloop.mechanisms.ancf_beam` converge to them as the mesh is refined and the section becomes slender. Otherwise
the elements lock and converge to a cable of (lambda + 2 mu)/E times the stiffness; tests/references/test_exudyn.py
measures how closely.
"""

import math
from types import SimpleNamespace

import numpy as np

from references.exudyn.model import add_sensors, check_steps, exu, items, run

MODELS = {
    "cable": "ANCFCable2D: cubic, the section stays normal to the centre line and has no rotary inertia",
    "shear": "BeamGeometricallyExact2D: linear, the section turns by itself; shear stiffness G A uncorrected",
}


def solve_exudyn_beam(
    problem, t_end, n_steps, model="cable", *, solver="GeneralizedAlpha", store_every=1, time_limit=None
):
    """Run the beam on its moving base with one of Exudyn's implicit solvers, with a fixed step.

    Only the `parameters` of the problem are used. q, v, a (6 (n_elements + 1), n_t) of the `Result` are in the order of
    `ancf_beam`; NaN where the model has no such quantity: the directors, with "shear" also the slopes. So is `lam`.
    """
    steps = check_steps(problem, t_end, n_steps, solver, store_every, time_limit)
    beam = _model(problem.parameters, model)
    n_nodes = len(beam.reference)
    kept = 4 if model == "cable" else 2  # of x, y, slopes the first model has all, the second x, y and an angle

    def among_six(coordinates):
        """Insert Exudyn's coordinates into six coordinates per node."""
        inserted = np.full((n_nodes, 6, coordinates.shape[1]), np.nan)
        inserted[:, :kept] = coordinates.reshape(n_nodes, -1, coordinates.shape[1])[:, :kept]
        return inserted.reshape(-1, coordinates.shape[1])

    return run(beam, steps, lambda q, v, a: (among_six(q), among_six(v), among_six(a)))


def _model(p, model):
    """Return Exudyn's container, its system, the sensors [node][output] and the reference coordinates [node]."""
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
    return SimpleNamespace(container=container, mbs=mbs, sensors=sensors, reference=reference)


def _element(p, model, length):
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


def _hold(mbs, p, node):
    """Prescribe a node's motion, amplitude sin(angular_frequency t) along x and zero along y."""
    amplitude, frequency = p["amplitude"], p["angular_frequency"]

    def place(mbs, t, itemNumber, lOffset):
        return float(amplitude * math.sin(frequency * t))

    def speed(mbs, t, itemNumber, lOffset):
        return float(amplitude * frequency * math.cos(frequency * t))

    ground = mbs.AddMarker(items.MarkerNodeCoordinate(nodeNumber=mbs.AddNode(items.NodePointGround()), coordinate=0))
    along, across = (mbs.AddMarker(items.MarkerNodeCoordinate(nodeNumber=node, coordinate=k)) for k in range(2))
    moved = {"offsetUserFunction": place, "offsetUserFunction_t": speed}
    mbs.AddObject(items.ObjectConnectorCoordinate(markerNumbers=[ground, along], **moved))
    mbs.AddObject(items.ObjectConnectorCoordinate(markerNumbers=[ground, across]))
