"""Define the layout of the parameter vector of a model, for kernels, tables and energies.

The vector p holds the named parameters (gravity, masses, positions of joints, stiffnesses, ...), then unnamed constants
(directions), the integer tables of joints and forces, the programs of motions and forces, and finally a head with the
offsets of all of these. Tables refer to numbers by their index in p.
"""

# offsets in the head, which begins at p.size - HEAD
BODIES, JOINTS, N_JOINTS, FORCES, N_FORCES, MOTION_PROGRAM, FORCE_PROGRAM = range(7)
HEAD = 7
NONE = -1  # no program, function or number; as a body: the ground

# A row of the table of joints: kind, row of C, body i, index of its numbers, body j, index of its numbers, index of
# further numbers, index of its first result in the program of motions. A motion has three results: value, rate and
# acceleration. A ROW_FUNCTION has C, C_t and gamma, then the derivatives with respect to the coordinates that the
# further numbers count and list. A RATE_FUNCTION is a row of A: its results are Q_a and the entries of the row.
KIND, ROW, FIRST, FIRST_AT, SECOND, SECOND_AT, MORE, MOTION, JOINT_WIDTH = range(9)
# A row of the table of forces: kind, body i, index, body j, index, further numbers, first result of the program, and,
# for a spring along an axis of i, the index of its point on i.
F_KIND, F_FIRST, F_FIRST_AT, F_SECOND, F_SECOND_AT, F_MORE, F_RESULT, F_ON_FIRST, FORCE_WIDTH = range(9)

# kinds of joint rows in the plane ...
PIN, ACROSS, ALONG, ANGLE, DISTANCE, ROW_FUNCTION, RATE_FUNCTION = range(7)
# ... and in space, where a row may be a function as well
POINT, PERPENDICULAR, PLANE, LENGTH, ANGLE_DRIVE = range(5)
# kinds of forces in both: between two points; in a hinge, on a body; about and along an axis of body i
SPRING, ZERO_LENGTH_SPRING, TORSION_SPRING, FORCE, TORQUE = range(5)
AXIAL_TORQUE, AXIAL_FORCE, AXIAL_SPRING, HINGE_FRICTION, AXIAL_FRICTION = range(5, 10)
# inertias of rotors, which add to the mass matrix, see `rotors`
HINGE_ROTOR, SLIDE_ROTOR = range(10, 12)

PLANAR_BODY, SPATIAL_BODY = 2, 7  # numbers of a body: mass, moment of inertia; mass, J_xx, J_yy, J_zz, J_xy, J_xz, J_yz
