"""What of numba's private parts is used where code is generated; other modules take it from here."""

from numba.core import cgutils
from numba.core.dispatcher import Dispatcher
from numba.core.typing import signature
from numba.np.arrayobj import make_array

__all__ = ["Dispatcher", "cgutils", "make_array", "signature"]
