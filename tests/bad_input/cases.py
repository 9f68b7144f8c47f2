"""What users get wrong, all of it: the tests run it, and docs/errors.md is written from it."""

from tests.bad_input.between_steps import BETWEEN_STEPS
from tests.bad_input.bodies import BODIES
from tests.bad_input.ensembles import ENSEMBLES
from tests.bad_input.impacts import IMPACTS
from tests.bad_input.joints import JOINTS
from tests.bad_input.mechanisms import MECHANISMS
from tests.bad_input.methods import METHODS
from tests.bad_input.projection import PROJECTION
from tests.bad_input.results import RESULTS
from tests.bad_input.rows import ROWS
from tests.bad_input.simulators import SIMULATORS
from tests.bad_input.solving import SOLVE
from tests.bad_input.start import START
from tests.bad_input.symbolic import SYMBOLIC
from tests.bad_input.systems import SYSTEMS

CASES = [*(*SOLVE, *BETWEEN_STEPS, *START, *PROJECTION, *SYSTEMS, *METHODS, *MECHANISMS, *ROWS, *JOINTS, *RESULTS), *BODIES, *IMPACTS, *ENSEMBLES, *SIMULATORS, *SYMBOLIC]
