"""How the runs of a sweep are shared out among processes, threads, or the workers of a cluster."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from functools import partial
from typing import Any

from twoloop.sweeps.cells import Row, failed
from twoloop.sweeps.one_run import Work, one_run
from twoloop.sweeps.shared_runs import batch, may_be_shared
from twoloop.sweeps.workers import in_processes

Batch = tuple[int, ...]  # numbers of runs

BATCHES = 16  # tasks per thread or cluster worker, for load balancing ...
LARGEST_BATCH = 16  # ... with at most this many runs each
OF_SHARED, LARGEST_SHARED = 4, 1024  # the same of runs that may be made together


def all_rows(
    work: Work, given: list[Row], left: list[int], n_workers: int, parallel: str, client: Any
) -> Generator[tuple[int, Row]]:
    """Yield numbers and rows of the remaining runs as they finish; the first run is made in this process."""
    if not left:
        return
    yield left[0], one_run(work, given[left[0]], first=True)
    rest = {number: given[number] for number in left[1:]}
    processes = client is None and parallel == "processes"
    if may_be_shared(work):
        size = min(-(-len(rest) // (OF_SHARED * n_workers)), LARGEST_SHARED)
    else:
        size = 1 if processes else min(len(rest) // (BATCHES * n_workers), LARGEST_BATCH)
    numbers, size = tuple(rest), max(size, 1)
    batches = [numbers[k : k + size] for k in range(0, len(numbers), size)]
    if processes:
        yield from _by_processes(work, rest, batches, n_workers)
    elif rest:
        with client.get_executor(pure=False) if client is not None else ThreadPoolExecutor(n_workers) as executor:
            yield from _by_executor(executor, work, rest, batches)


def _parts(numbers: Batch, n_made: int) -> list[Batch]:
    """What is left of a batch that was not finished in time, in two parts for two workers."""
    half = (n_made + len(numbers) + 1) // 2
    return [part for part in (numbers[n_made:half], numbers[half:]) if part]


def _by_processes(work: Work, rest: dict[int, Row], batches: list[Batch], n_workers: int) -> Iterator[tuple[int, Row]]:
    """Yield rows from processes; a batch lost with its process is repeated run by run."""
    inputs: list[tuple[int, list[Row]]] = []
    of_task: dict[int, Batch] = {}  # by their first numbers

    def submit(numbers: Batch) -> None:
        of_task[numbers[0]] = numbers
        inputs.append((numbers[0], [rest[number] for number in numbers]))

    for numbers in reversed(batches):
        submit(numbers)
    for first, rows, how in in_processes(partial(batch, work), inputs, n_workers):
        numbers = of_task[first]
        if rows is None and len(numbers) == 1:
            yield first, failed(how)
            continue
        parts = [(number,) for number in numbers] if rows is None else _parts(numbers, len(rows))
        for part in reversed(parts):
            submit(part)
        yield from zip(numbers, rows or (), strict=False)


def _by_executor(
    executor: Executor, work: Work, rest: dict[int, Row], batches: list[Batch]
) -> Iterator[tuple[int, Row]]:
    """Yield rows from threads or a cluster; a batch lost with its worker is repeated run by run."""
    tasks: dict[Future[list[Row]], Batch] = {}

    def submit(numbers: Batch) -> None:
        tasks[executor.submit(batch, work, [rest[number] for number in numbers])] = numbers

    for numbers in batches:
        submit(numbers)
    try:
        while tasks:
            for task in wait(tasks, return_when=FIRST_COMPLETED).done:
                numbers = tasks.pop(task)
                try:
                    rows = task.result()
                except Exception as error:
                    if len(numbers) == 1:
                        yield numbers[0], failed(f"{type(error).__name__}: {error}")
                    else:
                        for number in numbers:
                            submit((number,))
                else:
                    for part in _parts(numbers, len(rows)):
                        submit(part)
                    yield from zip(numbers, rows, strict=False)
    finally:
        for task in tasks:
            task.cancel()
