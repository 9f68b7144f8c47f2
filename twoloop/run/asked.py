"""What a call asks of a run, beside what it is to keep."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.kernels.data import noted
from twoloop.methods.code_for import Compiled
from twoloop.methods.plan import Method
from twoloop.run.run import Run


class Asked(NamedTuple):
    """The options of a call; `solve_dae` says what the names mean."""

    method: Method
    atol: NDArray[np.float64]
    t1: float
    rtol: float
    step_size: float | None
    first_step: float | None
    max_step: float
    max_steps: int | None
    compiled: Compiled
    check_derivatives: bool

    @property
    def key(self) -> Any:
        """What calls have in common that ask for the same, but for the end."""
        return id(self.method), self.atol.tobytes(), self[3:]

    def set_sizes(self, run: Run) -> None:
        """Set the first and the largest step of a run, where these vary, and where a drive may have a kink."""
        run.work.notes[noted.KINK_AFTER] = self.t1
        if self.step_size is None:
            run.set_sizes(self.first_step, self.max_step, self.t1)
