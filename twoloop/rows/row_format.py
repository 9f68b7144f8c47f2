"""Format of rows: one solver at one setting on one mechanism, as a JSON object on a line of its own."""

import gzip
import json
import math
import re
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SCHEMA = 1
REACHED_END = "REACHED_END"
SETTINGS = ("tol", "h", "err_out")
LONGEST = 500  # characters of a text
LARGEST = 10**9  # bytes of a file, uncompressed, as a guard against decompression bombs
SHOWN = 20  # errors listed in an exception
IDENTITY = ("mechanism", "t_end", "solver", "version", "processor", "setting", "value")  # identifies a run

TEXT = "printable text"
TRIMMED = f"no blanks around it, at most {LONGEST} letters"
_NO_LETTER = re.compile("[^A-Z]+")

Row = dict[str, Any]


@dataclass(frozen=True)
class Field:
    """A field of a row.

    Attributes
    ----------
    expected : str
    holds : callable
        Predicate for valid JSON values.
    about : str
    needed : bool
        True if the field is mandatory. null is equivalent to a missing field.
    """

    expected: str
    holds: Callable[[Any], bool]
    about: str
    needed: bool = False


def _number(value: Any) -> bool:
    try:
        return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:  # an integer too large for a float
        return False


def _printable(value: Any) -> bool:
    return isinstance(value, str) and value.isprintable() and value != "" and len(value) <= LONGEST


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
    return isinstance(value, list) and all(_number(each) and each > 0 for each in value)


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


def mistakes(lines: Iterable[str]) -> tuple[list[Row], list[str]]:
    """Return the valid rows in lines of text, and the errors: line, field, given and expected value.

    Returns
    -------
    list of dict
        Rows of the lines without errors; null fields are omitted.
    list of str
    """
    rows, found, seen = [], [], dict[tuple[Any, ...], int]()
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        row, wrong = _row(line)
        if not wrong:
            key = tuple(row[name] for name in IDENTITY)
            first = seen.setdefault(key, number)
            if first != number:
                what = ", ".join(f"{name} {row[name]}" for name in IDENTITY)
                wrong = [f"the run of line {first} again ({what}); put the times of all repetitions into one row"]
        found += [f"line {number}: {each}" for each in wrong]
        rows += [] if wrong else [row]
    return rows, found


def _row(line: str) -> tuple[Row, list[str]]:
    """Return the row of a line, and its errors."""
    try:
        given = json.loads(line, object_pairs_hook=_once)
    except (ValueError, RecursionError) as error:
        return {}, [f"given {_shown(line.strip())}, expected a JSON object on a line of its own: {error}"]
    if not isinstance(given, dict):
        return {}, [f"given {_shown(given)}, expected a JSON object on a line of its own"]
    if not FIELDS["schema"].holds(given.get("schema")):
        said = f"given {_shown(given['schema'])}" if "schema" in given else "missing"
        return {}, [f"schema: {said}, expected {SCHEMA}, which this version of twoloop reads"]
    row = {name: value for name, value in given.items() if value is not None}
    wrong = [f"{name}: there is no such field; fields are {', '.join(FIELDS)}" for name in row if name not in FIELDS]
    wrong += [
        f"{name}: missing, expected {each.expected}" for name, each in FIELDS.items() if each.needed and name not in row
    ]
    wrong += [
        f"{name}: given {_shown(row[name])}, expected {_expected(name, row[name])}"
        for name, each in FIELDS.items()
        if name in row and not each.holds(row[name])
    ]
    return row, wrong or list(_joint_errors(row))


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
    unknown = "; leave out what is not known" if isinstance(given, float) and not math.isfinite(given) else ""
    return f"{FIELDS[name].expected}{unknown}"


def _once(pairs: list[tuple[str, Any]]) -> Row:
    made = dict(pairs)
    if len(made) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"{next(name for name in names if names.count(name) > 1)} stands twice")
    return made


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def read_lines(path: Path) -> list[str]:
    """Return the lines of a file, which may be compressed by gzip (.gz).

    Raises ValueError if it cannot be read.
    """
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            data = file.read(LARGEST + 1)
        if len(data) > LARGEST:
            raise ValueError(f"more than {LARGEST:.0e} bytes; divide it")
        return data.decode("utf-8-sig").split("\n")  # optional byte order mark
    except (OSError, EOFError, ValueError, zlib.error) as error:
        raise ValueError(f"{path} cannot be read: {error}") from None


def read_rows(path: Path) -> list[Row]:
    """Return the rows of a file.

    Raises ValueError if it cannot be read, has no rows, or a row is invalid.
    """
    rows, wrong = mistakes(read_lines(path))
    if wrong:
        more = [f"... and {len(wrong) - SHOWN} more"] if len(wrong) > SHOWN else []
        raise ValueError("\n".join([f"{path} is not in the format of rows:", *wrong[:SHOWN], *more]))
    if not rows:
        raise ValueError(f"{path} has no rows")
    return rows


def text_of(rows: Iterable[Row]) -> str:
    """Return rows as the lines of a file."""
    return "".join(json.dumps(row, separators=(",", ":"), ensure_ascii=False, allow_nan=False) + "\n" for row in rows)
