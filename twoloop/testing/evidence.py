"""What a check has seen of a simulator on a problem, for hints."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from twoloop.testing.findings import Finding
from twoloop.testing.known_problem import Array
from twoloop.testing.measuring import Observed, Settings, order
from twoloop.testing.simulated import Simulate

CLEAR = 0.1  # of an error, to which the right explanation reduces it


@dataclass(frozen=True, eq=False)
class Evidence:
    """The runs of a problem, which properties failed on them, and the simulator to ask again."""

    observed: Observed
    settings: Settings
    failed: dict[str, Finding]
    simulate: Simulate

    @cached_property
    def position(self) -> Array:
        """Errors (n_t,) of the coordinates of the finest run."""
        return self.observed.errors("q")[-1]

    def wrong(self, kind: str) -> bool:
        """Whether the limit of q or v is wrong, or the error of tolerances."""
        return bool({f"error of {kind}", f"limit of {kind}"} & set(self.failed))

    def clears(self, q: Array) -> bool:
        """Whether other coordinates (n_t, n_q) instead of those of the finest run take most of the error away."""
        motion = self.observed.motion
        left = np.abs(q - motion.q).max(axis=1) / motion.scales[0]
        return bool(left.max() < CLEAR * self.position.max())

    @cached_property
    def early_order(self) -> float | None:
        """The order of the errors of q by the last refinement, as long as they are small."""
        return self.order_of("q", 1) if len(self.observed.runs) > 1 else None

    def order_of(self, kind: str, back: int) -> float | None:
        """The order of the errors of q or v by a refinement, the last one for back = 1."""
        coarse, fine = self.observed.errors(kind)[-back - 1 :][:2]
        long, short = self.observed.settings[-back - 1 :][:2]
        return order(coarse, fine, long / short, self.observed.rounding + self.observed.floor(kind))
