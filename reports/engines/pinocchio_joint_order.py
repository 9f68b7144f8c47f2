"""Pinocchio gives other accelerations where a joint is not added right after those of its branch, without a word.

Two pendulums hang on the world, each with a second bar on its end. Added branch by branch, they move alike, as they
should; added level by level, they do not. `crba` differs, too, and `aba` does not; `addJoint` takes both. pin 4.1.0.
"""

import numpy as np
import pinocchio as pin


def accelerations(order: str) -> np.ndarray:
    """Of both pendulums, first bar and second bar of each, as constraintDynamics without constraints has them."""
    model = pin.Model()
    axis, end = np.array([0.0, 1.0, 0.0]), pin.SE3(np.eye(3), np.array([0.5, 0.0, 0.0]))
    numbers: dict[str, int] = {}
    for name in order:  # a, b: first bars; A, B: those on their ends
        parent = numbers[name.lower()] if name.isupper() else 0
        numbers[name] = model.addJoint(parent, pin.JointModelRevoluteUnaligned(axis), end, name)
        model.appendBodyToJoint(numbers[name], pin.Inertia.FromBox(1.0, 0.5, 0.1, 0.1), pin.SE3.Identity())
    data, zero = model.createData(), np.zeros(4)
    models, datas = pin.StdVec_RigidConstraintModel(), pin.StdVec_RigidConstraintData()
    pin.initConstraintDynamics(model, data, models, datas)
    a = pin.constraintDynamics(model, data, zero, zero, zero, models, datas)
    return np.array([a[model.joints[numbers[name]].idx_v] for name in "aAbB"])


if __name__ == "__main__":
    print("branch by branch", accelerations("aAbB"))
    print("level by level  ", accelerations("abAB"))
