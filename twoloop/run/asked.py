"""What the options of a call ask of a run, beside what it is to keep."""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.kernels.data import noted
from twoloop.methods.code_for import Compiled
from twoloop.methods.plan import Method
from twoloop.methods.presets import identity
from twoloop.run.run import Run


@lru_cache(maxsize=1024)
def _key(*_: Any) -> object:
    """An object that stands for these options: it is found in a dictionary at once."""
    return object()


@dataclass(frozen=True)
class Asked:
    """The options of a call; `solve_dae` says what the names mean."""

    method: Method
    rtol: float
    atol: NDArray[np.float64]
    first_step: float | None
    max_step: float
    max_steps: int | None
    step_size: float | None
    compiled: Compiled
    check_derivatives: bool

    @cached_property
    def key(self) -> object:
        """What calls have in common that ask for the same."""
        sizes = self.first_step, self.max_step, self.max_steps, self.step_size
        tolerances = self.rtol, self.atol.tobytes()
        return _key(identity(self.method), *tolerances, *sizes, self.compiled, self.check_derivatives)

    @cached_property
    def own_tolerance(self) -> float | None:
        """The tolerance of positions of a method that tests these by itself."""
        return getattr(self.method, "error_tol", None)

    @cached_property
    def told(self) -> dict[str, Any]:
        """What a result says of these; `untested` is None where all steps are tested, else of the run."""
        tested = getattr(self.method, "tested", "all")
        return {"method": self.method.name, "rtol": self.rtol} | ({} if tested == "positions" else {"untested": None})

    def set_sizes(self, run: Run, t1: float) -> None:
        """Set the first and the largest step of a run to t1, where these vary, and where a drive may have a kink."""
        run.work.notes[noted.KINK_AFTER] = t1
        if self.step_size is None:
            run.set_sizes(self.first_step, self.max_step, t1)
