"""What is put down of each accepted step."""

from twoloop.kernels.control import clock as at
from twoloop.kernels.data.common import merged
from twoloop.kernels.data.counters import (
    N_ACCEPTED,
    N_JACOBIANS,
    N_PARTITIONS,
    N_REJECTED_CONVERGENCE,
    N_REJECTED_ERROR,
)
from twoloop.kernels.data.noted import (
    DEFECT,
    EXPLICIT_STEP,
    LARGEST_DEFECT,
    ORIENTATION,
    ORIENTATION_NEW,
    UNCHECKED,
    WIDEST_GAP,
)
from twoloop.kernels.data.tolerances import LOOK, is_beyond_gap

FADING = 0.98  # of the longest step, with each accepted one


@merged
def count_step(w, tolerances, control, clock, size, out_step):
    """Count an accepted step, and what it saw of the equations."""
    w.counters[N_ACCEPTED] += 1
    if w.notes[DEFECT] >= 0.0:
        w.notes[LARGEST_DEFECT] = max(w.notes[LARGEST_DEFECT], w.notes[DEFECT])
    else:
        w.notes[UNCHECKED] += 1.0
    gap = size
    if w.notes[DEFECT] >= 0.0:
        gap = min(size, tolerances[LOOK])
    elif is_beyond_gap(tolerances, size):  # as only steps may be whose stages are nearer to one another
        gap = control[at.UNSEEN] * size
    w.notes[WIDEST_GAP] = max(w.notes[WIDEST_GAP], gap)
    clock[at.H_LONG] = max(size, FADING * clock[at.H_LONG])
    w.notes[ORIENTATION] = w.notes[ORIENTATION_NEW]
    out_step[at.H] = size
    out_step[at.ERRORS] = w.counters[N_REJECTED_ERROR]
    out_step[at.FAILURES] = w.counters[N_REJECTED_CONVERGENCE]
    out_step[at.PARTITIONS] = w.counters[N_PARTITIONS]
    out_step[at.JACOBIANS] = 0.0 if w.notes[EXPLICIT_STEP] == 1.0 else w.counters[N_JACOBIANS]
