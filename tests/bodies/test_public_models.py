"""Published mechanisms with loops: each right to nine digits by two unlike methods, and what is known of its geometry.

Dimensions are published ones where a source is named; masses are chosen here.
"""

import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest

from tests.bodies.runs import moved
from twoloop.bodies import PlanarModel, SpatialModel, from_mjcf

pytestmark = pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")  # loops in space
UNLIKE = ("DOP853", "RadauIIA13")


def agreed(problem, end):
    """The motion at 1e-10 by an explicit method that projects, if an implicit one finds it, too."""
    run = replace(problem, t_span=(0.0, end))
    one, other = (moved(run, method, 1e-10, t_eval=np.linspace(0.0, end, 9)) for method in UNLIKE)
    assert np.abs(one.q - one.q[:, :1]).max() > 1e-2  # it moves
    np.testing.assert_allclose(one.q, other.q, atol=1e-9 * max(1.0, np.abs(one.q).max()))
    if problem.conserved:
        assert np.ptp(one.energy) < 1e-8 * max(1.0, np.abs(one.energy).max())
    return one


def planar(places, bodies, ground, name, **options):
    """Bars and plates by the points that they have; a pin where points of several are one."""
    model = PlanarModel(name=name, **options)
    at: dict[str, list[str]] = {each: ["ground"] for each in ground}
    for body, points in bodies.items():
        own = np.array([places[each] for each in points])
        size = float(np.abs(own - own.mean(axis=0)).max())
        model.body(body, mass=size, inertia=size**3 / 3.0, position=own.mean(axis=0))
        for each in points:
            at.setdefault(each, []).append(body)
    for each, there in at.items():
        for other in there[1:]:
            model.revolute(there[0], other, at=places[each], name=f"{each} {there[0]} {other}")
    return model


def meet(one, radius, other, far, side):
    """The point at these distances from two others, to the left (1) or the right (-1) of the way between them."""
    one, other = np.array(one, dtype=float), np.array(other, dtype=float)
    d = np.linalg.norm(other - one)
    along, x = (other - one) / d, (radius**2 - far**2 + d * d) / (2.0 * d)
    return one + x * along + side * np.sqrt(radius**2 - x * x) * np.array([-along[1], along[0]])


# T. Jansen, The Great Pretender (2007): the "holy numbers", over 100; compared with those of public programs,
# OpenSCAD User Manual/Example/Strandbeest (Wikibooks) among them
LENGTHS = (38.0, 41.5, 39.3, 40.1, 55.8, 39.4, 36.7, 65.7, 49.0, 50.0, 61.9, 7.8, 15.0)
JANSEN = {name: 0.01 * length for name, length in zip("abcdefghijklm", LENGTHS, strict=True)}
LEG = {"crank": "ZX", "j": "XV", "k": "XW", "bde": "YVU", "c": "YW", "f": "UT", "ghi": "TWS"}


def strandbeest(angle):
    n = JANSEN
    Z, Y = np.zeros(2), np.array([-n["a"], -n["l"]])
    X = n["m"] * np.array([np.cos(angle), np.sin(angle)])
    V, W = meet(Y, n["b"], X, n["j"], 1), meet(Y, n["c"], X, n["k"], -1)
    U = meet(Y, n["d"], V, n["e"], 1)
    T = meet(U, n["f"], W, n["g"], -1)  # on the other side of U W than Y
    S = min((meet(T, n["h"], W, n["i"], side) for side in (1, -1)), key=lambda foot: foot[1])
    return {"Z": Z, "Y": Y, "X": X, "V": V, "W": W, "U": U, "T": T, "S": S}


def test_a_strandbeest_leg():
    places = strandbeest(0.4)
    swings = planar(places, LEG, "ZY", "leg").problem()
    assert swings.freedom.degrees == 1 and not swings.freedom.redundant
    agreed(swings, 0.7)
    driven = planar(places, LEG, "ZY", "leg")
    driven.drive("Z ground crank", lambda t: 5.0 * t)
    walk = agreed(driven.problem(), 2.0 * np.pi / 5.0)  # once round
    foot, angle = len(LEG) - 1, walk.q[2]
    for k, turned in enumerate(angle):
        known = strandbeest(0.4 + turned)
        centre = np.mean([known[each] for each in LEG["ghi"]], axis=0)
        np.testing.assert_allclose(walk.q[3 * foot : 3 * foot + 2, k], centre, atol=1e-11)


STRAIGHT = {  # of the coupler's tracing point: bars in the proportions of the sources
    # Chebyshev (1854): ground 4, cranks 5 and 5, coupler 2, crossed; the middle of the coupler
    "Chebyshev": ({"A": (0.0, 0.0), "B": (4.0, 0.0), "C": (3.0, 4.0), "D": (1.0, 4.0)}, ("AC", "BD", "CD")),
    # Watt (1784): arms of one length, the middle of the link between them; here nearly in its middle position
    "Watt": ({"A": (0.0, 0.0), "B": (4.1, 1.0), "C": (2.0, 0.0), "D": (2.1, 1.0)}, ("AC", "BD", "CD")),
}


@pytest.mark.parametrize("name", STRAIGHT)
def test_linkages_that_draw_nearly_a_line(name):
    places, bars = STRAIGHT[name]
    model = planar({k: 0.25 * np.array(v) for k, v in places.items()}, dict(zip(bars, bars, strict=True)), "AB", name)
    model.drive("A ground AC", lambda t: 0.3 * np.sin(t) ** 2)
    result = agreed(model.problem(), 3.0)
    along = np.ptp(result.q[6:8], axis=1)  # of the middle of the coupler
    assert along.min() < 0.03 * along.max() and along.max() > 0.1


def test_hoeckens_linkage():
    """K. Hoecken (1926): crank 1, ground 2, coupler and rocker 2.5, the tracing point 2.5 beyond; over 4 here."""
    A, B, C = np.zeros(2), np.array([0.5, 0.0]), np.array([0.0, 0.25])
    D = meet(C, 0.625, B, 0.625, 1)
    model = planar(
        {"A": A, "B": B, "C": C, "D": D, "P": 2.0 * D - C}, {"crank": "AC", "rod": "CDP", "rocker": "BD"}, "AB", "H"
    )
    model.drive("A ground crank", lambda t: 2.0 * t)
    result = agreed(model.problem(), np.pi)
    np.testing.assert_allclose(result.q[:, -1] - result.q[:, 0], [0, 0, 2 * np.pi, 0, 0, 0, 0, 0, 0], atol=1e-9)


def test_peaucelliers_inversor_draws_a_line():
    """C.-N. Peaucellier (1864): O A = O B, the rhombus A P B Q, and P on a circle through O: Q moves on a line."""
    O, E = np.zeros(2), np.array([0.3, 0.0])
    P = E + 0.3 * np.array([np.cos(0.7), np.sin(0.7)])
    A, B = (meet(O, 1.0, P, 0.6, side) for side in (1, -1))
    Q = A + B - P
    bars = {"OA": "OA", "OB": "OB", "AP": "AP", "BP": "BP", "AQ": "AQ", "BQ": "BQ", "EP": "EP"}
    problem = planar({"O": O, "E": E, "P": P, "A": A, "B": B, "Q": Q}, bars, "OE", "inversor").problem()
    assert problem.freedom.degrees == 1
    result = agreed(problem, 0.4)
    # Q is as far beyond the middle of AQ as A before it
    np.testing.assert_allclose(2.0 * (result.q[12] - result.q[0]), (1.0 - 0.6**2) / 0.6, atol=1e-12)
    assert np.ptp(result.q[13]) > 0.05


def test_a_five_bar():
    """Two degrees of freedom: arms of 0.2 and 0.25 m on pivots 0.1 m apart, as of planar parallel robots."""
    A, B, C, D = (np.array(each) for each in ((0.0, 0.0), (0.1, 0.0), (-0.1, 0.15), (0.2, 0.16)))
    places = {"A": A, "B": B, "C": C, "D": D, "E": meet(C, 0.25, D, 0.25, 1)}
    model = planar(places, {"AC": "AC", "BD": "BD", "CE": "CE", "DE": "DE"}, "AB", "five-bar")
    model.torsion_spring("A ground AC", stiffness=0.3, damping=0.01)
    problem = model.problem()
    assert problem.freedom.degrees == 2
    agreed(problem, 0.4)


@pytest.mark.slow
def test_lazy_tongs_open_all_alike():
    n, half = 4, np.array([0.2, 0.15])
    places, bars = {}, {}
    for k in range(n + 1):
        for side, sign in (("u", 1.0), ("d", -1.0)):
            places[f"{side}{k}"] = np.array([2.0 * half[0] * k, sign * half[1]])
    places |= {f"m{k}": np.array([half[0] * (2 * k + 1), 0.0]) for k in range(n)}
    for k in range(n):
        bars[f"rise {k}"] = (f"d{k}", f"m{k}", f"u{k + 1}")
        bars[f"fall {k}"] = (f"u{k}", f"m{k}", f"d{k + 1}")
    model = planar(places, bars, ("d0",), "tongs", gravity=(0.0, 0.0))
    slider = model.body("slider", mass=0.1, inertia=0.1, position=places["u0"])
    model.prismatic("ground", slider, at=places["u0"], axis=(0.0, 1.0))
    model.revolute(slider, "fall 0", at=places["u0"])
    model.spring("ground", places["d0"], f"fall {n - 1}", places[f"d{n}"], stiffness=20.0, length=1.0)
    problem = model.problem()
    assert problem.freedom.degrees == 1
    middles = agreed(problem, 1.0).q[:-3].reshape(n, 2, 3, -1)[:, 0, 0]
    np.testing.assert_allclose(middles, np.outer(2 * np.arange(n) + 1, middles[0]), atol=1e-12)


@pytest.mark.slow  # a delta robot is not
def test_a_stewart_platform():
    """Six legs between two hexagons, in proportions like those of INRIA's "left hand" (J.-P. Merlet, Parallel Robots).

    The numbers are ours: no public source was found to compare them with.
    """
    base = [(-9.7, 9.1), (9.7, 9.1), (12.76, 3.9), (3.0, -13.0), (-3.0, -13.0), (-12.76, 3.9)]
    top = [(-3.0, 7.3), (3.0, 7.3), (7.822, -1.052), (4.822, -6.248), (-4.822, -6.248), (-7.822, -1.052)]
    model = SpatialModel(name="hexapod")
    plate = model.body("plate", mass=2.0, inertia=(0.1, 0.1, 0.2), position=(0.0, 0.0, 0.8))
    for k, (one, other) in enumerate(zip(base, top, strict=True)):
        A, B = 0.05 * np.array([*one, 0.0]), np.array([0.05 * other[0], 0.05 * other[1], 0.8])
        low, high = (f"{which} {k}" for which in ("cylinder", "piston"))
        model.rod(low, A, 0.6 * A + 0.4 * B, radius=0.03, mass=0.5)
        model.rod(high, 0.4 * A + 0.6 * B, B, radius=0.02, mass=0.3)
        across = np.cross(B - A, (0.0, 0.0, 1.0))
        model.universal("ground", low, at=A, axes=(across, np.cross(B - A, across)))
        leg = model.prismatic(low, high, at=A, axis=B - A)
        model.spherical(high, plate, at=B)
        model.axial_spring(leg, stiffness=80.0 + 10.0 * k, damping=1.0)
        model.motor(leg, lambda t, k=k: 6.0 + np.sin(4.0 * t + k))
    problem = model.problem()
    assert problem.freedom.degrees == 6 and not problem.freedom.redundant
    result = agreed(problem, 0.2)
    assert np.abs(result.q[:7, -1] - result.q[:7, 0]).max() > 0.01


def test_a_delta_robot():
    """R. Clavel's robot as in M. Zavatsky's tutorial, Delta robot kinematics (Trossen Robotics' forum, 2009).

    Sides of the triangles 457.3 and 115 mm, arms 112 and 232 mm; compared with copies of its code in other programs.
    """
    f, e, arm, rod = 0.4573, 0.115, 0.112, 0.232
    out, near = f / (2.0 * np.sqrt(3.0)), e / (2.0 * np.sqrt(3.0))
    knee = out + arm * np.cos(0.4)
    z = -arm * np.sin(0.4) - np.sqrt(rod**2 - (knee - near) ** 2)
    model = SpatialModel(name="delta")
    plate = model.body("plate", mass=0.3, inertia=(1e-3, 1e-3, 2e-3), position=(0.0, 0.0, z))
    for k in range(3):
        turn = 2.0 * np.pi * k / 3.0
        R = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
        hip, elbow = R @ (out, 0.0, 0.0), R @ (knee, 0.0, -arm * np.sin(0.4))
        model.rod(f"arm {k}", hip, elbow, radius=0.01, mass=0.2)
        pivot = model.revolute("ground", f"arm {k}", at=hip, axis=R @ (0.0, 1.0, 0.0))
        for side in (-0.03, 0.03):
            across = R @ (0.0, side, 0.0)
            model.distance(f"arm {k}", elbow + across, plate, R @ (near, 0.0, z) + across)
        model.torsion_spring(pivot, stiffness=2.0, damping=0.01)
        model.motor(pivot, lambda t, k=k: -0.4 + 0.3 * np.sin(6.0 * t + 2.0 * k))
    problem = model.problem()
    assert problem.freedom.degrees == 3
    result = agreed(problem, 0.5)
    np.testing.assert_allclose(result.q[3:7], np.repeat([[1.0], [0.0], [0.0], [0.0]], 9, axis=1), atol=1e-9)
    assert np.ptp(result.q[:3], axis=1).max() > 0.01


# Agility Robotics' Cassie by the Dynamic Robotics Laboratory of Oregon State University, cassie-mujoco-sim,
# model/cassie.xml, without armatures, limits and the damping of its ball: parent, place, axes x and y; joint, damping
# and stiffness; centre of mass, mass, moments xx, yy, zz, xy, xz, yz
CASSIE = {
    "hip-roll": (
        *("pelvis", "0.021 0.135 0", "0 0 -1 0 1 0", "hinge", 1.0, 0.0, "-0.01793 0.0001 -0.04428", 1.82),
        "0.003431 0.003793 0.002135 -6.65e-07 -0.00084 3.99e-06",
    ),
    "hip-yaw": (
        *("hip-roll", "0 0 -0.07", "0 0 1 0 1 0", "hinge", 1.0, 0.0, "0 -1e-05 -0.034277", 1.171),
        "0.002443 0.002803 0.000842 -4e-08 2.462e-07 -2.71e-08",
    ),
    "hip-pitch": (
        *("hip-yaw", "0 0 -0.09", "0 0 -1 1 0 0", "hinge", 1.0, 0.0, "0.05946 5e-05 -0.03581", 5.52),
        "0.010898 0.029714 0.030257 -0.0002669 -5.721e-05 9.17e-06",
    ),
    "achilles-rod": (
        *("hip-pitch", "0 0 0.045", "0.7922 -0.60599 -0.072096 0.60349 0.79547 -0.054922", "ball", 0.0, 0.0),
        *("0.24719 0 0", 0.1567, "3.754e-06 0.004487 0.004488 -3.74e-08 -1.61e-08 0"),
    ),
    "knee": (
        *("hip-pitch", "0.12 0 0.0045", "0.70711 -0.70711 0 0.70711 0.70711 0", "hinge", 1.0, 0.0),
        *("0.023 0.03207 -0.002181", 0.7578, "0.001376 0.0010335 0.0021637 -0.00039744 -4.085e-05 -5.374e-05"),
    ),
    "knee-spring": (
        *("knee", "0.06068 0.08241 0", "1 0 0 0 1 0", "", 0.0, 0.0, "0.0836 0.0034 0", 0.186),
        "5.215e-05 0.00041205 0.0003669 6.87e-06 0 0",
    ),
    "shin": (
        *("knee", "0.06068 0.04741 0", "1 0 0 0 1 0", "hinge", 0.1, 1500.0, "0.18338 0.001169 0.0002123", 0.577),
        "0.00035939 0.014728 0.014707 -0.00020981 2.266e-05 -1.2e-07",
    ),
    "tarsus": (
        *("shin", "0.43476 0.02 0", "0.52992 0.84805 0 -0.84805 0.52992 0", "hinge", 0.1, 0.0),
        *("0.11046 -0.03058 -0.00131", 0.782, "0.00039238 0.013595 0.013674 0.00023651 -4.987e-05 -4.82e-06"),
    ),
    "heel-spring": (
        *("tarsus", "-0.01269 -0.03059 0.00092", "-0.91211 0.40829 0.036948 -0.40992 -0.90952 -0.068841", "hinge"),
        *(0.0, 1250.0, "0.081 0.0022 0", 0.126, "2.959e-05 0.00022231 0.0002007 7.15e-06 -6e-07 1e-07"),
    ),
    "foot-crank": (
        *("tarsus", "0.058 -0.034 0.02275", "1 0 0 0 1 0", "hinge", 1.0, 0.0, "0.00493 2e-05 -0.00215", 0.1261),
        "2.6941e-05 4.9621e-05 6.3362e-05 -2.1e-09 -3.9623e-06 -1.09e-08",
    ),
    "plantar-rod": (
        *("foot-crank", "0.055 0 -0.00791", "1 0 0 0 1 0", "hinge", 0.0, 0.0, "0.17792 0 0", 0.1186),
        "2.779e-06 0.001774 0.001775 -2.34e-08 -8.1e-09 0",
    ),
    "foot": (
        *("tarsus", "0.408 -0.04 0", "1 0 0 0 1 0", "hinge", 1.0, 0.0, "0.00474 0.02748 -0.00014", 0.1498),
        "0.00017388 0.00016793 0.00033261 0.00011814 1.36e-06 -4e-07",
    ),
}


def test_cassies_leg(tmp_path):
    """Its pelvis is held; of eight freedoms five have motors, two have springs, and a rod turns about itself."""
    bodies = {"pelvis": ET.Element("body", name="pelvis", pos="0 0 1.01")}
    for name, (parent, place, axes, joint, damping, stiffness, centre, mass, moments) in CASSIE.items():
        body = bodies[name] = ET.SubElement(bodies[parent], "body", name=name, pos=place, xyaxes=axes)
        ET.SubElement(body, "inertial", pos=centre, mass=str(mass), fullinertia=moments)
        if joint:
            ET.SubElement(body, "joint", type=joint, damping=str(damping), stiffness=str(stiffness))
    root = ET.Element("mujoco", model="Cassie's leg")
    ET.SubElement(root, "worldbody").append(bodies["pelvis"])
    loops = ET.SubElement(root, "equality")
    ET.SubElement(loops, "connect", body1="plantar-rod", body2="foot", anchor="0.35012 0 0")
    ET.SubElement(loops, "connect", body1="achilles-rod", body2="heel-spring", anchor="0.5012 0 0")
    ET.ElementTree(root).write(tmp_path / "leg.xml")
    model = from_mjcf(tmp_path / "leg.xml")
    problem = model.problem()
    assert problem.freedom.degrees == 8 and not model.ignored
    result = agreed(problem, 0.1)
    foot = next(body for body in model.bodies if body.name == "foot")
    assert np.abs(np.diff(result.q[list(foot.coordinates[:3])][:, [0, -1]])).max() > 0.01


def test_bennetts_linkage():
    """G. T. Bennett (1903): four hinges in space whose links have a / sin(alpha) alike: it moves."""
    a, alpha = 0.5, 0.6
    b = 0.8
    beta = np.arcsin(b / a * np.sin(alpha))
    lengths, twists = (a, b, a, b), (alpha, beta, alpha, beta)
    first = 1.1
    second = 2.0 * np.arctan(np.sin(0.5 * (beta + alpha)) / (np.sin(0.5 * (beta - alpha)) * np.tan(0.5 * first)))
    frames = [(np.eye(3), np.zeros(3))]
    for length, twist, angle in zip(lengths, twists, (first, second, -first, -second), strict=True):
        R, x = frames[-1]
        s, c = np.sin(angle), np.cos(angle)
        R = R @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        x = x + R @ (length, 0.0, 0.0)
        s, c = np.sin(twist), np.cos(twist)
        frames.append((R @ np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]), x))
    np.testing.assert_allclose(frames[-1][1], 0.0, atol=1e-12)  # it closes
    np.testing.assert_allclose(frames[-1][0], np.eye(3), atol=1e-12)
    model = SpatialModel(name="Bennett")
    names = ("base", "one", "two", "three")
    for name, (_, x), (_, y) in zip(names[1:], frames[1:], frames[2:], strict=False):
        model.rod(name, x, y, radius=0.03, mass=0.5)
    for k, (R, x) in enumerate(frames[:4]):
        ends = [names[(k + 3) % 4], names[k]]
        a_name, b_name = ("ground" if each == "base" else each for each in ends)
        model.revolute(a_name, b_name, at=x, axis=R[:, 2])
    problem = model.problem()
    assert problem.freedom.degrees == 1 and problem.freedom.redundant
    agreed(problem, 1.0)


@pytest.mark.slow  # as is Bennett's, which is not
def test_a_sarrus_linkage_moves_on_a_line():
    """P.-F. Sarrus (1853): two pairs of plates on hinges in two directions; a table rises without turning."""
    model = SpatialModel(name="Sarrus")
    table = model.body("table", mass=1.0, inertia=(0.02, 0.02, 0.04), position=(0.0, 0.0, 0.8))
    for name, out, axis in (("x", (0.5, 0.0), (0.0, 1.0, 0.0)), ("y", (0.0, 0.5), (1.0, 0.0, 0.0))):
        low, high = np.array([*out, 0.0]), np.array([*out, 0.8])
        middle = np.array([1.6 * out[0], 1.6 * out[1], 0.4])
        model.rod(f"lower {name}", low, middle, radius=0.05, mass=0.4)
        model.rod(f"upper {name}", middle, high, radius=0.05, mass=0.4)
        model.revolute("ground", f"lower {name}", at=low, axis=axis)
        model.revolute(f"lower {name}", f"upper {name}", at=middle, axis=axis)
        model.revolute(f"upper {name}", table, at=high, axis=axis)
    problem = model.problem()
    assert problem.freedom.degrees == 1 and problem.freedom.redundant
    result = agreed(problem, 0.3)
    still = np.delete(result.q[:7], 2, axis=0)
    np.testing.assert_allclose(still, np.repeat([[0.0], [0.0], [1.0], [0.0], [0.0], [0.0]], 9, axis=1), atol=1e-10)
    assert np.ptp(result.q[2]) > 0.05
