"""Rows that survive an interruption: each is on disk as soon as it is made, and a study started again goes on."""

import hashlib
import json
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from studies.report import ROOT

Row = dict[str, Any]
J = TypeVar("J")

FOLDERS = ("twoloop", "references", "studies")  # a change in any of these makes kept rows worthless
NUMERICS = ("numpy", "scipy", "numba")


def sources() -> str:
    """One hash of all that rows depend on: the sources as they are on disk, and the numerical packages."""
    digest = hashlib.sha256()
    for folder in FOLDERS:
        for path in sorted((ROOT / folder).rglob("*.py")):
            digest.update(f"{path.relative_to(ROOT)}\n".encode() + path.read_bytes())
    digest.update(" ".join(f"{package} {version(package)}" for package in NUMERICS).encode())
    return digest.hexdigest()


class KeptRows:
    """The rows of an unfinished study, in a file that vanishes when the study is complete.

    A context manager: ended without an exception it removes the file; otherwise the rows stay for the next start. The
    file begins with what the rows depend on (sources and settings). Rows that were made by other sources or with other
    settings are thrown away, with a word on the terminal.

    Parameters
    ----------
    path : Path
        The file, NAME.partial.jsonl beside the study's output.
    settings : mapping
        What the rows depend on beside the sources and their own key; anything that JSON holds.

    Attributes
    ----------
    n_taken_over : int
        Rows that an interrupted run left here.

    Raises
    ------
    ValueError
        If a row in the middle of the file cannot be read: someone has edited it.
    """

    def __init__(self, path: Path, settings: Mapping[str, Any]):
        self.path = path
        self._header = json.dumps({"sources": sources(), "settings": dict(settings)}, sort_keys=True)
        self._rows: dict[str, Row] = {}
        self.n_taken_over = 0

    def __enter__(self) -> Self:
        # a line without its end is a row whose writing was cut off
        lines = self.path.read_text().split("\n")[:-1] if self.path.exists() else []
        if lines and lines[0] == self._header:
            for number, line in enumerate(lines[1:], 2):
                try:
                    kept = json.loads(line)
                except json.JSONDecodeError as error:
                    raise ValueError(f"{self.path}, line {number} is not a row: {error}; remove the file") from None
                self._rows[kept["key"]] = kept["row"]
            self.n_taken_over = len(self._rows)
            print(f"{self.n_taken_over} rows taken over from {self.path}, which an interrupted run left")
        elif lines:
            print(f"{len(lines) - 1} rows in {self.path} thrown away: made by other sources or with other settings")
            lines = []
        whole = self.path.with_suffix(".new")
        whole.write_text("".join(f"{line}\n" for line in lines or [self._header]))
        os.replace(whole, self.path)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if error is None:
            self.path.unlink()

    def __contains__(self, key: str) -> bool:
        return key in self._rows

    def add(self, key: str, row: Row) -> None:
        """Keep a row: it is on disk when this returns."""
        line = json.dumps({"key": key, "row": row})
        with self.path.open("a") as file:
            file.write(line + "\n")
            file.flush()
            os.fsync(file.fileno())
        self._rows[key] = json.loads(line)["row"]  # as a later start would read it

    def rows(self, keys: Iterable[str]) -> list[Row]:
        """The rows of these keys, in their order."""
        return [self._rows[key] for key in keys]

    def collect(self, jobs: Mapping[str, J], run: Callable[[J], Row], n_workers: int | None = None) -> list[Row]:
        """The rows of all jobs, of which only those that are not kept yet are run, in processes of their own.

        Parameters
        ----------
        jobs : mapping
            Key of a row to its job. Jobs are started in this order.
        run : callable
            run(job) makes a row that JSON holds; a function of a module, as `multiprocessing` needs it.
        n_workers : int, optional
            Processes. None: one for each core.

        Returns
        -------
        list of dict
            In the order of `jobs`, whatever the order in which they ended.
        """
        left = {key: job for key, job in jobs.items() if key not in self}
        # fork would copy the locks of the progress bar's thread
        context = multiprocessing.get_context("spawn")
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        with (
            ProcessPoolExecutor(n_workers or os.cpu_count(), context, _end_with_parent) as pool,
            Progress(*columns) as progress,
        ):
            task = progress.add_task("runs", total=len(jobs), completed=len(jobs) - len(left))
            futures = {pool.submit(run, job): key for key, job in left.items()}
            try:
                for future in as_completed(futures):
                    self.add(futures[future], future.result())
                    progress.advance(task)
            finally:
                pool.shutdown(wait=False, cancel_futures=True)
        return self.rows(jobs)


def _end_with_parent() -> None:
    """End this worker when the study is killed, which a worker of a pool does not notice by itself."""

    def wait() -> None:
        parent = multiprocessing.parent_process()
        assert parent is not None
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
