"""Joints that make no sense, and reactions that cannot be given."""

import numpy as np

from tests.bad_input.case import Case, cases_of, linkage, solve
from tests.bad_input.systems import make
from twoloop import Joint, solve_dae


def joint(what, arguments, error, words, advice):
    return Case("Joint", what, lambda: Joint(*arguments), words, advice, error)


def joints(what, given, error, words, advice):
    return Case("ConstrainedSystem.from_python, joints", what, lambda: make(joints=given), words, advice, error)


def swing(name):
    problem = linkage()
    return solve_dae(problem.system, (0.0, 1e-3), problem.q0, problem.v0).reactions(name)


reactions = cases_of("result.reactions")
ROWS = "name the rows of the joint, counted as in result.lam"
LINK = Joint("link", (0,), (0, 1))
JOINTS = [
    joint("`name=1`", (1, (0,), (0, 1)), TypeError, "name must be a string; given 1", "give a name"),
    joint("`rows=0`", ("a", 0, (0, 1)), TypeError, "rows of the joint 'a' must be a tuple of int; given 0", ROWS),
    joint("`rows=()`", ("a", (), (0, 1)), ValueError, "rows of the joint 'a' must be at least one", ROWS),
    joint("`rows=(0, 0)`", ("a", (0, 0), (0, 1)), ValueError, "must be at least one, none twice", ROWS),
    joint("`rows=(-1,)`", ("a", (-1,), (0, 1)), ValueError, "rows of 'a' must be at least 0; given -1", ROWS),
    joint("`translation=(0,)`", ("a", (0,), (0,)), ValueError, r"must be two coordinates \(planar\) or three \(spatial\); given \(0,\)", "name the coordinates x, y or x, y, z of the body"),
    joint("two angles of a planar body", ("a", (0,), (0, 1), (2, 3)), ValueError, "must be none or one angle, as translation has 2 coordinates", "name the angle alone"),
    joint("three angles of a spatial body", ("a", (0,), (0, 1, 2), (3, 4, 5)), ValueError, "must be none, four Euler parameters or the nine of a matrix", "take Euler parameters or a rotation matrix as coordinates"),
    joint("`point=(0.0,)`", ("a", (0,), (0, 1), (), (0.0,)), ValueError, r"point of 'a' must have shape \(2,\)", "give x and y, spatial ones z too"),
    joint("`in_space=True` without a point", ("a", (0,), (0, 1), (), None, True), ValueError, "in_space of the joint 'a' needs a point", "give the point by its coordinates in space"),
    joint("`in_space=1`", ("a", (0,), (0, 1), (), None, 1), TypeError, "in_space must be True or False", "write True"),
    joints("`joints='link'`", "link", TypeError, "joints must be a list of twoloop.Joint; given 'link'", "give a list"),
    joints("a joint in the place of a list", LINK, TypeError, "joints must be a list", "write [joint]"),
    joints("joints of one name", [LINK, LINK], ValueError, "given 'link' twice", "give each a name of its own"),
    joints("rows that the system does not have", [Joint("a", (1,), (0, 1))], ValueError, r"rows of the joint 'a' must be below n_c \+ n_a = 1; given \(1,\)", ROWS),
    joints("coordinates that the system does not have", [Joint("a", (0,), (0, 1), (2,))], ValueError, "coordinates of the joint 'a' must be below n_q = 2", "name the coordinates of the body"),
    joints("equations of another size", [Joint("a", (0,), (0, 1), equations=np.eye(2))], ValueError, r"must be an invertible matrix of shape \(1, 1\); given shape \(2, 2\)", "give a matrix (n_c + n_a, n_c + n_a)"),
    joints("equations that are not invertible", [Joint("a", (0,), (0, 1), equations=np.zeros((1, 1)))], ValueError, "must be an invertible matrix", "let each of its rows belong to one joint, and none follow from others"),
    reactions("a name that no joint has", lambda: swing("B"), "name must be a joint of 'four-bar': 'O', '1-2', '2-3', 'A'; given 'B'", "give one of those named"),
    reactions("`name=0`", lambda: swing(0), "name must be a string; given 0", "give the name of a joint", TypeError),
    reactions("a system without joints", lambda: solve().reactions("pin"), r"this result has none. Name them in the system, joints=\[twoloop.Joint", "name the joints where the system is made"),
]
