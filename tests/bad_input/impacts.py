"""Stops, samples and couplings that cannot be."""

import numpy as np

from tests.bad_input.case import cases_of
from twoloop import Integrator, Stop, solve_with_friction, solve_with_stops
from twoloop.bodies import PlanarModel, SpatialModel
from twoloop.mechanisms import four_bar

LINKAGE = four_bar()
of_stops, of_step = cases_of("solve_with_stops"), cases_of("Integrator.step")
of_model, of_spatial = cases_of("bodies.PlanarModel"), cases_of("bodies.SpatialModel")
of_friction = cases_of("solve_with_friction")


def against(*stops, **options):
    return lambda: solve_with_stops(LINKAGE.system, (0.0, 1.0), LINKAGE.q0, LINKAGE.v0, list(stops), **options)


def step(dt=1e-3, **options):
    def call():
        integrator = Integrator(LINKAGE.system)
        integrator.start(0.0, LINKAGE.q0, LINKAGE.v0)
        integrator.step(dt, **options)

    return call


def both_wheels(*ratios):
    """A model of two wheels on pins, with gears between them."""
    model = PlanarModel(name="gears")
    for k in range(2):
        model.disc(f"wheel {k}", 0.1, mass=1.0, position=(0.2 * k, 0.0))
        model.revolute("ground", f"wheel {k}", at=(0.2 * k, 0.0), name=f"pin {k}")
    for ratio in ratios:
        model.gear("pin 0", "pin 1", ratio=ratio)
    return model


def wheels(call):
    return lambda: call(both_wheels())


def geared(ratio):
    """Two wheels in space, with a gear."""
    model = SpatialModel()
    for k, name in enumerate("ab"):
        model.sphere(name, 0.1, mass=1.0, position=(0.0, 0.0, k))
        model.revolute("ground", name, at=(0.0, 0.0, k), axis=(0.0, 0.0, 1.0), name=f"pin {name}")
    return lambda: model.gear("pin a", "pin b", ratio=ratio)


def rubs_in_space():
    model = SpatialModel()
    ball = model.sphere("ball", 0.1, mass=1.0, position=(0.0, 0.0, 1.0))
    model.stop(ball, (0.0, 0.0, 0.9), "ground", (0.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0), friction=0.3)


def rubbed(*joints, drive=None, **friction):
    """Of a four-bar with friction in some joints, A, B, C and D."""
    model, points = PlanarModel(name="linkage"), [(0.0, 0.0), (0.0, 1.0), (2.0, 1.5), (2.5, 0.0)]
    for k in range(3):
        model.rod(f"bar {k}", points[k], points[k + 1], mass=1.0)
    bodies = ("ground", "bar 0", "bar 1", "bar 2", "ground")
    for k in range(4):
        model.revolute(bodies[k], bodies[k + 1], at=points[k], name="ABCD"[k])
    for joint in joints:
        model.dry_friction(joint, 1.0, **friction)
    if drive:
        model.drive("A", drive)
    return model.problem()


def branching(x, y):
    return x if x > 0.0 else y


IMPACTS = [
    of_stops("a gap of q alone", lambda: Stop(lambda q: q[0])).says(r"gap of 'stop' is called as gap\(t, q\); the function given takes \(q\)", "take t and q", TypeError),
    of_stops("`slide=1.0`", lambda: Stop(lambda t, q: q[0], slide=1.0)).says("slide of 'stop' must be a function of t and q; given 1.0", "give slide(t, q), or leave it out", TypeError),
    of_stops("no stops", against(), "stops must be a Stop or a list of them", "give at least one, or use `solve_dae`", TypeError),
    of_stops("a function in place of a stop", against(lambda t, q: q[0]), "stops must be a Stop", "write Stop(gap)", TypeError),
    of_stops("a start beyond a stop", against(Stop(lambda t, q: q[8] - 9.0, name="wall"))).says("gaps must not be negative at q0; that of 'wall' is", "change the sign of the gap, or start elsewhere"),
    of_stops("a gap that branches", against(Stop(lambda t, q: q[8] if q[0] > 0.0 else 1.0))).says("gap of 'stop' must be a number computed from t and q by numpy functions", "give one stop for each branch"),
    of_stops("`restitution=1.1`", lambda: Stop(lambda t, q: q[0], 1.1), "restitution of 'stop' must be from 0 to 1", "give a number from 0 to 1"),
    of_stops("an unknown law", against(Stop(lambda t, q: 9.0 - q[8]), law="newton"), "law must be one of 'moreau', 'poisson', 'sequential', or None; given 'newton'", "choose one of them"),
    of_stops("Poisson's law with friction", against(Stop(lambda t, q: 9.0 - q[8], slide=lambda t, q: q[6], friction=0.3), law="poisson"), "law='poisson' is for stops without friction", "choose another law"),
    of_stops("`events=`", against(Stop(lambda t, q: 9.0 - q[8]), events=[]), "no option 'events'", "leave it out", TypeError),
    of_step("a step before a start", lambda: Integrator(LINKAGE.system).step(1e-3)).says("step goes on from a start", "call `start(t0, q0, v0)` first"),
    of_step("`dt=0`", step(0.0), "dt must be positive", "give the length of a sample"),
    of_step("a place that is none", step(inputs={9: 1.0}), "inputs must map places in the parameters", "count from 0"),
    of_step("`inputs=[1.0]` of four", step(inputs=[1.0]), "inputs must be all 4 parameters", "give all, or a mapping"),
    of_step("an input that is not finite", step(inputs={0: np.nan}), "inputs must be finite", "look at the controller"),
    of_step("a length that changes on the way", step(inputs={0: 1.5})).says("inputs must enter forces alone; that at place 0 enters", "`start` anew with other parameters"),
    *(of_step(f"`method={name!r}`", lambda name=name: Integrator(LINKAGE.system, name).start(0.0, LINKAGE.q0, LINKAGE.v0)).says(f"must not be {name!r}", "take the default") for name in ("Taylor", "Lobatto16")),
    of_step("`compiled=True`").when(lambda: Integrator(LINKAGE.system, compiled=True).start(0.0, LINKAGE.q0, LINKAGE.v0)).says("start takes no compiled", "leave it out"),
    of_spatial("friction of a stop in space", rubs_in_space).says("must be zero, as stops rub in the plane only", "leave it out, or make the model in a plane"),
    of_stops("friction without a slide", lambda: Stop(lambda t, q: q[0], friction=0.3)).says("slide of 'stop' must be a function of t and q, as it rubs", "give slide(t, q), the position of the point along the surface", TypeError),
    of_model("a gear of one hinge", wheels(lambda model: model.gear("pin 0", "pin 0", ratio=1.0))).says("a gear needs two joints", "name both joints"),
    of_model("`ratio=0`", wheels(lambda model: model.gear("pin 0", "pin 1", ratio=0.0))).says("ratio must not be zero", "hold the hinge by fixed(...) or a drive"),
    of_spatial("a gear in space whose ratio is none of teeth", geared(np.pi)).says("must be a ratio of whole numbers up to 1000, such as -17 / 43", "give the numbers of teeth"),
    of_model("a rack of two hinges", wheels(lambda model: model.rack("pin 0", "pin 1", radius=0.1))).says("needs a prismatic joint", "give a hinge and a slide"),
    of_model("a wheel of negative radius").when(wheels(lambda model: model.rolling("ground", "wheel 0", radius=-1.0, axis=(1, 0)))).says("radius must be positive", "turn the axis instead"),
    of_model("a curve that branches").when(wheels(lambda model: model.point_on_curve("ground", "wheel 0", at=(0, 0), curve=branching))).says("must be made of numpy's functions, without branches", "write one formula without branches"),
    of_model("a limit without a number", wheels(lambda model: model.limit("pin 0"))).says("needs lower, upper, or both", "give lower, upper, or both"),
    of_friction("a model without dry friction", lambda: solve_with_friction(rubbed())).says("'linkage' has no dry friction: add some with model.dry_friction", "add dry friction, or use `solve_dae`"),
    of_friction("a system in place of a problem", lambda: solve_with_friction(rubbed("A").system)).says("problem must be a model's problem, as returned", "give what `model.problem()` returned", TypeError),
    of_friction("`events=`", lambda: solve_with_friction(rubbed("A"), events=[])).says("solve_with_friction has no option 'events'", "leave it out", TypeError),
    of_friction("`static` below `f`", lambda: rubbed("A", static=0.5)).says("static must be at least f = 1; given 0.5", "leave it out, or give more"),
    of_friction("friction in two joints of a linkage with one degree of freedom").when(lambda: solve_with_friction(rubbed("A", "B"))).says("'dry friction of B' cannot slide by itself.* or its motion depends on 'dry friction of A'", "give one joint all of it"),
    of_friction("friction in a joint that is driven").when(lambda: solve_with_friction(rubbed("A", drive=lambda t: 0.3 * t))).says("'dry friction of A' cannot slide by itself: drives or other joints hold it", "add it to the torque of the drive"),
]
