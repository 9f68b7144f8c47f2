"""The ready mechanisms of the library that are made of bodies, as models of bodies and joints: the same to rounding.

All but the beams, which bend, and the spatial ones that are models themselves. Where coordinates are the same,
accelerations at the states of a motion are those of the library's tables; where they differ (tips of bars, masses
without extension, yaw, lean and spin), motions are compared.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from studies.bench.closed_loops import squeezer
from tests.bodies.runs import moved
from twoloop import mechanisms
from twoloop.bodies import PlanarModel, SpatialModel
from twoloop.bodies.rotation import rotation_matrix

pytestmark = pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
TIMES = np.linspace(0.0, 1.0, 6)


def both(made, known, end, tolerance=1e-11, conserved=True, energy=True):
    """Runs of a model's problem and of a ready one; their energies move alike."""
    assert made.conserved == conserved
    runs = (replace(problem, t_span=(0.0, end)) for problem in (made, known))
    one, other = (moved(run, tolerance=tolerance, t_eval=end * TIMES, compiled=False) for run in runs)
    energies = [problem.energy(each.t, each.q, each.v) for problem, each in ((made, one), (known, other))]
    if energy:
        scale = 1.0 + np.abs(energies[1] - energies[1][0]).max()
        np.testing.assert_allclose(energies[0] - energies[0][0], energies[1] - energies[1][0], atol=1e-8 * scale)
    if made.coordinates == known.coordinates:
        for t, q, v in zip(other.t, other.q.T, other.v.T, strict=True):
            a, b = (accelerations(problem.system, t, q, v) for problem in (made, known))
            np.testing.assert_allclose(a, b, atol=1e-11 * np.abs(b).max())
    return made, one.q, other.q


def accelerations(system, t, q, v):
    """Of the equations of motion, (n_q,), by least squares."""
    rows, zero = system.rows(t, q), np.zeros((system.n_c + system.n_a,) * 2)
    matrix = np.block([[system.mass(t, q), rows.T], [rows, zero]])
    kinds = ("force", *["gamma"] * (system.n_c > 0), *["nonholonomic_gamma"] * (system.n_a > 0))
    right = [getattr(system, kind)(t, q, v) for kind in kinds]
    return np.linalg.lstsq(matrix, np.concatenate(right), rcond=1e-13)[0][: system.n_q]


def planar_as_given(known, masses, inertias):
    """A model with bodies as a problem of planar bodies starts."""
    model = PlanarModel()
    names = [each.split(" of ")[1] for each in known.coordinates[::3]]
    q, v = known.q0.reshape(-1, 3), known.v0.reshape(-1, 3)
    for name, mass, J, state, rate in zip(names, masses, inertias, q, v, strict=True):
        pose = {"position": state[:2], "angle": state[2], "velocity": rate[:2], "angular_velocity": rate[2]}
        model.body(name, mass=mass, inertia=J, **pose)
    return model


def test_four_bar():
    known = mechanisms.four_bar()
    lengths, q = np.array([1.0, 2.0, 1.5]), known.q0.reshape(3, 3)
    model = planar_as_given(known, lengths, lengths**3 / 12.0)
    along = [
        0.5 * long * np.array([math.cos(state[2]), math.sin(state[2])]) for long, state in zip(lengths, q, strict=True)
    ]
    model.revolute("ground", "bar 1", at=(0.0, 0.0))
    model.revolute("bar 1", "bar 2", at=q[0, :2] + along[0])
    model.revolute("bar 2", "bar 3", at=q[1, :2] + along[1])
    model.revolute("bar 3", "ground", at=(3.0, 0.0))
    made, one, other = both(model.problem((0.0, 5.0)), known, 5.0)
    np.testing.assert_allclose(one, other, atol=1e-8)
    assert made.freedom.degrees == 1 and made.freedom.redundant == () and made.tags[0] == "closed chain"


def slider_crank(angular_velocity=None):
    crank, rod, masses = 0.5, 1.2, (1.0, 1.5, 0.8)
    angle = 0.5
    pin = crank * np.array([math.cos(angle), math.sin(angle)])
    tilt = -math.asin(pin[1] / rod)
    end = pin + rod * np.array([math.cos(tilt), math.sin(tilt)])
    model = PlanarModel()
    one = model.body(
        "crank",
        mass=masses[0],
        inertia=masses[0] * crank**2 / 12.0,
        position=0.5 * pin,
        angle=angle,
        angular_velocity=angular_velocity,
    )
    two = model.body("rod", mass=masses[1], inertia=masses[1] * rod**2 / 12.0, position=0.5 * (pin + end), angle=tilt)
    three = model.body("slider", mass=masses[2], inertia=0.02, position=end)
    hinge = model.revolute("ground", one, at=(0.0, 0.0))
    model.revolute(one, two, at=pin)
    model.revolute(two, three, at=end)
    model.prismatic("ground", three, at=end, axis=(1.0, 0.0))
    return model, hinge, pin, end


def test_redundant_slider_crank():
    model, _, pin, end = slider_crank(angular_velocity=8.0)
    model.distance("slider", end, "crank", pin)
    made, one, other = both(model.problem((0.0, 2.0)), mechanisms.redundant_slider_crank(), 2.0)
    np.testing.assert_allclose(one, other, atol=1e-8)
    assert "redundant" in made.tags and made.freedom.degrees == 1
    assert [set(group) for group in made.freedom.redundant] == [
        {"revolute crank-rod", "revolute rod-slider", "distance slider-crank"}
    ]


@pytest.mark.parametrize("motion", ["derived", "given"])
def test_driven_slider_crank(motion):
    model, hinge, _, _ = slider_crank()
    derivatives = (
        {}
        if motion == "derived"
        else {"rate": lambda t: 4.0 + 0.9 * math.cos(3.0 * t), "acceleration": lambda t: -2.7 * math.sin(3.0 * t)}
    )
    model.drive(hinge, lambda t: 4.0 * t + 0.3 * np.sin(3.0 * t), **derivatives)
    made, one, other = both(model.problem((0.0, 2.0)), mechanisms.driven_slider_crank(), 2.0, conserved=False)
    np.testing.assert_allclose(one, other, atol=1e-8)
    assert made.freedom.degrees == 0 and "driven" in made.tags


def test_andrews():
    made, one, other = both(squeezer(), mechanisms.andrews(), 0.03, conserved=False, energy=False)
    np.testing.assert_allclose(one[2], other[0], atol=1e-7)
    np.testing.assert_allclose(one[8], other[2], atol=1e-8)
    np.testing.assert_allclose(one[14], other[4], atol=1e-8)
    assert made.freedom.degrees == 1


def test_sundials_slider_crank():
    known = mechanisms.sundials_slider_crank()
    model = PlanarModel(gravity=(0.0, 0.0))
    tilt = math.asin(-0.5)
    pin, end = np.array([0.0, 0.5]), np.array([math.cos(tilt), 0.0])
    centre = 0.5 * (pin + end)
    light = 1e-10  # crank and rod of the example have moments about their ends alone
    crank = model.body("crank", mass=light, inertia=1.0, position=(0.0, 0.0), angle=0.5 * math.pi)
    rod = model.body("rod", mass=light, inertia=2.0, position=end, angle=tilt)
    slider = model.body("slider", mass=1.0, inertia=1.0, position=end)
    model.revolute("ground", crank, at=(0.0, 0.0))
    model.revolute(crank, rod, at=pin)
    model.revolute(rod, slider, at=end)
    model.prismatic("ground", slider, at=end, axis=(2.0, 0.0))
    model.spring(crank, 0.5 * pin, rod, centre, stiffness=1.0, damping=1.0, length=1.0)
    model.force(rod, 2.0 * end - pin, (1.0, 0.0))
    _, one, other = both(model.problem((0.0, 5.0)), known, 5.0, conserved=False, energy=False)
    np.testing.assert_allclose(one[[2, 6, 5]], other, atol=1e-8)


def box(mass, x, y, z):
    return mass * (y * y + z * z) / 12.0, mass * (x * x + z * z) / 12.0, mass * (x * x + y * y) / 12.0


def test_bricard():
    C = np.array([[0, 0, 0], [1, 0, 0], [1, -1, 0], [1, -1, 1], [0, -1, 1], [0, 0, 1]], dtype=float)
    axes = np.eye(3)[[1, 2, 0, 1, 2, 0]]
    model = SpatialModel(gravity=(0.0, -9.81, 0.0))
    bars = [model.ground]
    for k in range(5):
        R = np.column_stack([C[k + 1] - C[k], axes[k], np.cross(C[k + 1] - C[k], axes[k])])
        moments = box(1.0, 1.0, 0.1, 0.1)
        bars.append(model.body(f"bar {k + 1}", mass=1.0, inertia=moments, position=0.5 * (C[k] + C[k + 1]), rotation=R))
    bars.append(model.ground)
    for k in range(6):
        model.revolute(bars[k], bars[k + 1], at=C[k], axis=axes[k])
    made, one, other = both(model.problem((0.0, 1.0)), mechanisms.bricard(), 1.0)
    np.testing.assert_allclose(one.reshape(5, 7, -1)[:, :3], other.reshape(5, 12, -1)[:, :3], atol=1e-8)
    assert made.freedom.degrees == 1 and len(made.freedom.redundant[0]) == 6


def test_driven_crank():
    known = mechanisms.driven_crank()
    model = planar_as_given(known, known.parameters["masses"], known.parameters["inertias"])
    hinge = model.revolute("ground", "crank", at=(0.0, 0.0))
    model.revolute("crank", "rod", at=2.0 * known.q0[:2])
    model.drive(hinge, lambda t: 2.5 * t + 0.2 * np.sin(t))
    _, one, other = both(model.problem((0.0, 3.0)), known, 3.0, conserved=False)
    np.testing.assert_allclose(one, other, atol=1e-8)


def test_n_four_bar():
    known = mechanisms.n_four_bar(2, coordinates="bodies")
    model = planar_as_given(known, np.ones(5), np.full(5, 1.0 / 12.0))
    for k in range(3):
        model.revolute("ground", f"crank {k}", at=(k, 0.0))
    for k in range(2):
        for end in (k, k + 1):
            model.revolute(f"coupler {k}", f"crank {end}", at=(end, 1.0))
    made, one, other = both(model.problem(), known, 0.5)
    np.testing.assert_allclose(one, other, atol=1e-8)
    _, one, other = both(made, mechanisms.n_four_bar(2), 0.5, energy=False)  # by the tips of the cranks
    tips = 2.0 * one.reshape(5, 3, -1)[:3, :2] - np.array([[k, 0.0] for k in range(3)])[:, :, None]
    np.testing.assert_allclose(tips.reshape(6, -1), other, atol=1e-8)


@pytest.mark.parametrize(
    "maker", [mechanisms.pendulum, mechanisms.projection_pendulum, mechanisms.double_pendulum, mechanisms.closed_chain]
)
def test_masses_on_links(maker):
    """Masses without extension: bodies that do not turn, as links end at their centres."""
    known = maker()
    p, places, rates = known.parameters, known.q0.reshape(-1, 2), known.v0.reshape(-1, 2)
    model = PlanarModel((0.0, -p["gravity"]))
    before = model.ground.point(0.0, 0.0)
    for k, (place, rate) in enumerate(zip(places, rates, strict=True)):
        body = model.body(f"{k}", mass=p["mass"], inertia=0.1, position=place, velocity=rate, angular_velocity=0.0)
        here = body.point(0.0, 0.0)
        model.distance(before.body, before, body, here, length=p["length"])
        before = here
    if maker is mechanisms.closed_chain:
        model.distance(before.body, before, "ground", (0.8, 0.0), length=p["length"])
    _, one, other = both(model.problem(), known, 1.0)
    np.testing.assert_allclose(one.reshape(-1, 3, 6)[:, :2], other.reshape(-1, 2, 6), atol=1e-8)
    np.testing.assert_array_equal(one[2::3], 0.0)


def test_knife_edge():
    known = mechanisms.knife_edge()
    p = known.parameters
    model = PlanarModel((p["gravity"] * math.sin(p["slope"]), 0.0))
    model.body("blade", mass=p["mass"], inertia=p["inertia"], position=(0.0, 0.0), angular_velocity=p["spin"])
    model.skate("blade", at=(0.0, 0.0), axis=(1.0, 0.0))
    made, one, other = both(model.problem(), known, 5.0)
    np.testing.assert_allclose(one, other, atol=1e-8)
    assert made.freedom.degrees == 2


def test_rolling_disc():
    known = mechanisms.rolling_disc()
    p = known.parameters
    yaw, lean, _ = p["angles"]
    sy, cy, s, c = math.sin(yaw), math.cos(yaw), math.sin(lean), math.cos(lean)
    R = np.array([[cy, s * sy, c * sy], [sy, -s * cy, -c * cy], [0.0, c, -s]])  # ahead, upright, axis
    J = 0.25 * p["mass"] * p["radius"] ** 2
    model = SpatialModel((0.0, 0.0, -p["gravity"]))
    pose = {"position": known.q0[:3], "rotation": R, "angular_velocity": R @ (0.6, 1.5, -9.0)}
    model.body("disc", mass=p["mass"], inertia=(J, J, 2.0 * J), **pose)
    model.rolling("disc", radius=p["radius"], axis=R[:, 2])
    made, one, other = both(model.problem(), known, 2.0)
    np.testing.assert_allclose(one[:3], other[:3], atol=1e-8)
    np.testing.assert_allclose(np.array([rotation_matrix(e)[2, 2] for e in one[3:].T]), -np.sin(other[4]), atol=1e-8)
    assert made.freedom.degrees == 3
