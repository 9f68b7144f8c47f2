"""Exchange format of rows: one solver at one setting on one mechanism, as a JSON object on a line of its own."""

import gzip
import json
import math
import re
import time
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

# The calibration is timed along with solver calls, which makes times on different machines comparable: steps of the
# classical Runge-Kutta method on a pendulum with its multiplier. Like a solver in Python, it spends its time in calls
# and small arrays; it does not depend on the version of a solver. Machine code scales differently between processors,
# and versions of Python differ in speed: rows contain both.
CALIBRATION = "rk4-pendulum-1"  # rename whenever `calibration_s` changes
STEPS = 200
REPEATS = 3  # the fastest counts

SCHEMA = 1
REACHED_END = "REACHED_END"
SETTINGS = ("tol", "h", "err_out")
MAX_CHARACTERS = 500  # characters of a text
MAX_BYTES = 10**9  # bytes of a file, uncompressed, as a guard against decompression bombs
MAX_ERRORS = 20  # errors listed in an exception
IDENTITY = ("mechanism", "t_end", "solver", "version", "processor", "setting", "value")  # identifies a run

TEXT = "printable text"
TRIMMED = f"no blanks around it, at most {MAX_CHARACTERS} letters"
_NO_LETTER = re.compile("[^A-Z]+")

Row = dict[str, Any]


def _rate(state: NDArray[np.float64]) -> NDArray[np.float64]:
    q, v = state[:2], state[2:]
    matrix = np.array([[1.0, 0.0, q[0]], [0.0, 1.0, q[1]], [q[0], q[1], 0.0]])
    return np.concatenate([v, np.linalg.solve(matrix, np.array([0.0, -9.81, -(v @ v)]))[:2]])


def calibration_s() -> float:
    """Return the CPU time of the calibration, s: the minimum of three repetitions."""
    times = []
    for _ in range(REPEATS):
        state, h, began = np.array([1.0, 0.0, 0.0, 0.0]), 0.01, time.process_time()
        for _ in range(STEPS):
            first = _rate(state)
            second = _rate(state + 0.5 * h * first)
            third = _rate(state + 0.5 * h * second)
            state = state + h / 6.0 * (first + 2.0 * (second + third) + _rate(state + h * third))
        times.append(time.process_time() - began)
    return min(times)


@dataclass(frozen=True)
class Field:
    """A field of a row; null is equivalent to a missing field."""

    expected: str
    holds: Callable[[Any], bool]  # predicate for valid JSON values
    about: str
    needed: bool = False


def _number(value: Any) -> bool:
    try:
        return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:  # an integer too large for a float
        return False


def _printable(value: Any) -> bool:
    return isinstance(value, str) and value.isprintable() and value != "" and len(value) <= MAX_CHARACTERS


def _name(value: Any) -> bool:
    return _printable(value) and value == value.strip()


def _text(about: str, needed: bool = False) -> Field:
    return Field(TEXT, _name, about, needed)


def _status(value: Any) -> bool:  # reject other spellings, which would count as failures
    return _name(value) and (value == REACHED_END or _NO_LETTER.sub("_", value.upper()) != REACHED_END)


def _positive(about: str, needed: bool = False) -> Field:
    return Field("a number > 0", lambda value: _number(value) and value > 0, about, needed)


def _size(about: str) -> Field:
    return Field("a number >= 0", lambda value: _number(value) and value >= 0, about)


def _flag(about: str) -> Field:
    return Field("true or false", lambda value: isinstance(value, bool), about)


def _times(value: Any) -> bool:
    return isinstance(value, list) and all(_number(time) and time > 0 for time in value)


FIELDS: dict[str, Field] = {
    "schema": Field(
        f"{SCHEMA}", lambda value: value == SCHEMA and not isinstance(value, bool), "version of this format", True
    ),
    "mechanism": _text("a ready mechanism by its function, `four_bar`, or a name of yours", True),
    "t_end": _positive("end of the motion, s, from 0", True),
    "solver": _text("as tables show it", True),
    "family": _text("whose it is: `two-loop`, `SciPy`, your project", True),
    "version": _text("of the solver: a release or a commit", True),
    "processor": _text("model, on which it ran", True),
    "setting": Field(f"one of {', '.join(SETTINGS)}", lambda value: value in SETTINGS, "the number that varies", True),
    "value": _positive("of the setting; of `h` in s", True),
    "status": Field(TEXT, _status, f"`{REACHED_END}`, as it stands here, or what happened instead", True),
    "message": Field(TEXT, _printable, "why, where the end was not reached"),
    "times_s": Field("a list of numbers > 0", _times, "CPU times of whole calls, s, one a repetition", True),
    "calibration": _text("what was timed beside the calls, by name and version"),
    "calibration_s": _positive("its CPU time, s, in the same process"),
    "error": _size("largest |q - q_ref| over the motion, of a coordinate, m or rad"),
    "floor": _size("what the reference of `error` resolves"),
    "error_end": _size("largest |q - q_ref| at `t_end`, over max(1, max |q_ref|)"),
    "floor_end": _size("what the reference of `error_end` resolves"),
    "evaluations": _size("of the forces, or of the accelerations"),
    "called_from": Field(
        "compiled or Python", lambda value: value in ("compiled", "Python"), "what calls the equations"
    ),
    "keeps_constraints": _flag("whether positions are kept on the constraints"),
    "astray": _flag("whether the run lost the motion"),
    "used": _text("the method taken, of a solver that chooses"),
    "violation_q": _size("largest |C| of the run"),
    "violation_v": _size("largest |C_q v + C_t|"),
    "energy": _size("largest change of a conserved energy, J"),
    "error_v": _size("largest error of a velocity over the motion"),
    "error_lam": _size("largest error of a multiplier over the motion"),
    "python": _text("version of Python"),
    "date": _text("of the run"),
}


def find_errors(lines: Iterable[str]) -> tuple[list[Row], list[str]]:
    """Return the rows of lines without errors, without null fields, and the errors: line, field, given and expected."""
    rows, errors, first_lines = [], [], dict[tuple[Any, ...], int]()
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        row, row_errors = _parse_row(line)
        if not row_errors:
            key = tuple(row[name] for name in IDENTITY)
            first = first_lines.setdefault(key, number)
            if first != number:
                identity = ", ".join(f"{name} {row[name]}" for name in IDENTITY)
                row_errors = [
                    f"the run of line {first} again ({identity}); put the times of all repetitions into one row"
                ]
        errors += [f"line {number}: {error}" for error in row_errors]
        rows += [] if row_errors else [row]
    return rows, errors


def _parse_row(line: str) -> tuple[Row, list[str]]:
    """Return the row of a line, and its errors."""
    try:
        fields = json.loads(line, object_pairs_hook=_unique_fields)
    except (ValueError, RecursionError) as error:
        return {}, [f"given {_format_value(line.strip())}, expected a JSON object on a line of its own: {error}"]
    if not isinstance(fields, dict):
        return {}, [f"given {_format_value(fields)}, expected a JSON object on a line of its own"]
    if not FIELDS["schema"].holds(fields.get("schema")):
        value = f"given {_format_value(fields['schema'])}" if "schema" in fields else "missing"
        return {}, [f"schema: {value}, expected {SCHEMA}, which this version of twoloop reads"]
    row = {name: value for name, value in fields.items() if value is not None}
    errors = [f"{name}: there is no such field; fields are {', '.join(FIELDS)}" for name in row if name not in FIELDS]
    missing = [name for name, field in FIELDS.items() if field.needed and name not in row]
    errors += [f"{name}: missing, expected {FIELDS[name].expected}" for name in missing]
    errors += [
        f"{name}: given {_format_value(row[name])}, expected {_expected(name, row[name])}"
        for name, field in FIELDS.items()
        if name in row and not field.holds(row[name])
    ]
    return row, errors or list(_joint_errors(row))


def _joint_errors(row: Row) -> Iterable[str]:
    """Yield violations of conditions that involve several fields."""
    for error, floor in (("error", "floor"), ("error_end", "floor_end")):
        if error in row and floor not in row:
            yield f"{floor}: missing, expected a number >= 0 beside {error}"
    if ("calibration" in row) != ("calibration_s" in row):
        yield "calibration: expected beside calibration_s, and neither without the other"
    if row["status"] != REACHED_END:
        return
    if not row["times_s"]:
        yield f"times_s: given [], expected a time at least of a run that is {REACHED_END}"
    if "error" not in row and "error_end" not in row:
        yield f"error: missing, expected it, or error_end, of a run that is {REACHED_END}"


def _expected(name: str, given: Any) -> str:
    """Return the expected value of a field, with a hint for similar values."""
    if name == "status" and _name(given):
        return f"{REACHED_END} in these letters, or what happened instead"
    if isinstance(given, str) and FIELDS[name].expected == TEXT:
        return f"{TEXT}, {TRIMMED}"
    hint = "; leave out what is not known" if isinstance(given, float) and not math.isfinite(given) else ""
    return f"{FIELDS[name].expected}{hint}"


def _unique_fields(pairs: list[tuple[str, Any]]) -> Row:
    fields = dict(pairs)
    if len(fields) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"{next(name for name in names if names.count(name) > 1)} stands twice")
    return fields


def _format_value(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def read_lines(path: Path) -> list[str]:
    """Return the lines of a file, which may be compressed by gzip (.gz); raise ValueError if it cannot be read."""
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise ValueError(f"more than {MAX_BYTES:.0e} bytes; divide it")
        return data.decode("utf-8-sig").split("\n")  # optional byte order mark
    except (OSError, EOFError, ValueError, zlib.error) as error:
        raise ValueError(f"{path} cannot be read: {error}") from None


def read_rows(path: Path) -> list[Row]:
    """Return the rows of a file; raise ValueError if it cannot be read, has no rows, or a row is invalid."""
    rows, errors = find_errors(read_lines(path))
    if errors:
        remainder = [f"... and {len(errors) - MAX_ERRORS} more"] if len(errors) > MAX_ERRORS else []
        raise ValueError("\n".join([f"{path} is not in the format of rows:", *errors[:MAX_ERRORS], *remainder]))
    if not rows:
        raise ValueError(f"{path} has no rows")
    return rows


def format_rows(rows: Iterable[Row]) -> str:
    """Return rows as the lines of a file."""
    return "".join(json.dumps(row, separators=(",", ":"), ensure_ascii=False, allow_nan=False) + "\n" for row in rows)
