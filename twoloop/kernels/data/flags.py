"""What kernels are told of a system: whole numbers."""

from twoloop.kernels.compile.callbacks import OPTIONAL

# places in Functions.flags; BANDWIDTH is -1 where linear algebra is not banded; FORM: how accelerations
# are found, see linalg/saddle_point.py; DENSE_FORM: what it becomes where sparse factors have too many entries;
# STRAIGHT: 1 where the inner loop is code made for the mechanism, see straight_code.py
CONSTANT_MASS, DIAGONAL_MASS, BANDWIDTH, FORM, DENSE_FORM, STRAIGHT, FIRST_GIVEN = range(7)
MULTIPLIERS, NULL_SPACE, AUGMENTED, STATIC = range(4)  # forms; the last has sparse_inner_loop.py
GIVEN = {name: place for place, name in enumerate(OPTIONAL, FIRST_GIVEN)}  # whether an optional callback is given
N_FLAGS = FIRST_GIVEN + len(GIVEN)
CONSTRAINT_RATE_GIVEN, GAMMA_GIVEN, FORCE_BY_Q_GIVEN, FORCE_BY_V_GIVEN, REACTION_BY_Q_GIVEN, KINEMATICS_GIVEN = (
    GIVEN[name] for name in ("constraint_rate", "gamma", "force_by_q", "force_by_v", "reaction_by_q", "kinematics")
)
NONHOLONOMIC_RATE_GIVEN, NONHOLONOMIC_GAMMA_GIVEN = (
    GIVEN[name] for name in ("nonholonomic_rate", "nonholonomic_gamma")
)
MASS_VALUES_GIVEN, JACOBIAN_VALUES_GIVEN = (GIVEN[name] for name in ("mass_values", "jacobian_values"))
