"""Runs and failed properties of a simulator on a problem, as the basis of hints."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from twoloop.testing.findings import Finding
from twoloop.testing.known_problem import Array
from twoloop.testing.measuring import Observed, Settings, order
from twoloop.testing.simulated import Simulate

CLEAR = 0.1  # an explanation must reduce the error to this fraction


@dataclass(frozen=True, eq=False)
class Evidence:
    """Runs of a problem, the properties that failed, and the simulator for further runs."""

    observed: Observed
    settings: Settings
    failed: dict[str, Finding]
    simulate: Simulate

    @cached_property
    def position(self) -> Array:
        """Return the errors (n_t,) of the coordinates of the finest run."""
        return self.observed.errors("q")[-1]

    def wrong(self, kind: str) -> bool:
        """Return True if the limit of q or v, or with tolerances its error, failed."""
        return bool({f"error of {kind}", f"limit of {kind}"} & set(self.failed))

    def clears(self, q: Array) -> bool:
        """Return True if replacing the coordinates of the finest run by these (n_t, n_q) removes most of the error."""
        motion = self.observed.motion
        left = np.abs(q - motion.q).max(axis=1) / motion.scales[0]
        return bool(left.max() < CLEAR * self.position.max())

    @cached_property
    def early_order(self) -> float | None:
        """Return the order of q over the last refinement, while the errors are small."""
        return self.order_of("q", 1) if len(self.observed.runs) > 1 else None

    def order_of(self, kind: str, back: int) -> float | None:
        """Return the observed order of q or v over a refinement; back = 1 is the last one."""
        coarse, fine = self.observed.errors(kind)[-back - 1 :][:2]
        long, short = self.observed.settings[-back - 1 :][:2]
        return order(coarse, fine, long / short, self.observed.rounding + self.observed.floor(kind))
