"""What of numba's private parts is used where code is generated; other modules take it from here."""

from numba.core import cgutils
from numba.core.dispatcher import Dispatcher

__all__ = ["Dispatcher", "cgutils"]
