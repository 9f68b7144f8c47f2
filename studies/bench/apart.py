"""Work in a process of its own, which may hang or die."""

import multiprocessing
from collections.abc import Callable
from typing import Any


def apart(work: Callable[[], Any], limit: float | None = None) -> Any:
    """What work() returns in a fork of this process, which is ended after `limit` s, where there is one.

    Raises
    ------
    TimeoutError
        If it does not come back.
    EOFError
        If the process ends without an answer.
    """
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=lambda: there.send(work()), daemon=True)
    process.start()
    there.close()
    try:
        if not here.poll(limit):
            raise TimeoutError
        return here.recv()
    finally:
        process.kill()
        process.join()
