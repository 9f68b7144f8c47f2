"""Define the layout of the parameter vector of a model, for kernels, tables and energies.

The vector p holds the named parameters (gravity, masses, positions of joints, stiffnesses, ...), then unnamed constants
(directions), the integer tables of joints and forces, the programs of motions and forces, and finally a head with the
offsets of all of these. Tables refer to numbers by their index in p.
"""

# offsets in the head, which begins at p.size - HEAD
BODIES, JOINTS, N_JOINTS, FORCES, N_FORCES, MOTION_PROGRAM, FORCE_PROGRAM, COORDINATES = range(8)
HEAD = 8
NONE = -1  # no program, function or number; as a body: the ground

# A row of the table of joints: kind, row of C, body i, index of its numbers, body j, index of its numbers, index of
# further numbers, index of its first result in the program of motions. A motion has three results: value, rate and
# acceleration. A ROW_FUNCTION has C, C_t and gamma, then one derivative for each coordinate in the further numbers
# (their count, then a list). A RATE_FUNCTION is a row of A: its results are Q_a and the entries of the row.
KIND, ROW, FIRST, FIRST_AT, SECOND, SECOND_AT, MORE, MOTION, JOINT_WIDTH = range(9)
# A row of the table of forces: kind, body i, index, body j, index, further numbers, first result of the program, and,
# for a spring along an axis of i, the index of its point on i.
F_KIND, F_FIRST, F_FIRST_AT, F_SECOND, F_SECOND_AT, F_MORE, F_RESULT, F_ON_FIRST, FORCE_WIDTH = range(9)

# Kinds of joint rows. A direction is three numbers in space, and the angle from the x axis of its body in the plane.
POINT = 0  # a point of i and a point of j coincide: two rows in the plane, three in space
ALONG = 1  # displacement of a point of j from a point of i along a direction of i (further numbers), minus the motion
ACROSS = 2  # in the plane: displacement of a point of j from a point of i perpendicular to a direction of i
LENGTH = 3  # distance of two points
ANGLE = 4  # in the plane: angle of j relative to i, minus a number and the motion
PERPENDICULAR = 5  # a direction of i is perpendicular to a direction of j
ANGLE_DRIVE = 6  # as PERPENDICULAR, with a direction that rotates on i by the motion, from one direction to another
ROW_FUNCTION, RATE_FUNCTION = 7, 8  # any function of the coordinates, or linear in the velocities

# Kinds of forces: first between two points, in a planar hinge, on a body; then about and along an axis of body i
SPRING, ZERO_LENGTH_SPRING, TORSION_SPRING, FORCE, TORQUE = range(5)
AXIAL_TORQUE, AXIAL_FORCE, AXIAL_SPRING, HINGE_FRICTION, AXIAL_FRICTION = range(5, 10)
# inertias of rotors, which contribute to the mass matrix, see rotors.py
HINGE_ROTOR, SLIDE_ROTOR = range(10, 12)

PLANAR_BODY, SPATIAL_BODY = 2, 7  # numbers of a body: mass, moment of inertia; mass, J_xx, J_yy, J_zz, J_xy, J_xz, J_yz
