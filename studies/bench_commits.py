"""Two commits side by side: what a step of each method and a start cost, repetitions interleaved.

    python -m studies.bench_commits BASE [--head COMMIT] [--short]

Each commit gets a work tree of its own, and a process that compiles its own kernels there (minutes, the first time);
without --head the second is the folder as it is. Time is CPU time of the process.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import median
from typing import Any

from studies.bench import cli
from studies.bench.cli import ROOT, StudyError
from studies.bench.render import number, table
from studies.bench_side import START

SIDE = Path(__file__).with_name("bench_side.py")
METHODS = ("Taylor", "Adams", "DOP853", "Gauss12", "SunRadau5", "RadauIIA5", "RadauIIA9", "BDF", "TRBDF2", "auto")
ROUNDS = 15
NOISE = 0.05  # medians that differ by less are called equal

Measured = dict[str, list[dict[str, Any]]]  # by method, the repetitions


def measure(folders: Mapping[str, Path], names: Sequence[str], rounds: int) -> dict[str, Measured]:
    """By side, what each repetition of each method took; the sides take turns, and who is first changes.

    Raises StudyError if a process ends before it has answered, with what it said.
    """
    measured: dict[str, Measured] = {side: {name: [] for name in names} for side in folders}
    with ExitStack() as stack:
        processes = {side: stack.enter_context(_process(folder)) for side, folder in folders.items()}
        for turn in range(rounds):
            for name in names:
                order = list(folders) if turn % 2 == 0 else list(folders)[::-1]
                for side in order if turn == 0 or name != START else ():
                    measured[side][name].append(_ask(side, processes[side], name))
    return measured


@contextmanager
def _process(folder: Path) -> Iterator[subprocess.Popen[str]]:
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "NUMBA_CACHE_DIR")}
    pipe = subprocess.PIPE
    process = subprocess.Popen(
        [sys.executable, str(SIDE), str(folder)], cwd=folder, env=environment, stdin=pipe, stdout=pipe, text=True
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        for stream in (process.stdin, process.stdout):
            if stream is not None:
                stream.close()


def _ask(side: str, process: subprocess.Popen[str], name: str) -> dict[str, Any]:
    question, answers = process.stdin, process.stdout
    assert question is not None and answers is not None
    try:
        question.write(f"{name}\n")
        question.flush()
        line = answers.readline()
    except BrokenPipeError:
        line = ""
    if not line:
        raise StudyError(f"the process of {side} ended without an answer to {name!r}; see its error above")
    return dict(json.loads(line))


def compared(measured: Mapping[str, Measured], sides: tuple[str, str]) -> Iterator[list[Any]]:
    """Lines of the table: method, medians of both sides in µs, their ratio, and counts of both."""
    for name in measured[sides[0]]:
        cells: list[Any] = [name]
        both = [measured[side][name] for side in sides]
        errors = [next((each["error"] for each in runs if "error" in each), "") for runs in both]
        if any(errors):
            yield [*cells, *(error.split(":")[0] or "ran" for error in errors), "–", "–"]
            continue
        times = [median(each["cpu"] for each in runs) for runs in both]
        ratio = times[1] / times[0] if times[0] else float("nan")
        verdict = "=" if abs(ratio - 1.0) < NOISE else number(ratio)
        old, new = (runs[-1]["counts"] for runs in both)
        before = {what: "" if old == new else f"{old.get(what, '–')} → " for what in new}
        counts = ", ".join(f"{before[what]}{value} {what}" for what, value in new.items())
        yield [*cells, *(number(1e6 * value) for value in times), verdict, counts or "–"]


@contextmanager
def work_tree(commit: str, repository: Path = ROOT) -> Iterator[Path]:
    """A work tree of the commit, removed at the end. Raises StudyError if git cannot make it."""
    with tempfile.TemporaryDirectory(prefix="twoloop-bench-") as parent:
        folder = Path(parent) / "tree"
        command = ["git", "-C", str(repository), "worktree"]
        made = subprocess.run([*command, "add", "--detach", str(folder), commit], capture_output=True, text=True)
        if made.returncode:
            said = (made.stderr.strip().splitlines() or ["git failed"])[-1]
            raise StudyError(f"there is no work tree of {commit!r}: {said}")
        try:
            yield folder
        finally:
            subprocess.run([*command, "remove", "--force", str(folder)], capture_output=True, check=True)


def _work(words: Sequence[str] | None) -> None:
    parser = argparse.ArgumentParser(prog="python -m studies.bench_commits", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("base", help="the commit to compare with")
    parser.add_argument("--head", help="the other commit; without it the folder as it is")
    parser.add_argument("--short", action="store_true", help="one round of one method")
    given = parser.parse_args(words)
    names, rounds = ((START, "Adams"), 1) if given.short else ((START, *METHODS), ROUNDS)
    with ExitStack() as stack:
        sides = (given.base, given.head or "here")
        if sides[0] == sides[1]:
            raise StudyError(f"base and head are the same, {given.base!r}")
        folders = {given.base: stack.enter_context(work_tree(given.base))}
        folders[sides[1]] = stack.enter_context(work_tree(given.head)) if given.head else ROOT
        measured = measure(folders, names, rounds)
    header = ["a step of", f"{sides[0]} (µs)", f"{sides[1]} (µs)", "ratio", "counts"]
    print(table(header, compared(measured, sides)))
    print(f"\nFour-bar, 10 s, tolerance 1e-8; medians of {rounds}, interleaved; =: within {100 * NOISE:g} %.")


if __name__ == "__main__":
    cli.main(_work)
