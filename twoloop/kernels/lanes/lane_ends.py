"""What becomes of a run in lanes: made, or left to a run of its own, for one of these reasons."""

UNDECIDED, ENDED = 0, 1
NO_START, NO_STATE, NO_VALUES, OFTEN_REFUSED, MANY_STEPS, UNLIKE = range(-6, 0)
