"""A four-bar linkage from four points of a sketch, and the names of its parts."""

import math

from twoloop.bodies import PlanarModel

O, A, B, D = (0.0, 0.0), (0.04, -1.0), (1.54, 0.32), (3.0, 0.0)  # m, read off the sketch


def linkage():
    """Return the linkage at rest in the position of the sketch, to be run for ten seconds."""
    model = PlanarModel(name="linkage")  # gravity=(0.0, -9.81)
    for name, start, end in (("OA", O, A), ("AB", A, B), ("BD", B, D)):
        model.rod(name, start, end, mass=math.dist(start, end))  # uniform, 1 kg per metre
    model.revolute("ground", "OA", at=O)
    model.revolute("OA", "AB", at=A)
    model.revolute("AB", "BD", at=B)
    model.revolute("BD", "ground", at=D)
    return model.problem(t_span=(0.0, 10.0))
