"""Work in a process of its own, which may hang or die."""

import multiprocessing
import resource
from collections.abc import Callable
from typing import Any


def apart(work: Callable[[], Any], limit: float | None = None, cpu: int | None = None) -> Any:
    """What work() returns in a fork of this process, which is ended after `limit` s, or `cpu` s of CPU time, if given.

    Raises TimeoutError if it does not come back. Raises EOFError if the process ends without an answer; its argument is
    the code, as of `multiprocessing.Process.exitcode`.
    """
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)

    def answer() -> None:
        if cpu is not None:
            resource.setrlimit(resource.RLIMIT_CPU, (cpu, cpu + 1))
        there.send(work())

    process = context.Process(target=answer, daemon=True)
    process.start()
    there.close()
    try:
        if not here.poll(limit):
            raise TimeoutError
        return here.recv()
    except EOFError:
        process.join()
        raise EOFError(process.exitcode) from None
    finally:
        process.kill()
        process.join()
