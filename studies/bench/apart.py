"""Work that may hang or die, in a process of its own; and calls that may raise, with what they warn of."""

import multiprocessing
import resource
import warnings
from collections.abc import Callable
from typing import Any

from studies.bench.store import Row
from twoloop import Result


def heard(call: Callable[[], Result]) -> tuple[Result | None, Row]:
    """The result of a call, or None; its status and message, or what was raised; and what it warned of."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            result, told = (made := call()), {"status": made.status.name, "message": made.message}
        except Exception as error:  # of whatever kind: a row
            result, told = None, {"status": "RAISED", "message": f"{type(error).__name__}: {error}"}
    return result, told | {"warned": " / ".join(str(each.message) for each in said)}


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
