"""Drake: a continuous plant takes a ball constraint and throws at the first step; TAMSI refuses it. Drake 1.51.1."""

from collections.abc import Sequence

import numpy as np
from pydrake.multibody.plant import DiscreteContactApproximation, MultibodyPlant
from pydrake.multibody.tree import RevoluteJoint, SpatialInertia
from pydrake.systems.analysis import Simulator


def said(step: float, approximation: str = "") -> str:
    """What it throws, and where."""
    plant = MultibodyPlant(step)
    if approximation:
        plant.set_discrete_contact_approximation(getattr(DiscreteContactApproximation, approximation))
    rod = SpatialInertia.ThinRodWithMass(1.0, 1.0, np.array([1.0, 0.0, 0.0]))
    bars: Sequence = [plant.AddRigidBody(name, rod) for name in ("one", "other")]
    for bar in bars:
        frames = plant.world_frame(), bar.body_frame()
        plant.AddJoint(RevoluteJoint(bar.name(), *frames, np.array([0.0, 1.0, 0.0])))
    where = "AddBallConstraint"
    try:
        plant.AddBallConstraint(bars[0], np.array([0.5, 0.0, 0.0]), bars[1], np.array([0.5, 0.0, 0.0]))
        plant.Finalize()
        where = "AdvanceTo"
        Simulator(plant).AdvanceTo(0.01)
    except RuntimeError as error:
        return f"{where}: {error}"
    return "runs"


if __name__ == "__main__":
    print("continuous", said(0.0))
    print("TAMSI     ", said(1e-3, "kTamsi"))
    print("SAP       ", said(1e-3, "kSap"))
