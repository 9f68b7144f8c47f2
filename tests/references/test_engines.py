"""Test models of closed loops in physics engines: inertia, accelerations, motions; what the gates catch."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from references.engines import rigid as catalogue
from references.engines.rigid import rigid_of
from studies.bench import closed_loops
from studies.bench.closed_loops import ASKEW, LIGHTENED, SPATIAL
from studies.engines import Loop, errors, gate
from twoloop import audit
from twoloop.audit.simulator import gaps
from twoloop.bodies import PlanarModel, SpatialModel

ENGINES = catalogue.engines()
engines = pytest.mark.parametrize("engine", ENGINES)


def prepared(engine, rigid):
    try:
        return ENGINES[engine].prepare(rigid, ENGINES[engine].most_rigid)
    except RuntimeError as error:
        if "not installed" in str(error):
            pytest.skip(str(error))
        raise


@pytest.fixture(scope="module")
def loops():
    """In a plane with a spring and a torque; in space with tensors, turned axes and swapped bodies; with a slide."""
    return Loop(closed_loops.squeezer()), Loop(crooked()), Loop(replace(closed_loops.slider_crank(), t_span=(0.0, 0.5)))


def crooked():
    """Hinge, cross, ball and hinge; bodies with axes and tensors in any direction, the whole turned in space."""
    Q, *turns = Rotation.random(7, random_state=5).as_matrix()
    O, P, S, D = np.array([(0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.9, 0.0, 1.0), (0.9, 0.0, 0.3)]) @ Q.T
    x, y, z = Q.T
    model = SpatialModel(gravity=-9.81 * z, name="crooked")
    for k, (name, start, end) in enumerate((("crank", O, P), ("coupler", P, S), ("rocker", D, S))):
        motion = {"angular_velocity": 6.0 * z} if k == 0 else {}
        J = turns[k] @ np.diag([0.02, 0.05, 0.06]) @ turns[k].T
        model.body(name, mass=0.8, inertia=J, position=0.4 * start + 0.6 * end, rotation=turns[3 + k], **motion)
    model.revolute("crank", "ground", at=O, axis=z)
    model.universal("coupler", "crank", at=P, axes=(x - 0.6 * z, y))
    model.spherical("coupler", "rocker", at=S)
    model.revolute("rocker", "ground", at=D, axis=y)
    return model.problem((0.0, 1.0))


@engines
@pytest.mark.parametrize("k", [0, 1, 2])
def test_models_pass_the_gates_and_move_as_they_should(loops, engine, k):
    ready = prepared(engine, loops[k].rigid)
    assert gate(loops[k], ready) == "" and errors(loops[k], ready.run(loops[k].t_end, 2000, 50))["error_q"] < 0.1


@engines
def test_gates_catch_a_loop_an_inertia_a_mass_and_a_torque(loops, engine):
    loop = loops[0]
    rigid = loop.rigid

    def model(change):
        problem = closed_loops.squeezer()
        change(problem.model, problem.model.bodies[2].inertia)
        return rigid_of(problem)

    def lose_inertia(model, inertia):
        inertia[1] *= 0.5

    def lose_mass(model, inertia):
        inertia[0] *= 0.5

    def lose_joint(model, inertia):
        model.joints.remove(next(joint for joint in model.joints if joint.name == cut))

    cut = rigid.loops[0].name
    assert "the largest moment of inertia of 'K3' is 2." in gate(loop, prepared(engine, model(lose_inertia)))
    assert "the mass of 'K3' is 0." in gate(loop, prepared(engine, model(lose_mass)))
    assert "accelerations" in gate(loop, prepared(engine, model(lose_joint)))
    assert "accelerations" in gate(loop, prepared(engine, replace(rigid, torques=1.1 * rigid.torques)))


def leaning():
    """Two bars that lean on one another, at rest, and a pendulum that moves: forces by hand, without any solver."""
    model = PlanarModel(name="leaning")
    model.rod("left", (0.0, 0.0), (1.0, 1.5), mass=1.0)
    model.rod("right", (1.0, 1.5), (2.4, 0.2), mass=2.0)
    model.rod("pendulum", (3.0, 0.0), (3.5, 0.0), mass=1.0)
    for a, b, at in (("ground", "left", (0.0, 0.0)), ("left", "right", (1.0, 1.5)), ("right", "ground", (2.4, 0.2))):
        model.revolute(a, b, at=at)
    model.revolute("ground", "pendulum", at=(3.0, 0.0))
    return model.problem((0.0, 0.1))


@engines
def test_the_force_of_a_joint_has_the_sign_of_ours_at_rest_and_its_size_in_motion(engine):
    loop = Loop(leaning())
    # moments about the feet: of the left bar x 1.5 - y 1 = -g 0.5, of the right one with the opposite force
    f = np.linalg.solve([[1.5, -1.0], [1.3, 1.4]], [-9.81 * 0.5, -2.0 * 9.81 * 0.7])
    for told in (loop.reference[0].f, prepared(engine, loop.rigid).run(0.1, 1000, 50).f):
        np.testing.assert_allclose(told[1:, :2], np.tile(f, (50, 1)), rtol=2e-3)
    turned = Loop(replace(closed_loops.rssr(ASKEW), t_span=(0.0, 0.2)))
    assert errors(turned, prepared(engine, turned.rigid).run(0.2, 2000, 50))["error_f"] < 0.02
    assert np.isnan(Loop(replace(closed_loops.bricard(), t_span=(0.0, 0.05))).reference[0].f).all()  # not unique


@pytest.mark.parametrize(
    ("engine", "order"), [("mujoco", 1.7), ("drake", 0.8), ("pinocchio", 3.5), ("exudyn_bodies", 1.8)]
)
def test_errors_fall_with_the_step(engine, order):
    loop = Loop(replace(closed_loops.rssr(), t_span=(0.0, 0.2)))
    run = prepared(engine, loop.rigid).run
    off = [errors(loop, run(0.2, n, 50)) for n in (50, 200)]
    assert np.log(off[0]["error_q"] / off[1]["error_q"]) / np.log(4.0) > order
    assert off[1]["error_v"] < 0.05 and off[1]["gap"] < 1e-3


@pytest.mark.parametrize("engine", ["pinocchio", "exudyn_bodies"])
def test_an_engine_is_audited_by_a_small_adapter(engine):
    problem = replace(closed_loops.rssr(), t_span=(0.0, 0.2))
    run = prepared(engine, rigid_of(problem)).run

    def simulate(problem, times, step):
        motion = run(times[-1], round(times[-1] / step), len(times) - 1)
        return audit.coordinates(motion.x, motion.R)

    made = audit.audit_simulator(simulate, problem, step=2e-3, error=1e-4)
    assert made.order > 1.7 and made.reaching.error <= 1e-4


@pytest.mark.parametrize(
    "make", (*closed_loops.MECHANISMS, *(partial(each, ASKEW) for each in SPATIAL), *LIGHTENED[2:4])
)
def test_loops_are_cut_between_bodies_that_move_and_close(make):
    problem = closed_loops.closed_chain(6) if make is closed_loops.closed_chain else make()
    rigid = rigid_of(problem)
    for a, on_a, b, on_b in rigid.cut_points():
        assert rigid.model.ground not in (a, b)
        np.testing.assert_allclose(a.in_space(on_a), b.in_space(on_b), atol=1e-12)
    assert gaps(rigid.model, rigid.x[None], rigid.R[None])[0] < 1e-12 and problem.freedom.degrees >= 1


def test_what_no_engine_is_given_is_refused():
    model = PlanarModel(name="arm")
    model.rod("bar", (0.0, 0.0), (1.0, 0.0), mass=1.0)
    model.motor(model.revolute("ground", "bar", at=(0.0, 0.0)), lambda t: 1.0 + t, name="servo")
    with pytest.raises(ValueError, match="not 'servo'"):
        rigid_of(model.problem())
