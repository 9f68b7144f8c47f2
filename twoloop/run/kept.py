"""Where what a run keeps goes as it comes: into memory, or into files, of which is read what is asked for."""

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAGIC, HEAD = b"\x93NUMPY\x01\x00", 128  # bytes before the numbers of a file, in NumPy's format npy
OF_STEPS = ("h", "rejected_error", "rejected_convergence", "partitioned", "untested")  # with a row a step


class InMemory:
    """Arrays by name, each of parts that follow one another.

    Attributes
    ----------
    finished : bool
        Whether what is added should be as it is to stay, as no later look would reach all of it.
    """

    finished = False

    def __init__(self) -> None:
        self._parts: defaultdict[str, list[NDArray[Any]]] = defaultdict(list)

    def add(self, name: str, part: NDArray[Any]) -> None:
        """Append rows to an array, which may be kept as they are."""
        self._parts[name].append(part)

    def cut(self, name: str, n: int) -> None:
        """Leave the first n rows of an array."""
        self._parts[name] = [self.array(name)[:n]]

    def array(self, name: str) -> NDArray[Any]:
        """All rows."""
        first, *others = self._parts[name]
        return np.concatenate([first, *others]) if others else first


class OnDisk:
    """The same in a folder that is made for it: a file of NumPy's for each array, complete after each part.

    Parameters
    ----------
    folder : Path

    Raises
    ------
    OSError
        Of `add`, if there is no room left.
    """

    finished = True

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self.folder = folder
        self._shapes: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {}

    def add(self, name: str, part: NDArray[Any]) -> None:
        """Append rows to an array."""
        dtype, (n, *width) = self._shapes.get(name, (part.dtype, (0, *part.shape[1:])))
        with self._path(name).open("r+b" if name in self._shapes else "x+b") as file:
            file.seek(HEAD + n * self._row(dtype, width))
            file.write(np.ascontiguousarray(part).data)
            self._close(file, name, dtype, (n + len(part), *width))

    def cut(self, name: str, n: int) -> None:
        """Leave the first n rows of an array."""
        dtype, (before, *width) = self._shapes[name]
        with self._path(name).open("r+b") as file:
            file.truncate(HEAD + min(n, before) * self._row(dtype, width))
            self._close(file, name, dtype, (min(n, before), *width))

    def array(self, name: str) -> NDArray[Any]:
        """All rows, which are read as they are used; what is written to them stays out of the file."""
        return mapped(self._path(name))

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.npy"

    @staticmethod
    def _row(dtype: np.dtype[Any], width: list[int]) -> int:
        return int(dtype.itemsize * np.prod(width, dtype=np.int64))

    def _close(self, file: Any, name: str, dtype: np.dtype[Any], shape: tuple[int, ...]) -> None:
        """Write the head, last: a process that dies before leaves the array as it was."""
        head = repr({"descr": dtype.str, "fortran_order": False, "shape": shape}).ljust(HEAD - len(MAGIC) - 3) + "\n"
        file.flush()
        file.seek(0)
        file.write(MAGIC + (len(head)).to_bytes(2, "little") + head.encode())
        self._shapes[name] = dtype, shape


Kept = InMemory | OnDisk


def mapped(path: Path) -> NDArray[Any]:
    """The array in a file, read as it is used."""
    return np.load(path, mmap_mode="c", allow_pickle=False).view(np.ndarray)  # type: ignore[no-any-return]


def read(folder: Path) -> dict[str, NDArray[Any]]:
    """The arrays in a folder by name, without rows that others have not yet: those of a process that died."""
    arrays = {path.stem: mapped(path) for path in sorted(folder.glob("*.npy"))}
    for group in (("t", "states"), OF_STEPS, ("sol_t", "sol_states")):
        there = [name for name in group if name in arrays]
        n = min((len(arrays[name]) for name in there), default=0)
        arrays |= {name: arrays[name][:n] for name in there}
    return arrays
