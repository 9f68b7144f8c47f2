"""Newton: the Featherstone solver takes a joint that closes a loop, and moves the open chain. Seen with newton 1.8.0.

A parallelogram of two cranks and a link falls for half a second; its last joint is outside the articulations.
"""

import newton
import numpy as np
import warp as wp

HINGE = {"axis": newton.Axis.Y}
INERTIA = wp.mat33(0.01, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 0.1)


def gap(name: str) -> float:
    """How far the points of the last joint are apart after half a second, m."""
    builder = newton.ModelBuilder()
    places = ((-0.5, 0.0, 0.0), (0.5, 0.0, 0.0))
    cranks = [builder.add_link(mass=1.0, com=(0.0, 0.0, 0.5), inertia=INERTIA, xform=wp.transform(at)) for at in places]
    link = builder.add_link(mass=1.0, inertia=INERTIA, xform=wp.transform((-0.5, 0.0, 1.0)))
    top, end = wp.transform((0.0, 0.0, 1.0)), wp.transform((1.0, 0.0, 0.0))
    first = builder.add_joint_revolute(-1, cranks[0], parent_xform=wp.transform(places[0]), **HINGE)
    builder.add_articulation([first, builder.add_joint_revolute(cranks[0], link, parent_xform=top, **HINGE)])
    builder.add_articulation([builder.add_joint_revolute(-1, cranks[1], parent_xform=wp.transform(places[1]), **HINGE)])
    builder.add_joint_revolute(cranks[1], link, parent_xform=top, child_xform=end, **HINGE)  # closes the loop
    builder.joint_qd[:3] = [1.0, -1.0, 1.0]  # the link moves without turning
    model = builder.finalize()
    solver = getattr(newton.solvers, name)(model)
    now, after, control = model.state(), model.state(), model.control()
    newton.eval_fk(model, model.joint_q, model.joint_qd, now)
    for _ in range(500):
        now.clear_forces()
        solver.step(now, after, control, None, 1e-3)
        now, after = after, now
    x = now.body_q.numpy()
    ends = [
        wp.transform_point(wp.transform(*x[k]), wp.vec3(*at)) for k, at in ((cranks[1], (0, 0, 1)), (link, (1, 0, 0)))
    ]
    return float(np.linalg.norm(np.array(ends[0]) - np.array(ends[1])))


if __name__ == "__main__":
    for name in ("SolverFeatherstone", "SolverMuJoCo"):
        print(name, gap(name))
