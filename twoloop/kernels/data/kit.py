"""What kernels get of a system and a method: the table by which they find callbacks, the inner loop and the step."""

from typing import Any

import numpy as np
from numba.extending import typeof_impl

from twoloop.kernels.compile.generated_functions import DeferredFunctions, GeneratedFunctions
from twoloop.kernels.data.common import KIT, OWN_FUNCTIONS, Step

NONE = np.zeros(0)


class Kit:
    """What kernels get of a system and a method, one reference: the callbacks, the inner loop and the step.

    The latter two are compiled once, and not again in what calls them; None where they are not called. A step that
    chooses between two others has these as `first` and `second`. An inner loop that calls functions made for the
    mechanism leaves to `general` what these do not do. `own` are sets of such functions; `numbers` is what those of the
    inner loop read, `own_numbers` what those of collocation read.
    """

    def __init__(
        self,
        functions: Any,
        inner: Any = None,
        step: Step | None = None,
        first: Step | None = None,
        second: Step | None = None,
        general: Any = None,
        own: tuple[GeneratedFunctions | DeferredFunctions, ...] = (),
        numbers: Any = None,
        own_numbers: Any = None,
    ):
        self.__dict__.update(functions._asdict())
        self.functions, self.inner, self.general, self.own = functions, inner, general, own
        self.numbers = NONE if numbers is None else numbers
        self.own_numbers = NONE if own_numbers is None else own_numbers
        self.attempt, self.settle, self.attempt_many = step or Step()
        self.attempt_first, self.settle_first, _ = first or Step()
        self.attempt_second, self.settle_second, _ = second or Step()
        self.__dict__.update(dict.fromkeys(OWN_FUNCTIONS, 0))
        for each in own:
            self.__dict__.update(each.addresses)
        self.table = KIT.table(self)
        self.address = self.table.ctypes.data

    def __getattr__(self, name: str) -> Any:
        return getattr(self.functions, name)


@typeof_impl.register(Kit)
def _type_of_kit(value: Any, context: Any) -> Any:
    return KIT
