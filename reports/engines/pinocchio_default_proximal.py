"""Pinocchio's default ProximalSettings() have mu = 0: a planar loop closed by a 3D contact gives NaN.

The row across the plane is zero. mu = 1e-8 and some iterations give the accelerations, here zero. Seen with pin 4.1.0.
"""

import numpy as np
import pinocchio as pin


def acceleration(settings: pin.ProximalSettings) -> np.ndarray:
    """Of two hinged bars of 1 m whose free end is held in its place on the ground."""
    model, axis = pin.Model(), np.array([0.0, 1.0, 0.0])
    here = [pin.SE3.Identity(), pin.SE3(np.eye(3), np.array([1.0, 0.0, 0.0]))]
    for k in range(2):
        joint = model.addJoint(k, pin.JointModelRevoluteUnaligned(axis), here[k], f"joint {k}")
        middle = pin.SE3(np.eye(3), np.array([0.5, 0.0, 0.0]))
        model.appendBodyToJoint(joint, pin.Inertia.FromBox(1.0, 1.0, 0.1, 0.1), middle)
    q = np.array([-1.0, 1.5])
    data = model.createData()
    pin.forwardKinematics(model, data, q)
    place = data.oMi[2].act(np.array([1.0, 0.0, 0.0]))
    ends = 2, here[1], 0, pin.SE3(np.eye(3), place)
    models, datas = pin.StdVec_RigidConstraintModel(), pin.StdVec_RigidConstraintData()
    models.append(pin.RigidConstraintModel(pin.ContactType.CONTACT_3D, model, *ends, pin.ReferenceFrame.LOCAL))
    datas.append(models[0].createData())
    pin.initConstraintDynamics(model, data, models, datas)
    return np.asarray(pin.constraintDynamics(model, data, q, np.zeros(2), np.zeros(2), models, datas, settings))


if __name__ == "__main__":
    print("default  ", acceleration(pin.ProximalSettings()))
    print("mu = 1e-8", acceleration(pin.ProximalSettings(1e-14, 1e-8, 20)))
