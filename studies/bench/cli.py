"""How every study is called: one parser, one stamp, errors and Ctrl-C of one line, and lines of progress."""

import argparse
import os
import platform
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

from twoloop import ConstraintWarning

ROOT = Path(__file__).parents[2]
CLONE = (ROOT / "pyproject.toml").is_file()  # otherwise this is an installed package
REPORTS = (ROOT if CLONE else Path.cwd()) / "reports"
PACKAGES = ("twoloop", "numpy", "scipy", "numba", "scikit-sundae", "exudyn")


class StudyError(Exception):
    """What ends a study with one line: a folder in use, rows that are missing, a file that cannot be read."""


@dataclass(frozen=True)
class Call:
    """How a study was called."""

    study: str
    quick: bool  # the small version of some seconds
    out: Path  # folder of the report
    redraw: bool  # make report and figures again from the saved rows
    command: str  # for the stamp
    only: tuple[str, ...] = ()  # whose rows are measured again, beside the saved rows of the others

    def wants(self, *names: str) -> bool:
        """Return whether the rows of a run are to be made whose group, case, family and solver have these names."""
        return not self.only or any(name in self.only for name in names)

    def wanted(self, runs: Iterable[Any]) -> list[Any]:
        """Choose the runs whose rows are to be made."""
        return [run for run in runs if self.wants(run.group, run.case.name, run.solver.family, run.solver.name)]


def parser(
    name: str,
    description: str | None,
    quick: str = "a small version in seconds, into reports/quick",
    folder: str = "reports",
    parts: bool = False,
) -> argparse.ArgumentParser:
    """The options that all studies have; `name` is what follows `python -m studies.`."""
    made = argparse.ArgumentParser(prog=f"python -m studies.{name}", description=description)
    made.add_argument("--quick", action="store_true", help=quick)
    made.add_argument("--out", type=Path, help=f"folder for the report (default: {folder})")
    made.add_argument("--redraw", action="store_true", help="write report and figures again from the saved rows")
    if parts:
        what = "measure the rows of these groups, cases, families or solvers of the CSV file again; the others stay"
        made.add_argument("--only", nargs="+", metavar="NAME", help=what)
    return made


def call_of(name: str, given: argparse.Namespace, words: Sequence[str] | None) -> Call:
    """The call that a parsed command line stands for."""
    out = given.out or (REPORTS / "quick" if given.quick else REPORTS)
    command = " ".join(["python -m", f"studies.{name}", *(sys.argv[1:] if words is None else words)])
    return Call(name, given.quick, out, given.redraw, command, tuple(getattr(given, "only", None) or ()))


def parse(name: str, description: str | None, words: Sequence[str] | None, parts: bool = False) -> Call:
    """Read the command line of a study that has the common options, and `--only` if it can measure parts again."""
    return call_of(name, parser(name, description, parts=parts).parse_args(words), words)


def main(work: Callable[[Sequence[str] | None], None], words: Sequence[str] | None = None) -> None:
    """Run `work(words)`; a `StudyError` and Ctrl-C end the process with one line and a status that is not 0."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("once", ConstraintWarning)
            work(words)
    except StudyError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        print("Interrupted. Finished runs are kept: the same command continues from them.", file=sys.stderr)
        sys.exit(130)


def stamp(command: str) -> str:
    """One line: command, date, commit, machine, versions."""
    versions = [f"{package} {version_of(package, '(not installed)')}" for package in PACKAGES]
    machine = f"{processor()}, {os.cpu_count()} cores"
    system = ", ".join([platform.system(), *generation(_cpuinfo()), f"Python {platform.python_version()}"])
    return "; ".join([f"`{command}`", date.today().isoformat(), f"commit {commit()}", machine, system, *versions])


def version_of(package: str, without: str = "not installed") -> str:
    """That of an installed package."""
    try:
        return version(package)
    except PackageNotFoundError:
        return without


def commit() -> str:
    """The commit of this checkout, and whether it has changes."""

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()

    try:
        if not CLONE:  # whatever repository the environment may stand in
            raise OSError
        changed = git("status", "--porcelain", "--", "twoloop", "references", "studies")
        return git("rev-parse", "--short=10", "HEAD") + (" with uncommitted changes" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown (not a git checkout)"


@cache
def processor() -> str:
    """The model of this machine's processor, as the system names it."""
    return named(_cpuinfo()) or platform.processor() or platform.machine()


def named(known: Mapping[str, str]) -> str:
    """Name a processor and its vectors; with family and model where it has no number: times of generations differ."""
    name, flags = known.get("model name", ""), known.get("flags", "").split()
    vectors = "AVX-512" if "avx512f" in flags else "AVX2" if "avx2" in flags else ""
    parts = [f"{name} with {vectors}" if name and vectors else name]
    if name and not any(map(str.isdigit, name)):
        parts += [f"({each.removeprefix('cpu ')})" for each in generation(known)]
    return " ".join(parts)


def generation(known: Mapping[str, str]) -> list[str]:
    """Family and model, where the name of the processor does not tell its generation ("AMD EPYC")."""
    keys = ("cpu family", "model")
    return [" ".join(f"{key} {known[key]}" for key in keys)] if all(key in known for key in keys) else []


def _cpuinfo() -> dict[str, str]:
    """What Linux says of its first processor."""
    try:
        first = Path("/proc/cpuinfo").read_text().split("\n\n")[0]
    except OSError:
        return {}
    lines = (line.partition(":") for line in first.splitlines())
    return {key.strip(): value.strip() for key, _, value in lines}


Item = TypeVar("Item")
PAUSE = 1.0  # s, at least, between lines that need not be printed: rows of milliseconds would flood a log


class Progress:
    """Print a line to stderr after each of `total` pieces of work: number, label, time, and remaining time.

    The remaining time assumes the mean time of the finished pieces without the first, which includes the compilation.
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
