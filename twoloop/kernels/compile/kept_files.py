"""Files of machine code: one for each function and key, behind a checksum, which only the user can write."""

import glob
import hashlib
import pickle
import uuid
from pathlib import Path
from typing import Any

import numba
from numba.core.serialize import dumps

from twoloop.kernels.compile.ownership import make_own, read_own, write_own

MOST_KEPT = 500  # sets of functions made for single mechanisms, of each kind, on disk
CHECKSUM = hashlib.sha256().digest_size


class Files:
    """The files of one function, one for each key, each behind its checksum, and in the hands of the user alone.

    A file that is damaged or out of date counts as missing. Numba's own keep an index, through which two processes that
    write at the same time may lead one function to the machine code of another.
    """

    def __init__(self, folder: Path, name: str, stamp: Any, limited: bool = False):
        self.folder, self.name, self.limited = folder, name, limited
        self.made_of = numba.__version__, stamp

    def save(self, key: Any, data: Any) -> None:
        """Write what numba made for a key, in the place of what was there."""
        content = pickle.dumps((repr((*self.made_of, key)), dumps(data)))
        path = self._path(key)
        unfinished = path.with_suffix(f".{uuid.uuid4().hex}")
        make_own(self.folder)
        try:
            write_own(unfinished, hashlib.sha256(content).digest() + content)
            unfinished.replace(path)
        finally:
            unfinished.unlink(missing_ok=True)
        if self.limited:
            for old in sorted(self._all(), key=_written)[:-MOST_KEPT]:
                old.unlink(missing_ok=True)

    def has(self, key: Any) -> bool:
        """Whether there is a file for a key."""
        return self._path(key).exists()

    def load(self, key: Any) -> Any:
        """What numba made for a key; None if it is missing."""
        try:
            content = read_own(self._path(key))
        except OSError:
            return None
        if hashlib.sha256(content[CHECKSUM:]).digest() != content[:CHECKSUM]:
            return None
        made_of, data = pickle.loads(content[CHECKSUM:])
        return pickle.loads(data) if made_of == repr((*self.made_of, key)) else None

    def flush(self) -> None:
        """Remove the files of all keys."""
        for path in self._all():
            path.unlink(missing_ok=True)

    def _all(self) -> list[Path]:
        return list(self.folder.glob(f"{glob.escape(self.name)}.*.nbc"))

    def _path(self, key: Any) -> Path:
        return self.folder / f"{self.name}.{hashlib.sha256(repr(key).encode()).hexdigest()[:16]}.nbc"


def _written(path: Path) -> float:
    """When a file was written; 0 if another process has removed it."""
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0
