"""Where numbers stand in the parameters of a model of bodies: kernels, tables and energies read this.

The vector p holds first what has a name (gravity, masses, places of joints, stiffnesses, ...), then numbers without one
(directions), then the tables of whole numbers that say which joint ties which bodies, then programs of motions and
forces, last a head that says where all of these begin. Tables name numbers by their places in p.
"""

# the head, counted from its beginning at p.size - HEAD
BODIES, JOINTS, N_JOINTS, FORCES, N_FORCES, MOTION_PROGRAM, FORCE_PROGRAM = range(7)
HEAD = 7
NONE = -1  # no program, no function, no number; as a body the ground

# a row of the table of joints: kind, row of C, body i, place of its numbers, body j, place of its numbers, place of
# further numbers, first of its results in the program of motions: three, and of WRITTEN rows their derivatives by the
# coordinates whose number and places are the further numbers; RATE: a row of A, with Q_a and its entries as results
KIND, ROW, FIRST, FIRST_AT, SECOND, SECOND_AT, MORE, MOTION, JOINT_WIDTH = range(9)
# a row of the table of forces: kind, body i, place, body j, place, further numbers, first result of the program, and of
# a spring along an axis of i the place of its point there
F_KIND, F_FIRST, F_FIRST_AT, F_SECOND, F_SECOND_AT, F_MORE, F_RESULT, F_ON_FIRST, FORCE_WIDTH = range(9)

# kinds of joints' rows in a plane ...
PIN, ACROSS, ALONG, ANGLE, DISTANCE, WRITTEN, RATE = range(7)
# ... and in space
POINT, PERPENDICULAR, PLANE, LENGTH, TURN = range(5)  # and WRITTEN and RATE
# kinds of forces, in both: between points, in a hinge, on a body, about and along an axis; the last three are a spring
# along an axis, and friction in a hinge and along an axis
SPRING, PULL, TORSION, FORCE, TORQUE, AXIAL, SLIDE, RAIL, BRAKE, RUB = range(10)

PLANAR_BODY, SPATIAL_BODY = 2, 7  # numbers of a body: mass, moment of inertia; mass, J_xx, J_yy, J_zz, J_xy, J_xz, J_yz
