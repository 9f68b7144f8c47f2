"""Mutants of kernels: which single changes of an operator or a number do the tests of that kernel not detect?"""

import ast
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from studies.bench import study
from studies.bench.cli import ROOT, StudyError
from studies.bench.store import Output, Row

TESTS = {  # of a kernel whose change compiles nothing but itself, and what is run until a test fails
    "adams": ("tests/kernels/test_adams.py",),
    "bdf": ("tests/kernels/test_orders.py", "tests/kernels/test_bdf.py"),
    "explicit": (
        *("tests/kernels/test_error_estimate.py", "tests/kernels/test_orders.py", "tests/kernels/test_explicit.py"),
        *("tests/test_straight_line.py", "tests/studies/test_sharp.py"),
    ),
    "newmark": ("tests/kernels/test_newmark.py", "tests/kernels/test_orders.py", "tests/test_fixed_step.py"),
}
OF_PAPER = ("bdf", "newmark")  # kernels in twoloop/kernels/paper/; the others are in twoloop/kernels/steps/
IGNORED = shutil.ignore_patterns("*.partial.jsonl", "*.png", "*.svg")
FOLDERS = ("twoloop", "references", "studies", "tests", "pyproject.toml", "docs", "reports")
SEED, N_EACH, QUICK_EACH = 2016, 10, 1
TIME_LIMIT = 900.0  # s of the tests of a mutant, longer than they take on a busy machine; none has to end
NONE = "none"
ARGUED = tomllib.loads(Path(__file__).with_name("argued.toml").read_text())
SWAPPED = {ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*"}
COMPARED = {ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">", ast.Eq: "!=", ast.NotEq: "=="}
SIGNS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Lt: "<", ast.LtE: "<="}
SIGNS |= {ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}


@dataclass(frozen=True)
class Mutant:
    """One change of one place of a file: characters `begin` to `end` of a line become `new`."""

    kernel: str  # whose file is KERNEL_step.py, see `file_of`
    line: int
    begin: int
    end: int
    old: str
    new: str
    text: str  # the line as it is

    @property
    def name(self) -> str:
        return f"{self.kernel}.py:{self.line}:{self.begin} {self.old} -> {self.new}"

    def applied(self, source: str) -> str:
        """The file with the change."""
        lines = source.splitlines(keepends=True)
        line = lines[self.line - 1]
        lines[self.line - 1] = line[: self.begin] + self.new + line[self.end :]
        return "".join(lines)


def file_of(folder: Path, kernel: str) -> Path:
    """The file of a kernel in a folder with the project."""
    return folder / "twoloop" / "kernels" / ("paper" if kernel in OF_PAPER else "steps") / f"{kernel}_step.py"


def mutants_of(kernel: str, source: str) -> Iterator[Mutant]:
    """All of a file: operators and comparisons swapped, numbers one larger or doubled, "and" for "or"."""
    lines = source.splitlines()

    def between(left: ast.expr, right: ast.expr, old: str, new: str) -> Iterator[Mutant]:
        if left.end_lineno == right.lineno and left.end_col_offset is not None:
            text = lines[right.lineno - 1]
            begin = text.find(old, left.end_col_offset, right.col_offset)
            if begin >= 0:
                yield Mutant(kernel, right.lineno, begin, begin + len(old), old, new, text.strip())

    for function in (node for node in ast.parse(source).body if isinstance(node, ast.FunctionDef)):
        if not function.decorator_list:  # not compiled
            continue
        for node in ast.walk(ast.Module(function.body, [])):
            if isinstance(node, ast.BinOp) and type(node.op) in SWAPPED:
                yield from between(node.left, node.right, SIGNS[type(node.op)], SWAPPED[type(node.op)])
            elif isinstance(node, ast.Compare) and type(node.ops[0]) in COMPARED:
                kind = type(node.ops[0])
                yield from between(node.left, node.comparators[0], SIGNS[kind], COMPARED[kind])
            elif isinstance(node, ast.BoolOp):
                old, new = ("and", "or") if isinstance(node.op, ast.And) else ("or", "and")
                yield from between(node.values[0], node.values[1], old, new)
            elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
                text, old = lines[node.lineno - 1], ast.get_source_segment(source, node) or ""
                value: Any = node.value
                new = repr(value + 1) if isinstance(value, int) else repr(value * 2.0 or 1.0)
                begin = node.col_offset
                yield Mutant(kernel, node.lineno, begin, begin + len(old), old, new, text.strip())


def sample(quick: bool) -> list[Mutant]:
    """The same mutants every time, as many of each file."""
    chosen = []
    for kernel in TESTS:
        found = list(mutants_of(kernel, file_of(ROOT, kernel).read_text()))
        chosen += random.Random(SEED).sample(found, QUICK_EACH if quick else N_EACH)
    return chosen


def first_failure(folder: Path, tests: Sequence[str]) -> str:
    """The first test that fails in a process of its own, "" if none does; a crash and a time limit count as one."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist", *tests]
    process = subprocess.Popen(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )
    try:
        text, _ = process.communicate(timeout=TIME_LIMIT)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return "time limit of the tests"
    if process.returncode == 0:
        return ""
    failed = [line.split(" ")[1] for line in text.splitlines() if line.startswith(("FAILED ", "ERROR "))]
    return failed[0] if failed else f"the process ended with {process.returncode}"


def row_of(mutant: Mutant, folder: Path) -> Row:
    """A mutant, and the test that sees it."""
    path, began = file_of(folder, mutant.kernel), time.monotonic()
    sound = path.read_text()
    try:
        path.write_text(mutant.applied(sound))
        seen = first_failure(folder, TESTS[mutant.kernel])
    finally:
        path.write_text(sound)
    row: Row = {"kernel": mutant.kernel, "line": mutant.line, "place": mutant.begin, "text": mutant.text}
    row |= {"old": mutant.old, "new": mutant.new, "seen_by": seen or NONE}
    return row | {"seconds": time.monotonic() - began}


def make(output: Output) -> pd.DataFrame:
    """Make all rows, those of each kernel in a copy of the repository, side by side."""
    chosen, lock = sample(output.call.quick), threading.Lock()
    with output.kept() as kept, tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(len(TESTS)) as pool:

        def work(kernel: str) -> str:
            todo = [mutant for mutant in chosen if mutant.kernel == kernel and mutant.name not in kept]
            folder = Path(name) / kernel
            if not todo:
                return ""
            for source in (ROOT / each for each in FOLDERS):  # with the compiled kernels, which one change leaves valid
                if source.is_dir():
                    shutil.copytree(source, folder / source.name, ignore=IGNORED)
                elif source.is_file():
                    shutil.copy2(source, folder / source.name)
            for mutant in todo:
                row = row_of(mutant, folder)
                with lock:
                    kept.add(mutant.name, row)
            return first_failure(folder, TESTS[kernel])  # without one

        for kernel, found in zip(TESTS, pool.map(work, TESTS), strict=True):
            if found:
                raise StudyError(f"the tests of {kernel}.py fail without a mutant: {found}")
        return pd.DataFrame([kept[mutant.name] for mutant in chosen])


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """What planted_errors.md says: how many are seen, and which are not."""
    survivors = rows[rows["seen_by"] == NONE]
    seen = (rows["seen_by"] != NONE).groupby(rows["kernel"], sort=False)
    kernels = {str(kernel): {"n": len(own), "seen": int(own.sum())} for kernel, own in seen}
    places = survivors[["line", "kernel", "text", "old", "new"]].astype(str).to_dict("records")
    for place in places:
        place["why"] = ARGUED.get(" | ".join(place[key] for key in ("kernel", "text", "old", "new")), "")
    return {"n": len(rows), "seen": len(rows) - len(survivors), "kernels": kernels, "survivors": places}


def report(output: Output, rows: pd.DataFrame, line: str) -> None:
    made = line.replace("studies.mutants", "studies.planted_errors.mutants")
    output.save_findings(findings_of(rows) | {"made": made})


def main(words: Sequence[str] | None = None) -> None:
    study.run_rows("mutants", __doc__, words, make, report)


if __name__ == "__main__":
    main()
