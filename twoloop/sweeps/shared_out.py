"""How the runs of a sweep are shared out among processes, threads, or the workers of a cluster."""

from __future__ import annotations

import time
from collections.abc import Generator, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from functools import partial
from typing import Any

from twoloop.ensembles.in_turn import CALL
from twoloop.sweeps.cells import Row, failed
from twoloop.sweeps.one_run import Work, failed_by, problem_for, row_of, solved
from twoloop.sweeps.shared_runs import batch, may_be_shared
from twoloop.sweeps.workers import in_processes

BATCHES = 16  # tasks per thread or cluster worker, for load balancing ...
LARGEST_BATCH = 16  # ... with at most this many runs each
SHARED, LONGEST = 1024, 10.0  # the same of runs that may be made together, and what these may take singly, s
OF_SHARED = 4  # tasks per worker then, as each makes code ready


def all_rows(
    work: Work, given: list[Row], left: list[int], n_workers: int, parallel: str, client: Any
) -> Generator[tuple[int, Row]]:
    """Yield numbers and rows of the remaining runs as they finish; the first run is made in this process."""
    if not left:
        return
    row, seconds = _first_run(work, given[left[0]])
    yield left[0], row
    rest = {number: given[number] for number in left[1:]}
    processes = client is None and parallel == "processes"
    if may_be_shared(work) and seconds is not None:
        size = min(-(-len(rest) // (OF_SHARED * n_workers)), SHARED, int(LONGEST / (seconds + CALL)))
    else:
        size = 1 if processes else min(len(rest) // (BATCHES * n_workers), LARGEST_BATCH)
    numbers = list(rest)
    batches = [numbers[k : k + max(size, 1)] for k in range(0, len(numbers), max(size, 1))]
    if processes:
        yield from _by_processes(work, rest, batches, n_workers)
    elif rest:
        with client.get_executor(pure=False) if client is not None else ThreadPoolExecutor(n_workers) as executor:
            yield from _by_executor(executor, work, rest, batches)


def _first_run(work: Work, given: Row) -> tuple[Row, float | None]:
    """The row of the first run, and the CPU time of its steps; raises what is no `ValueError`."""
    began = time.perf_counter()
    try:
        problem = problem_for(work, given)
        result = solved(work, problem)
        seconds = time.perf_counter() - began
        return row_of(work, given, problem, result, seconds), result.stats.cpu_time
    except ValueError as error:
        return failed_by(error, began), None


def _by_processes(
    work: Work, rest: dict[int, Row], batches: list[list[int]], n_workers: int
) -> Iterator[tuple[int, Row]]:
    """Yield rows from processes; a batch lost with its process is repeated run by run."""
    while batches:
        inputs = {numbers[0]: [rest[number] for number in numbers] for numbers in batches}
        known, batches = {numbers[0]: numbers for numbers in batches}, []
        for number, rows, how in in_processes(partial(batch, work), inputs, n_workers):
            if rows is not None:
                yield from zip(known[number], rows, strict=True)
            elif len(known[number]) == 1:
                yield number, failed(how)
            else:
                batches += [[each] for each in known[number]]


def _by_executor(
    executor: Executor, work: Work, rest: dict[int, Row], batches: list[list[int]]
) -> Iterator[tuple[int, Row]]:
    """Yield rows from threads or a cluster; a batch lost with its worker is repeated run by run."""
    tasks: dict[Future[list[Row]], list[int]] = {}

    def submit(numbers: list[int]) -> None:
        tasks[executor.submit(batch, work, [rest[number] for number in numbers])] = numbers

    for numbers in batches:
        submit(numbers)
    try:
        while tasks:
            for task in wait(tasks, return_when=FIRST_COMPLETED).done:
                numbers = tasks.pop(task)
                try:
                    yield from zip(numbers, task.result(), strict=True)
                except Exception as error:
                    if len(numbers) == 1:
                        yield numbers[0], failed(f"{type(error).__name__}: {error}")
                    else:
                        for number in numbers:
                            submit([number])
    finally:
        for task in tasks:
            task.cancel()
