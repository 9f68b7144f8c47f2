"""Execute the runs of a sweep in processes, threads, or on a Dask cluster; a worker that dies costs its run alone."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Generator, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor, as_completed
from multiprocessing.connection import Connection, wait
from typing import Any

from twoloop.kernels.compile.caches import n_compiled
from twoloop.sweeps.one_run import Row, Work, failure_row, one_run

RENEWED_AFTER = 150  # compiled functions per worker before it is replaced: LLVM keeps some MB of each
POLL_INTERVAL = 1.0  # s between checks that workers are alive: a child of a dead worker may keep its connection open


def solve_runs(
    work: Work, parameters: list[Row], numbers: list[int], n_workers: int, parallel: str, client: Any
) -> Generator[tuple[int, Row]]:
    """Yield the numbers and rows of these runs as they finish; the first run is solved in this process."""
    if not numbers:
        return
    yield numbers[0], one_run(work, parameters[numbers[0]], first=True)
    runs = {number: parameters[number] for number in numbers[1:]}
    if client is None and parallel == "processes":
        yield from _in_processes(work, runs, n_workers)
    elif runs:
        with client.get_executor(pure=False) if client is not None else ThreadPoolExecutor(n_workers) as executor:
            yield from _in_executor(executor, work, runs)


def _in_executor(executor: Executor, work: Work, runs: dict[int, Row]) -> Iterator[tuple[int, Row]]:
    """Yield rows from threads or from a cluster."""
    tasks = {executor.submit(one_run, work, run): number for number, run in runs.items()}
    try:
        for task in as_completed(tasks):
            try:
                row = task.result()
            except Exception as error:  # raised by the cluster: `one_run` raises none
                row = failure_row(f"{type(error).__name__}: {error}")
            yield tasks[task], row
    finally:
        for task in tasks:
            task.cancel()


def _in_processes(work: Work, runs: dict[int, Row], n_workers: int) -> Iterator[tuple[int, Row]]:
    """Yield rows from processes, which are replaced when they die or have grown.

    Raises KeyboardInterrupt if a run did. Raises RuntimeError if a worker dies before it can begin.
    """
    remaining = list(reversed(runs.items()))
    workers: list[_Worker] = []
    try:
        while remaining or workers:
            while remaining and len(workers) < n_workers:
                workers.append(_Worker(work, *remaining.pop()))
            # returns as soon as a worker has sent something or has died
            wait([worker.connection for worker in workers], POLL_INTERVAL)
            for worker in list(workers):
                yield from worker.rows()
                if worker.number is not None and worker.dead:
                    yield worker.number, failure_row(worker.cause_of_death())
                if worker.number is None and remaining and not worker.grown and not worker.dead:
                    worker.start(*remaining.pop())
                elif worker.number is None or worker.dead:
                    worker.terminate()
                    workers.remove(worker)
    finally:
        for worker in workers:
            worker.terminate()


class _Worker:
    """Worker process, and the number of the run that it is working on."""

    def __init__(self, work: Work, number: int, run: Row):
        # spawned: a fork of a process with threads may deadlock
        context = multiprocessing.get_context("spawn")
        self.connection, remote = context.Pipe()
        self.process = context.Process(target=_serve, args=(remote, work))
        self.process.start()
        remote.close()
        self.ready = self.grown = self.dead = False
        self.start(number, run)

    def start(self, number: int, run: Row) -> None:
        """Send a run to the worker."""
        self.number: int | None = number
        try:
            self.connection.send(run)
        except OSError:
            self.dead = True

    def rows(self) -> Iterator[tuple[int, Row]]:
        """Yield the rows since the last call; note if the worker has died."""
        try:
            alive = self.process.is_alive()  # before polling, so that nothing sent before the death is lost
            while self.connection.poll():
                message = self.connection.recv()
                if message == "ready":
                    self.ready = True
                    continue
                row, n_functions = message
                if row is None:
                    raise KeyboardInterrupt
                assert self.number is not None
                number, self.number, self.grown = self.number, None, n_functions >= RENEWED_AFTER
                yield number, row
            self.dead = self.dead or not alive
        except (EOFError, OSError):
            self.dead = True

    def cause_of_death(self) -> str:
        """Return the cause of death in words."""
        self.process.join(10.0 * POLL_INTERVAL)
        code = self.process.exitcode
        if code is not None and code < 0:
            cause = f"ended by signal {-code} ({signal.strsignal(-code)})"
        else:
            cause = f"ended with exit code {code}"
        if not self.ready:
            raise RuntimeError(
                f"a worker process {cause} before its first run, see what it says above. A script must start its sweep "
                "under if __name__ == '__main__', and functions must be in a module that another process can import"
            )
        return f"the worker process {cause} in this run"

    def terminate(self) -> None:
        """Terminate the worker."""
        self.connection.close()
        self.process.terminate()
        self.process.join(POLL_INTERVAL)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


def _serve(connection: Connection, work: Work) -> None:
    """Process runs in a worker until there are no more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    n_before = n_compiled()
    connection.send("ready")
    while True:
        try:
            run = connection.recv()
        except EOFError:
            return
        try:
            row: Row | None = one_run(work, run)
        except KeyboardInterrupt:
            row = None
        connection.send((row, n_compiled() - n_before))
