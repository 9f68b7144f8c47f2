"""Arrays of numbers that are formulas in parameters: written anew for one system of a family after another."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.generate.known_numbers import Known, Powers

Array = NDArray[np.float64]


class Formulas:
    """Arrays in the place of arrays of formulas, all of which `write` fills for some parameters.

    One array stands for one of formulas, however often that is asked for; one that holds plain numbers stays itself.
    """

    def __init__(self) -> None:
        self._arrays: dict[int, tuple[Any, Array]] = {}  # by the ids of those of formulas, which are held
        self._places: list[tuple[Array, NDArray[np.int64], slice]] = []
        self._products: dict[Powers, int] = {}
        self._scales: list[float] = []
        self._which: list[int] = []
        self._gathered: tuple[list[Powers], Array, NDArray[np.int64]] | None = None

    def array(self, formulas: Any) -> Array:
        """What stands in the place of an array; its numbers are there after the next `write`."""
        if formulas.dtype != object:
            return formulas  # type: ignore[no-any-return]
        if id(formulas) not in self._arrays:
            self._arrays[id(formulas)] = formulas, self._made(formulas)
        return self._arrays[id(formulas)][1]

    def _made(self, formulas: Any) -> Array:
        entries, begin = formulas.ravel().tolist(), len(self._scales)
        where = [k for k, entry in enumerate(entries) if type(entry) is Known]
        for k in where:
            self._scales.append(entries[k].scale)
            self._which.append(self._products.setdefault(entries[k].powers, len(self._products)))
            entries[k] = 0.0
        numbers = np.array(entries, dtype=np.float64)
        self._places.append((numbers, np.array(where, dtype=np.int64), slice(begin, len(self._scales))))
        self._gathered = list(self._products), np.array(self._scales), np.array(self._which, dtype=np.int64)
        return numbers.reshape(formulas.shape)

    def write(self, product: Callable[[Powers], Any]) -> None:
        """Put in the numbers for parameters, of which `product` gives the products: see Family."""
        if self._gathered is None:
            return
        products, scales, which = self._gathered
        with np.errstate(all="ignore"):
            values = scales * np.array(list(map(product, products)), dtype=np.float64)[which]
        for numbers, where, part in self._places:
            numbers[where] = values[part]
