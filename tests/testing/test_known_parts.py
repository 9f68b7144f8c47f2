"""Test bodies and joints of the problems of `twoloop.testing`: a simulator that gets nothing else passes the check."""

import numpy as np
import pytest

from tests.marks import slow, slow_but
from twoloop import solve_dae
from twoloop.bodies import PlanarModel, SpatialModel
from twoloop.testing import check_simulator, problems
from twoloop.testing.equations import rate_matrix, rotate

WITH_PARTS = {problem.name: problem for problem in problems() if problem.bodies}


def rotation(e):
    return np.column_stack([rotate(e, axis) for axis in np.eye(3)])


def pose_of(body, q, v, planar):
    """What a model is told of a body; a point gets a moment of inertia, which it does not feel."""
    state, rate = q[body.columns], v[body.columns]
    if planar:
        angle, spin = (state[2], rate[2]) if body.inertia.size else (0.0, 0.0)
        inertia = body.inertia[0] if body.inertia.size else body.mass
        told = {"angle": angle, "angular_velocity": spin}
        return {"mass": body.mass, "inertia": inertia, "position": state[:2], "velocity": rate[:2]} | told
    told = {"mass": body.mass, "inertia": np.full(3, body.mass), "position": state[:3], "velocity": rate[:3]}
    if body.inertia.size:
        e = state[3:]
        spin = rotate(e, 2.0 * rate_matrix(e) @ rate[3:])
        told |= {"inertia": body.inertia, "rotation": rotation(e), "angular_velocity": spin}
    return told


def of_the_ground(motion, begin):
    """A drive as models take it: how far the second body, here the ground, has turned on the first."""
    angle, rate, acceleration = motion
    from_start = angle(begin)
    return {
        "motion": lambda t: from_start - angle(t),
        "rate": lambda t: -rate(t),
        "acceleration": lambda t: -acceleration(t),
    }


def model_of(problem):
    """The model, and where in its q the coordinates of the problem are."""
    planar = problem.gravity.size == 2
    model = PlanarModel(gravity=problem.gravity) if planar else SpatialModel(gravity=problem.gravity)
    bodies = [
        model.body(f"body {k}", **pose_of(body, problem.q0, problem.v0, planar))
        for k, body in enumerate(problem.bodies)
    ]

    def in_space(number, vector, of_point):
        if number < 0:
            return vector
        body = bodies[number]
        R = np.asarray(body.rotation)
        if planar:
            s, c = np.sin(R), np.cos(R)
            R = np.array([[c, -s], [s, c]])
        return R @ vector + (body.position if of_point else 0.0)

    for k, joint in enumerate(problem.joints):
        pair = [model.ground if number < 0 else bodies[number] for number in joint.bodies]
        at = [in_space(number, point, True) for number, point in zip(joint.bodies, joint.points, strict=True)]
        axis = {} if joint.axis is None else {"axis": in_space(joint.bodies[1], joint.axis, False)}
        name = f"joint {k}"
        if joint.kind == "distance":
            model.distance(pair[0], at[0], pair[1], at[1], name=name)
        elif joint.kind == "drive":
            turning = next(
                f"joint {n}" for n, each in enumerate(problem.joints) if each.kind == "revolute" and -1 in each.bodies
            )
            model.drive(turning, **of_the_ground(joint.motion, problem.t_span[0]))
        else:
            getattr(model, joint.kind)(*pair, at=at[0], **axis, name=name)
    n = 3 if planar else 7
    place = [n * k + i for k, body in enumerate(problem.bodies) for i in range(body.columns.stop - body.columns.start)]
    return model.problem(t_span=problem.t_span), np.array(place)


def simulate(problem, times, tolerance):
    made, place = model_of(problem)
    start = made.q0.copy(), made.v0.copy()
    start[0][place], start[1][place] = problem.q0, problem.v0
    result = solve_dae(made.system, (times[0], times[-1]), *start, rtol=tolerance, atol=tolerance, t_eval=times)
    if not result.success:
        raise RuntimeError(result.message)
    return result.q.T[:, place], result.v.T[:, place]


@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
@pytest.mark.parametrize("name", slow_but(["driven_crank"], WITH_PARTS))
def test_a_simulator_of_bodies_and_joints_passes(name):
    report = check_simulator(simulate, name, tolerances=(1e-6, 1e-8))
    assert report.passed, str(report)


@pytest.mark.parametrize("name", ["spatial_four_bar", slow("slider_crank"), slow("heavy_top")])
def test_reactions_are_those_of_a_model(name):
    problem = WITH_PARTS[name]
    made, place = model_of(problem)
    motion, k = problem.reference, 100
    q, v = made.q0.copy(), made.v0.copy()
    q[place], v[place] = motion.q[k], motion.v[k]
    result = solve_dae(made.system, (motion.t[k], motion.t[k] + 1e-6), q, v)
    for number, joint in enumerate(problem.joints):
        force, torque = problem.reaction(joint, motion.t[k], motion.q[k], motion.lam[k])
        there = result.reactions(f"joint {number}")
        largest = np.abs(motion.lam).max()
        np.testing.assert_allclose(force, there.force[:, 0], atol=1e-8 * largest)
        if torque.size:
            np.testing.assert_allclose(torque, np.atleast_2d(there.torque)[..., 0].ravel(), atol=1e-8 * largest)
