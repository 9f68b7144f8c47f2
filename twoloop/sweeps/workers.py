"""Tasks in separate processes, each of which may die without affecting other tasks."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection, wait
from typing import Any

from twoloop.kernels.compile.caches import n_made

RENEWED_AFTER = 150  # compiled functions per worker before it is replaced: LLVM keeps some MB of each
LOOK_EVERY = 1.0  # s between checks that workers are alive: a child of a dead worker may keep its connection open

Task = Callable[[Any], Any]


def in_processes(task: Task, inputs: list[tuple[int, Any]], n_workers: int) -> Iterator[tuple[int, Any, str]]:
    """Yield the outcome of a task for each input, as they finish.

    Parameters
    ----------
    task : callable
        task(input) -> picklable object; it raises no exception but KeyboardInterrupt.
    inputs : list of (int, object)
        Inputs with their numbers. They are taken from it, the last one first; others may be added on the way.
    n_workers : int

    Yields
    ------
    (int, object, str)
        The number of an input and its outcome, or None and how the worker died.

    Raises KeyboardInterrupt if the task raised one. Raises RuntimeError if a worker dies before it can begin.
    """
    workers: list[_Worker] = []
    try:
        while inputs or workers:
            while inputs and len(workers) < n_workers:
                workers.append(_Worker(task, inputs.pop()))
            wait([each.connection for each in workers], LOOK_EVERY)
            for worker in list(workers):
                for number, made in worker.answers():
                    yield number, made, ""
                if worker.number is not None and worker.dead:
                    yield worker.number, None, worker.how_it_died()
                if worker.number is None and inputs and not worker.worn and not worker.dead:
                    worker.begin(inputs.pop())
                elif worker.number is None or worker.dead:
                    worker.end()
                    workers.remove(worker)
    finally:
        for worker in workers:
            worker.end()


class _Worker:
    """A process, and the number of the input that it is working on."""

    def __init__(self, task: Task, first: tuple[int, Any]):
        # spawned: a fork of a process with threads may deadlock
        context = multiprocessing.get_context("spawn")
        self.connection, far = context.Pipe()
        self.process = context.Process(target=_serve, args=(far, task))
        self.process.start()
        far.close()
        self.began = self.worn = self.dead = False
        self.begin(first)

    def begin(self, entry: tuple[int, Any]) -> None:
        """Send an input to the worker."""
        self.number: int | None = entry[0]
        try:
            self.connection.send(entry[1])
        except OSError:
            self.dead = True

    def answers(self) -> Iterator[tuple[int, Any]]:
        """Yield the outcomes since the last call; note if the worker has died."""
        try:
            alive = self.process.is_alive()  # before polling, so that nothing sent before the death is lost
            while self.connection.poll():
                said = self.connection.recv()
                if said == "ready":
                    self.began = True
                    continue
                made, n_functions = said
                if made is None:
                    raise KeyboardInterrupt
                assert self.number is not None
                number, self.number, self.worn = self.number, None, n_functions >= RENEWED_AFTER
                yield number, made
            self.dead = self.dead or not alive
        except (EOFError, OSError):
            self.dead = True

    def how_it_died(self) -> str:
        """Return the cause of death in words."""
        self.process.join(10.0 * LOOK_EVERY)
        code = self.process.exitcode
        if code is not None and code < 0:
            how = f"ended by signal {-code} ({signal.strsignal(-code)})"
        else:
            how = f"ended with exit code {code}"
        if not self.began:
            raise RuntimeError(
                f"a worker process {how} before its first run, see what it says above. A script must start its sweep "
                "under if __name__ == '__main__', and functions must be in a module that another process can import"
            )
        return f"the worker process {how} in this run"

    def end(self) -> None:
        """Terminate the worker."""
        self.connection.close()
        self.process.terminate()
        self.process.join(LOOK_EVERY)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


def _serve(connection: Connection, task: Task) -> None:
    """Main loop of a worker: process inputs until there are no more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    before = n_made()
    connection.send("ready")
    while True:
        try:
            given = connection.recv()
        except EOFError:
            return
        try:
            made = task(given)
        except KeyboardInterrupt:
            made = None
        connection.send((made, n_made() - before))
