"""The folder of a report: one run at a time, atomic writes, no symbolic links, rows that survive interruptions."""

import csv
import fcntl
import hashlib
import json
import math
import os
import tempfile
from collections import defaultdict
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from importlib.metadata import version
from io import BytesIO, StringIO
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import pandas as pd

from studies.bench.cli import ROOT, Call, StudyError, processor
from twoloop.problem.problem import Array

Row = dict[str, Any]
FOLDERS = ("twoloop", "references", "studies")  # a change in any of these makes kept rows worthless
NUMERICS = ("numpy", "scipy", "numba")
# studies whose times are compared, so that no two run at once
TIMED = (
    *("work_precision", "compare", "table3", "table3_full", "energy", "ensembles", "engines", "scale"),
    *("beam", "violation", "ablation"),
)
PARTS = ("motion", "step_size", "violation", "beam", "ablation")  # of the study of reproduction, with rows of their own
MADE_BY = {part: f"reproduction {part}" for part in PARTS} | {"table3_full": "table3 --full"}
LOCK = "twoloop-timed.lock"  # in the machine's folder of temporary files
NO_LINK = getattr(os, "O_NOFOLLOW", 0)


class Output:
    """Files of one run of a study; a context manager that holds the folder's lock.

    The folder `out` of `call` is created if it does not exist. Raises StudyError if the folder cannot be written or is
    in use, or if another full run of a study that compares times goes on anywhere on the machine.
    """

    def __init__(self, call: Call):
        self.call = call
        self.path = call.out.resolve()
        self._locks = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as held:
            try:
                self.path.mkdir(parents=True, exist_ok=True)
                lock = os.open(self.path / ".lock", os.O_RDWR | os.O_CREAT | NO_LINK, 0o644)
                held.callback(os.close, lock)  # which releases the lock, as the end of the process does
                tempfile.TemporaryFile(dir=self.path).close()
            except OSError as error:
                why = f"cannot write to {self.path}: {error.strerror}"
                raise StudyError(f"{why}; choose another folder by --out") from None
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                why = f"another run is writing to {self.path}"
                raise StudyError(f"{why}; wait for it, or choose another folder by --out") from None
            if self.call.study in TIMED and not (self.call.quick or self.call.redraw):
                held.callback(os.close, alone())
            self._locks = held.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._locks.close()

    def file(self, name: str) -> Path:
        """Path of a file of the report to read, which must not be a link out of the folder."""
        path = self.path / name
        if path.is_symlink() and not path.resolve().is_relative_to(self.path):
            raise StudyError(f"{path} is a link to {path.resolve()}, outside the folder; remove the link")
        return path

    def write(self, name: str, content: str | bytes) -> Path:
        """Write a file, whole or not at all; paths that a text has within the project stand as from its folder."""
        path = self.file(name)
        data = content.replace(f"{ROOT}/", "").encode() if isinstance(content, str) else content
        handle, new = tempfile.mkstemp(dir=self.path, prefix=f".{name}.")
        try:
            with os.fdopen(handle, "wb") as stream:
                stream.write(data)
                stream.flush()
                os.fsync(stream.fileno())
            os.chmod(new, 0o644)
            os.replace(new, path)
        except OSError as error:
            Path(new).unlink(missing_ok=True)
            raise StudyError(f"cannot write {path}: {error.strerror}") from None
        return path

    def save_rows(self, rows: pd.DataFrame, line: str) -> None:
        """Write NAME.csv, with study, quick or full, and the stamp in its first line; curves go to NAME_series.npz."""
        if "series" in rows:
            curves = {
                f"{key(row)} {name}": np.asarray(curve, np.float32)
                for _, row in rows[rows["series"].notna()].iterrows()  # none of a run without a result
                for name, curve in row["series"].items()
            }
            stream = BytesIO()
            np.savez_compressed(stream, allow_pickle=False, **curves)  # type: ignore[arg-type]
            self.write(f"{self.call.study}_series.npz", stream.getvalue())
            rows = rows.drop(columns="series")
        text = rows.to_csv(index=False, quoting=csv.QUOTE_NONNUMERIC)  # a "#" in a message begins no comment
        self.write(f"{self.call.study}.csv", f"# {self._kind()}; {line}\n{text}")

    def load_rows(self, curves: bool = False) -> tuple[pd.DataFrame, str]:
        """Read the rows of `save_rows`, with the curves if requested, and the stamp; StudyError if they do not suit."""
        path = self.file(f"{self.call.study}.csv")
        rerun = f"make it again by {command_of(self.call.study)}"
        if not path.is_file():
            raise StudyError(f"there is no {path} to redraw from; {rerun}")
        rows, first = read_rows(path)
        if not first.startswith(f"# {self._kind()}; "):
            raise StudyError(f"{path} holds other rows than {self._kind()} ones: {first[:60]!r}; {rerun}")
        if curves:
            known = self._load_series()
            rows["series"] = [known.get(key(row), {}) for _, row in rows.iterrows()]
        return rows, first.removeprefix(f"# {self._kind()}; ")

    def _load_series(self) -> dict[str, dict[str, Array]]:
        path, found = self.file(f"{self.call.study}_series.npz"), defaultdict[str, dict[str, Array]](dict)
        try:
            with np.load(path) as stored:
                for name in stored.files:
                    of, curve = name.rsplit(" ", 1)
                    found[of][curve] = stored[name]
        except (OSError, ValueError) as error:
            raise StudyError(f"{path} cannot be read: {error}") from None
        return found

    def save_findings(self, findings: Mapping[str, Any]) -> None:
        """Write NAME.json; what is not finite becomes null."""
        text = json.dumps(plain(findings), indent=1, allow_nan=False, ensure_ascii=False)
        self.write(f"{self.call.study}.json", text + "\n")

    def load_findings(self) -> dict[str, Any]:
        """Read what `save_findings` wrote."""
        path = self.file(f"{self.call.study}.json")
        try:
            return dict(json.loads(path.read_text()))
        except (OSError, ValueError, TypeError) as error:
            raise StudyError(f"{path} cannot be read: {error}") from None

    def kept(self, settings: Mapping[str, Any] | None = None) -> "KeptRows":
        """The rows of an unfinished run of this study; `settings`: what they depend on beside sources and keys."""
        depends = {"study": self.call.study, "quick": self.call.quick, "only": self.call.only, **(settings or {})}
        return KeptRows(self.file(f"{self.call.study}.partial.jsonl"), depends)

    def _kind(self) -> str:
        return f"{'quick' if self.call.quick else 'full'} {self.call.study}"


def read_rows(path: Path, *columns: str) -> tuple[pd.DataFrame, str]:
    """Return the rows of a file by `Output.save_rows`, and its first line; raise StudyError if it is damaged."""
    try:
        first, rest = path.read_text().split("\n", 1)
        rows = pd.read_csv(StringIO(rest), low_memory=False)
        _ = rows[list(columns)]
        return rows, first
    except (ValueError, KeyError) as error:
        raise StudyError(f"{path} is damaged ({error}); make it again by {command_of(path.stem)}") from None


def command_of(name: str) -> str:
    """Tell the command that makes NAME.csv."""
    return f"python -m studies.{MADE_BY.get(name, name)}"


def key(row: pd.Series) -> str:
    """What tells the curves of this row from those of all others of the study."""
    words = [row.get(name) for name in ("group", "case", "solver", "partition")]
    values = [f"{name}={row[name]:g}" for name in ("err_in", "err_out", "tol", "h") if pd.notna(row.get(name))]
    return " ".join([*(word for word in words if isinstance(word, str)), *values])


def alone() -> int:
    """Hold the machine for a study that compares times, by the returned descriptor; else raise StudyError."""
    path = Path(tempfile.gettempdir(), LOCK)
    try:
        # to read is enough for a lock, and of a file that another user has made all that may be
        descriptor = os.open(path, os.O_RDONLY | NO_LINK)
    except FileNotFoundError:
        descriptor = os.open(path, os.O_RDONLY | os.O_CREAT | NO_LINK, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise StudyError(
            "another study is being timed on this machine, and two would slow one another down; wait for it"
        ) from None
    return descriptor


class KeptRows:
    """The rows of an unfinished study, in a file that vanishes when the study is complete.

    A context manager: ended without an exception it removes the file; otherwise the rows stay for the next start. The
    file begins with what the rows depend on. A file with another beginning, or with a line that is not a row, is set
    aside under another name, which is printed; nothing of it is used.

    `settings`: what the rows depend on beside the sources and their own key; anything that JSON holds.

    `n_resumed`: rows that an interrupted run left here.
    """

    def __init__(self, path: Path, settings: Mapping[str, Any]):
        self.path = path
        about = {"sources": sources(), "processor": processor(), "settings": dict(settings)}
        self._header = json.dumps(about, sort_keys=True)
        self._rows: dict[str, Row] = {}
        self.n_resumed = 0

    def __enter__(self) -> Self:
        lines: list[str] = []
        if self.path.exists():
            # a last line without its end is a row whose writing was cut off
            lines = self.path.read_text(errors="replace").split("\n")[:-1]
            try:
                self._rows = self._read(lines)
            except ValueError as error:
                asides = (self.path.with_suffix(f".aside-{k}") for k in count(1))
                lines, aside = [], next(path for path in asides if not path.exists())
                self.path.rename(aside)
                print(f"{self.path.name}: {error}; set aside as {aside.name}")
            self.n_resumed = len(self._rows)
            if self._rows:
                print(f"Continuing from {self.n_resumed} finished runs in {self.path}")
        new = self.path.with_name(f".{self.path.name}.new")
        new.unlink(missing_ok=True)
        new.write_text("".join(f"{line}\n" for line in lines or [self._header]))
        os.replace(new, self.path)
        return self

    def _read(self, lines: list[str]) -> dict[str, Row]:
        if lines[:1] != [self._header] and self.path.stat().st_size > 0:
            raise ValueError("its rows were made by other sources, with other settings or on another processor")
        rows = {}
        for number, line in enumerate(lines[1:], 2):
            try:
                kept = json.loads(line)
                key, row = kept["key"], dict(kept["row"])
            except (ValueError, KeyError, TypeError):
                key, row = None, {}
            if not isinstance(key, str):
                raise ValueError(f"line {number} is not a row")
            rows[key] = row
        return rows

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if error is None:
            self.path.unlink()

    def __contains__(self, key: str) -> bool:
        return key in self._rows

    def __getitem__(self, key: str) -> Row:
        return self._rows[key]

    def made(self, key: str, make: Callable[[], Row]) -> Row:
        """The row of this key: the one that is kept, or that make() returns, which is then kept."""
        if key not in self:
            self.add(key, make())
        return self[key]

    def add(self, key: str, row: Row) -> None:
        """Keep a row, with the processor that made it: it is on disk when this returns."""
        line = json.dumps({"key": key, "row": plain(row) | {"processor": processor()}})
        descriptor = os.open(self.path, os.O_WRONLY | os.O_APPEND | NO_LINK)
        with os.fdopen(descriptor, "a") as file:
            file.write(line + "\n")
            file.flush()
            os.fsync(file.fileno())
        self._rows[key] = json.loads(line)["row"]  # as a later start would read it


def sources() -> str:
    """One hash of all that rows depend on: the sources as they are on disk, and the numerical packages."""
    digest = hashlib.sha256()
    for folder in FOLDERS:
        for path in sorted((ROOT / folder).rglob("*.py")):
            digest.update(f"{path.relative_to(ROOT)}\n".encode() + path.read_bytes())
    digest.update(" ".join(f"{package} {version(package)}" for package in NUMERICS).encode())
    return digest.hexdigest()


def plain(value: Any) -> Any:
    """Return a value in types of JSON, with None for what is not finite; raise TypeError for other types."""
    if isinstance(value, Mapping):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(each) for each in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    raise TypeError(f"findings and rows hold numbers, booleans, texts and lists of these; given {type(value).__name__}")
