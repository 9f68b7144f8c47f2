"""Mistakes with models of bodies and joints."""

import numpy as np

from tests.bad_input.case import Case, cases_of
from twoloop.bodies import PlanarModel, SpatialModel, from_mjcf, from_urdf

GROUP = "bodies.PlanarModel"
of_planar = cases_of(GROUP)
of_spatial = cases_of("bodies.SpatialModel")
of_problem = cases_of("bodies: problem")
of_files = cases_of("bodies: files")
NAMES = "give the body that body(...) returned, or its name"


def loaded(coefficient=0.2, twice=False, **friction):
    """A cart on a guide with friction in proportion to its load, and a rod that swings on it."""
    model = PlanarModel(name="cart")
    model.body("cart", mass=1.0, inertia=1.0, position=(0.0, 0.0), velocity=(1.0, 0.0))
    model.body("rod", mass=1.0, inertia=0.1, position=(0.5, 0.5), velocity=(1.0, 0.0))
    guide = model.prismatic("ground", "cart", at=(0.0, 0.0), axis=(1.0, 0.0))
    model.revolute("cart", "rod", at=(0.0, 0.0))
    if twice:
        model.prismatic("ground", "cart", at=(1.0, 0.0), axis=(1.0, 0.0))
    model.friction(guide, coefficient=coefficient, speed=0.1, **friction)
    return model.problem()


def planar():
    """A bar on a pin, and a block."""
    model = PlanarModel(name="press")
    model.body("bar", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    model.body("block", mass=1.0, inertia=0.1, position=(1.0, 0.0))
    model.revolute("ground", "bar", at=(0.0, 0.0), name="pin")
    return model


def spatial():
    model = SpatialModel()
    model.body("bar", mass=1.0, inertia=(0.1, 0.1, 0.1), position=(0.0, 0.0, 0.0))
    return model


def body(**changed):
    given = {"name": "arm", "mass": 1.0, "inertia": 0.1, "position": (0.0, 0.0), **changed}
    return lambda: planar().body(**given)


def solid(**changed):
    given = {"mass": 1.0, "inertia": (0.1, 0.1, 0.1), "position": (0.0, 0.0, 0.0), **changed}
    return lambda: spatial().body("arm", **given)


def drive(motion, **more):
    return lambda: planar().drive("pin", motion, **more)


def rough(distance, bend=0.3):
    """Two bars of 1 m that are to reach a point of the ground."""
    model = PlanarModel(name="arms")
    one = model.body("one", mass=1.0, inertia=0.1, position=(0.45, 0.2), angle=bend)
    two = model.body("two", mass=1.0, inertia=0.1, position=(1.4, 0.2), angle=-bend)
    ground = model.ground
    model.revolute(ground, one, at=(ground.point(0.0, 0.0), one.point(-0.5, 0.0)))
    model.revolute(one, two, at=(one.point(0.5, 0.0), two.point(-0.5, 0.0)))
    model.revolute(two, ground, at=(two.point(0.5, 0.0), ground.point(distance, 0.0)), name="end")
    return model


def locked():
    """A bar on two pins that is to turn."""
    model = PlanarModel(name="truss")
    model.body("bar", mass=1.0, inertia=0.1, position=(0.5, 0.0), angular_velocity=2.0)
    for x in (0.0, 1.0):
        model.revolute("ground", "bar", at=(x, 0.0))
    return model.problem()


def sideways():
    """A sledge that is to slip."""
    model = PlanarModel(name="ice")
    model.body("sledge", mass=1.0, inertia=0.1, position=(0.0, 0.0), velocity=(0.0, 1.0))
    model.skate("sledge", at=(0.0, 0.0), axis=(1.0, 0.0))
    return model.problem()


def limited():
    model = planar()
    model.limit(model.prismatic("ground", "block", at=(1.0, 0.0), axis=(1.0, 0.0), name="slide"), upper=1.0)
    return model.problem()


def two_drives():
    model = planar()
    model.drive("pin", lambda t: t)
    model.drive("pin", lambda t: 2.0 * t)
    return model.problem()


def hinged():
    model = spatial()
    model.revolute("ground", "bar", at=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0), name="hinge")
    return model


def particle():
    model = planar()
    model.particle("bob", mass=1.0, position=(2.0, 0.0))
    return model


def sleeve():
    model = spatial()
    model.cylindrical("ground", "bar", at=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0), name="sleeve")
    return model


def loop(*points):
    """A loop of bars between points of the ground, on pins A, B, C, ..."""
    model, last = PlanarModel(name="loop"), len(points) - 1
    for k in range(last):
        model.rod(f"bar {k}", points[k], points[k + 1], mass=1.0)
        model.revolute(f"bar {k - 1}" if k else "ground", f"bar {k}", at=points[k], name="ABCDE"[k])
    model.revolute(f"bar {last - 1}", "ground", at=points[last], name="ABCDE"[last])
    return model


def four_bar(positions=None, rates=None):
    return loop((0, 0), (0, 1), (2, 1.5), (2.5, 0)).problem(positions=positions, rates=rates)


def five_bar(positions):
    return loop((0, 0), (0, 1), (1, 1.8), (2, 1), (2, 0)).problem(positions=positions)


def point_of_another():
    model = planar()
    return model.revolute("bar", "block", at=(model.bodies[1].point(0.0, 0.0), model.bodies[1].point(0.0, 0.0)))


BODIES: list[Case] = [
    of_planar("a name twice", body(name="bar"), "'bar' is already taken by a body", "give each part its own name"),
    of_planar("`name=''`", body(name=""), "name must not be empty", "give a name"),
    of_planar("`name=3`", body(name=3), "name must be a string; given 3", "give text", TypeError),
    of_planar("`mass=-1`", body(mass=-1), "mass of 'arm' must be positive", "give a positive mass"),
    of_planar("`mass=0`", body(mass=0), "mass of 'arm' must be positive", "give a positive mass; for a massless rod use distance(...)"),
    of_planar("`mass='1'`", body(mass="1"), "mass of 'arm' must be a number", "give a number", TypeError),
    of_planar("`mass=nan`", body(mass=np.nan), "mass of 'arm' must be positive", "find out where the NaN comes from"),
    of_planar("`inertia=0`", body(inertia=0.0), "inertia of 'arm' must be positive", "give the moment about the centre"),
    of_planar("a position in space", body(position=(0, 0, 0)), r"position of 'arm' must have shape \(2,\)", "give x and y"),
    of_planar("`angle=inf`", body(angle=np.inf), "angle of 'arm' must be finite", "give radians"),
    of_planar("`gravity=9.81`", lambda: PlanarModel(9.81), r"gravity must have shape \(2,\)", "give a vector"),
    of_planar("an unknown body", lambda: planar().revolute("bar", "blok", at=(0, 0))).says("b must be a body of this model, 'ground', 'bar', 'block'; given 'blok'", NAMES),
    of_planar("a body of another model", lambda: planar().revolute("bar", planar().bodies[1], at=(0, 0))).says("'block' belongs to another", NAMES),
    of_planar("a number for a body", lambda: planar().revolute(0, "bar", at=(0, 0)), "a must be a body", NAMES, TypeError),
    of_planar("a joint of a body with itself", lambda: planar().revolute("bar", "bar", at=(0, 0))).says("a and b of a revolute joint must be two bodies; given 'bar' twice", "give two bodies"),
    of_planar("a joint without a point", lambda: planar().revolute("bar", "block", at=None)).says("at must be an array of real numbers; given None", "give a point in space, or one of each body", TypeError),
    of_planar("an axis of length zero", lambda: planar().prismatic("bar", "block", at=(0, 0), axis=(0, 0))).says("axis must have a direction", "give a vector other than zero"),
    of_planar("a point on another body", point_of_another).says("must be a point on 'bar'; given one on 'block'", "the first point is one of a, the second one of b"),
    of_planar("a single point of a body").when(lambda: (model := planar()).revolute("bar", "block", at=model.bodies[0].point(0.0, 0.0))).says("at must be a point in space, or a pair of points", "give a point of each body", TypeError),
    of_planar("the radius of a pin for friction on a guide", lambda: loaded(radius=0.1)).says("radius is that of the pin of a revolute joint whose friction has a coefficient; given radius=0.1", "leave it out; a pin needs one where its friction has a coefficient"),
    of_planar("friction in proportion to a load that two joints share", lambda: loaded(twice=True)).says("depends on the load of its joint, which is not determined: the rows of", "make one of them a slot (a distance, or a point on a curve), or give the friction as a number"),
    of_planar("friction so large that a joint may jam", lambda: loaded(coefficient=50.0)).says("cannot be computed at the start: the coefficients are so large that a joint may jam", "give a smaller coefficient: self-locking has no smooth law"),
    of_planar("a distance of points that coincide", lambda: planar().distance("bar", (1, 0), "block", (1, 0))).says("coincide in the position given", "give a length, or take a revolute joint"),
    of_planar("a negative stiffness", lambda: planar().spring("bar", (0, 0), "block", (1, 0), stiffness=-1.0)).says("stiffness must not be negative; given -1.0", "give N/m; for a force that pushes away, force(...)"),
    of_planar("a spring with neither a stiffness nor a function", lambda: planar().spring("bar", (0, 0), "block", (1, 0))).says("give either stiffness, with damping and what is unstressed, or a function", "give N/m, or force=f with f(length, rate)", TypeError),
    of_planar("a spring as a function of t, q and v").when(lambda: planar().spring("bar", (0, 0), "block", (1, 0), force=lambda t, q, v: 1.0)).says(r"is called as \(length, rate\)", "take length and rate, or use force(...)", TypeError),
    of_planar("a damper without a length").when(lambda: planar().spring("bar", (0, 0), "block", (1, 0), stiffness=1.0, damping=1.0, length=0.0)).says("has no direction where its points meet", "give a length, or the damper as a force"),
    of_planar("a force on the ground", lambda: planar().force("ground", (0, 0), (1.0, 0.0))).says("body must be a body that moves; given the ground", "leave it out, or let it act on a body"),
    of_planar("a force of three components", lambda: planar().force("bar", (0, 0), (1, 0, 0))).says("f of 'force on bar' must be 2 finite numbers", "give x and y"),
    of_planar("a force of t and q", lambda: planar().force("bar", (0, 0), lambda t, q: (1.0, 0.0))).says(r"is called as \(t\) or \(t, q, v\); the function given takes 2 arguments", "take t, q and v", TypeError),
    of_planar("a function that returns another shape").when(lambda: (m := planar(), m.force("bar", (0, 0), lambda t: 1.0), m.problem())).says("must return shape", "return one number for each component"),
    of_planar("an unknown joint", lambda: planar().motor("pins", 1.0)).says("joint must be one of this model, 'pin'", "give its name"),
    of_planar("a joint of another model", lambda: planar().motor(planar().joints[0], 1.0)).says("'pin' belongs to another", "give a joint of the same model"),
    of_planar("a motor in a distance").when(lambda: (m := planar()).motor(m.distance("bar", (0, 0), "block", (1, 0)), 1.0)).says("motor needs a revolute or prismatic joint; given 'distance bar-block', which is distance", "let a force or a spring act between the points"),
    of_planar("limits the wrong way round", lambda: planar().limit("pin", lower=1.0, upper=0.5)).says("lower of the limit of 'pin' must be below upper; given 1.0, 0.5", "exchange them"),
    of_planar("a force that is NaN").when(lambda: (m := planar(), m.force("bar", (0, 0), lambda t: (np.nan, 0.0)), m.problem())).says(r"f of 'force on bar' must be finite at the start; at t = 0 it gives array\(\[nan", "find out where the NaN comes from"),
    of_planar("a force that has no value at rest").when(lambda: (m := planar(), m.torque("bar", lambda t, q, v: -v[2] / abs(v[2])), m.problem())).says("f of 'torque on bar' must be finite at the start; .* divisions by zero", "friction(...) is a smooth law; or give velocities"),
    of_planar("a force of coordinates that the model does not have").when(lambda: (m := planar(), m.force("bar", (0, 0), lambda t, q, v: (q[17], 0.0)), m.problem())).says("index 17 is out of bounds", "`body.coordinates` are those of a body", IndexError),
    of_planar("a spring whose points coincide").when(lambda: (m := planar(), m.spring("bar", (0, 0), "ground", (0, 0), stiffness=1.0, length=0.1), m.problem())).says("the points of the spring 'spring bar-ground' coincide at the start", "move a point, or give `length=0`"),
    of_planar("a negative damping", lambda: planar().torsion_spring("pin", stiffness=1.0, damping=-0.1)).says("damping must not be negative; given -0.1", "for a driving torque use motor(...)"),
    of_planar("a drive of a drive", lambda: (m := planar()).drive(m.drive("pin", lambda t: t), lambda t: t)).says("drive needs a revolute or prismatic joint; given 'drive of pin', which is drive", "drive the joint once"),
    of_planar("a drive that is not finite").when(lambda: (m := planar(), m.drive("pin", lambda t: np.sqrt(t)), m.problem())).says("motion of 'drive of pin' must be finite at the start", "its rate is infinite there: give a motion that begins smoothly"),
    of_planar("a number for a motion", drive(1.0), "must be a function of t", "give lambda t: ...", TypeError),
    of_planar("a motion that branches", drive(lambda t: 0.0 if t < 1.0 else t)).says("cannot be differentiated exactly.*give rate= and acceleration=", "give its derivatives, or write it without branches"),
    of_planar("`rate` without `acceleration`", drive(lambda t: t, rate=lambda t: 1.0)).says("rate and acceleration .* go together", "give both, or none", TypeError),
    of_spatial("an inertia that is not positive", solid(inertia=(1.0, 1.0, 0.0))).says("inertia of 'arm' must be symmetric and positive definite", "give a thin rod a small moment about its axis"),
    of_spatial("an inertia of two numbers", solid(inertia=(1.0, 1.0)), "must be three finite moments", "give J or its diagonal"),
    of_spatial("a rotation that is none", solid(rotation=np.ones((3, 3)))).says(r"rotation of 'arm' must be a rotation matrix \(3, 3\)", "columns are the axes of the body, right-handed"),
    of_spatial("a rotation of NaN", solid(rotation=np.full((3, 3), np.nan))).says(r"rotation of 'arm' must be a rotation matrix \(3, 3\)", "find out where the NaN comes from"),
    of_spatial("a wheel that lies flat", lambda: spatial().rolling("bar", radius=0.5, axis=(0, 0, 1))).says("axis of 'rolling bar' must not be across the plane", "the axis is that about which the wheel is round"),
    of_spatial("axes of a universal joint that are not perpendicular").when(lambda: spatial().universal("ground", "bar", at=(0, 0, 0), axes=((1, 0, 0), (1, 1, 0)))).says("axes of 'universal bar-ground' must be perpendicular", "give the two axes of the cross"),
    of_spatial("`to_mjcf(3)`", lambda: spatial().to_mjcf(3)).says("path must be a file name or a path; given 3", "give the name of a file", TypeError),
    of_files("`from_mjcf(3)`", lambda: from_mjcf(3)).says("path must be a file name or a path; given 3", "give the name of a file", TypeError),
    of_files("`from_urdf(None)`", lambda: from_urdf(None)).says("path must be a file name or a path; given None", "give the name of a file", TypeError),
    of_planar("a torque on a particle", lambda: particle().torque("bob", 1.0)).says("a torque on 'bob' has no effect, as a particle does not turn", "let it act on a body"),
    of_planar("a particle fixed to a body", lambda: particle().fixed("bar", "bob")).says("'bob' is a particle, which does not turn: a fixed joint would keep 'bar' from turning", "use revolute(...), or add the mass to the body"),
    of_planar("a rope of the ground alone", lambda: planar().rope([("ground", (0, 0)), ("ground", (1, 0))])).says("points of a rope must be on a body that moves", "put an end on a body"),
    of_planar("a rope of one point", lambda: planar().rope([("bar", (0, 0))])).says("points must be a list of two or more pairs", "give [(body, point), ...]", TypeError),
    of_planar("a rope of points alone", lambda: planar().rope([(0, 0), (1, 0)])).says(r"points\[0\] must be a body", "give [(body, point), ...]", TypeError),
    of_planar("a rope whose points coincide", lambda: planar().rope([("bar", (1, 0)), ("block", (1, 0))])).says("neighbouring points of 'rope bar-block' coincide", "leave one out"),
    of_planar("a rope that is too short", lambda: planar().rope([("bar", (0, 0)), ("bar", (1, 0)), ("block", (2, 0))], length=0.5)).says("length of 'rope bar-block' must exceed the 1 m between points of the same body", "give more"),
    of_planar("a winch without a radius", lambda: planar().rope([("ground", (0, 0)), ("block", (1, 0))], winch="pin")).says("winch and radius go together", "give both, or neither", TypeError),
    of_planar("a drum of radius zero", lambda: planar().rope([("ground", (0, 0)), ("block", (1, 0))], winch="pin", radius=0.0)).says("radius of the drum must not be zero", "leave winch and radius out"),
    of_planar("a coupling of one name", lambda: planar().coupling("pin", lambda x: x)).says("joints must be a list of joints or their names", "give a list", TypeError),
    of_planar("a coupling without a function", lambda: planar().coupling(["pin"], 2.0)).says("function must be a function of 1 coordinates", "give lambda x, y: y - 2.0 * x", TypeError),
    of_planar("a coupling that branches", lambda: planar().coupling(["pin"], lambda x: x if x > 0.0 else 2.0 * x)).says("must be made of numpy's functions, without branches", "give a smooth function"),
    of_problem("the forces of actuators without a drive", lambda: planar().problem().actuator_forces(None, ["pin"])).says("has no drive: prescribe the motion with drive", "drive what is to move as you want"),
    of_spatial("a screw without a pitch", lambda: spatial().screw("ground", "bar", at=(0, 0, 0), axis=(0, 0, 1), pitch=0.0)).says("pitch must not be zero", "use revolute(...)"),
    of_spatial("a motor in a sleeve", lambda: sleeve().motor("sleeve", 1.0)).says("'sleeve', which is cylindrical, has an angle and a displacement: say which", 'give coordinate="angle"'),
    of_spatial("a curve of three values", lambda: spatial().point_on_curve("ground", "bar", at=(0, 0, 0), curve=lambda x, y, z: (x, y, z))).says("must return two values for a curve, or one for a surface; it returned 3", "use spherical(...) for a point"),
    of_spatial("`curve=3`", lambda: spatial().point_on_curve("ground", "bar", at=(0, 0, 0), curve=3)).says("must be a function of x, y and z", "give lambda x, y, z: ...", TypeError),
    of_problem("a model without bodies", lambda: PlanarModel().problem(), "has no bodies", "add bodies first"),
    of_problem("a loop that cannot close", lambda: rough(2.3).problem()).says(r"cannot be assembled: the joint '.*' does not close: a gap of 0.3 m is left in its loop of '.*', '.*' by", "look at the lengths around the loop"),
    of_problem("a velocity that joints do not allow", locked).says("do not allow the velocities given: the rate of angle of bar is given as 2", "give velocities of fewer bodies"),
    of_problem("a velocity across a skate", sideways).says("do not allow the velocities given: the rate of y of sledge is given as 1", "give one along the blade"),
    of_problem("two drives that contradict", two_drives, "the motion is over-constrained", "leave one of them out"),
    of_problem("a position that a loop does not permit", lambda: four_bar({"A": 1.0, "D": 0.2})).says("do not permit 0.2 rad as the angle of D together with those of 'A'; the nearest value found is", "give one of them: the other follows"),
    of_problem("a position of one of two cranks", lambda: five_bar({"A": 0.1})).says("do not determine the joint 'D', which has to move with those given", "give the other crank, too"),
    of_problem("rates that do not agree", lambda: four_bar(rates={"A": 1.0, "D": 0.2})).says("do not permit 0.2 rad/s as the rate of the angle of D together", "give one of them"),
    of_problem("a rate beside the velocity of the body", lambda: (m := planar(), m.body("arm", mass=1.0, inertia=1.0, position=(0, 0), angular_velocity=2.0), m.revolute("ground", "arm", at=(0, 0), name="j"), m.problem(rates={"j": 1.0}))).says(
        "do not agree with the velocities given with its bodies", "give one of both"
    ),
    of_problem("`positions=1.0`", lambda: planar().problem(positions=1.0), "positions must be a mapping from joints", "give {joint: value}", TypeError),
    of_problem("the position of a distance").when(lambda: (m := planar(), m.problem(positions={m.distance("bar", (0, 0), "block", (1, 0)): 1.0}))).says("positions needs a revolute or prismatic joint", "give those of joints with a coordinate"),
    of_problem("a position after two turns in space", lambda: hinged().problem(positions={"hinge": 13.0})).says("must be within 0.95 of a turn", "give the position within the turn"),
    of_problem("the displacement of a hinge", lambda: hinged().joint_coordinate("hinge", "displacement")).says("'hinge', which is revolute, has the coordinate \"angle\"", "leave it out"),
    of_problem("the coordinate of an unknown joint", lambda: hinged().problem().joint_coordinate("hing")).says("joint must be one of 'spatial model' that has a coordinate, 'hinge'; given 'hing'", "give its name"),
    of_problem("a coordinate of a sleeve", lambda: sleeve().problem().joint_coordinate("sleeve")).says("has an angle and a displacement: say which", "give one of both"),
    of_problem("`energy` of rows", lambda: rough(1.9).problem().energy(0.0, np.zeros((9, 6)), np.zeros((9, 6)))).says(r"q must have shape \(6,\) or \(6, n_t\); given shape \(9, 6\)", "give states as columns: q.T"),
    of_problem("an unknown parameter", lambda: rough(1.9).problem().with_parameters({"mass of three": 1.0})).says("'arms' has no parameter 'mass of three'", "take a name from problem.parameters"),
    of_problem("a mass that becomes negative", lambda: rough(1.9).problem().with_parameters({"mass of two": -1.0})).says("mass of two must be positive", "give a positive mass"),
    of_problem("a damping that becomes negative", lambda: (m := planar(), m.torsion_spring("pin", stiffness=1.0, name="s"))[0].problem().with_parameters({"damping of s": -1.0})).says(r"damping of s \(N m s/rad\) must not be negative; given -1.0", "give zero or more"),
    of_problem("a distance that becomes zero", lambda: (m := planar(), m.distance("bar", (1, 0), "block", (2, 0), name="d"))[0].problem().with_parameters({"length of d": 0.0})).says(r"length of d \(m\) must be positive", "take a revolute joint for points that coincide"),
    of_problem("a length that no longer fits", lambda: rough(1.9).problem().with_parameters({"x of end on ground": 2.5})).says("cannot be assembled", "change other lengths with it"),
    of_problem("another axis of a slide with a limit or a rack", lambda: limited().with_parameters({"angle of slide on ground": 0.1})).says(r"angle of slide on ground \(rad\) cannot change", "make the model anew"),
]
