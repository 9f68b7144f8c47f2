"""Lines that say how far a study is and how long the rest may take, also where the output is a file or a pipe."""

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

Item = TypeVar("Item")
PAUSE = 1.0  # s, at least, between lines that need not be printed: rows of milliseconds would flood a log


class Progress:
    """Print a line after each of `total` pieces of work: its number, its label, its time, what is left.

    The lines go to stderr, so that a table on stdout can be redirected. The remaining time assumes that the pieces left
    take as long in the mean as those that are done, without the first, which holds the compilation.
    """

    def __init__(self, total: int):
        self.total, self.done = total, 0
        self._last = self._first = time.monotonic()
        self._printed = -PAUSE

    def add(self, more: int) -> None:
        """Count `more` pieces that were not foreseen."""
        self.total += more

    def step(self, label: str, always: bool = True) -> None:
        """Count a finished piece; without `always`, its line may be left out where it follows too soon."""
        self.done += 1
        now = time.monotonic()
        seconds, self._last = now - self._last, now
        if self.done == 1:
            self._first = now
        if not (always or self.done == self.total or now - self._printed >= PAUSE):
            return
        self._printed = now
        left = ""  # unknown after the first
        if self.done > 1:
            left = f"  {remaining((self.total - self.done) * (now - self._first) / (self.done - 1))}"
        say(f"{self.done}/{self.total}  {label}  {seconds:.1f} s{left}")


def say(line: str) -> None:
    """Print a line of progress at once."""
    print(line, file=sys.stderr, flush=True)


def track(items: Sequence[Item], label: Callable[[Item], str], always: Callable[[Item], bool] = bool) -> Iterator[Item]:
    """Yield the items, with a line after each; `always`: always(item) is False where the line may be left out."""
    progress = Progress(len(items))
    for item in items:
        yield item
        progress.step(label(item), always(item))


def remaining(seconds: float) -> str:
    """Tell a remaining time: in seconds to two minutes, then in minutes."""
    if seconds < 0.5:
        return "almost done"
    return f"about {seconds:.0f} s left" if seconds < 120.0 else f"about {seconds / 60.0:.0f} min left"
