"""The series of one mechanism as code compiled for it: the same numbers as by the program, in two thirds of the time.

What the program looks up at every order, which quantity times which coefficient, stands in the code. It is kept in a
file by its content, and its machine code as that of the kernels.
"""

import hashlib
from functools import cache
from typing import Any

from numba.core.dispatcher import Dispatcher

from twoloop.caches import compile_kept, sources_folder
from twoloop.generated import module_of
from twoloop.series import SeriesProgram, Sums, Table
from twoloop.tracing import (
    ARCTANGENT,
    EXPONENTIAL,
    LOGARITHM,
    PENDING,
    PRODUCT,
    RECIPROCAL,
    SINE,
    SQUARE_ROOT,
)

LARGEST = 200  # operations; more take longer than ten seconds to compile, and gain little

# what an operation o of order K makes of its arguments u and z, of `total` and of what is known of order 0
RECURRENCES = {
    PENDING: ("{r} = {total} + u * {y0}",),
    PRODUCT: ("{y} = {z}", "{r} = {total} + {x0} * {y} + u * {y0}"),
    RECIPROCAL: ("{r} = -({total} + u * {y0}) * {y0}", "{y} = {r}"),
    SQUARE_ROOT: ("{r} = 0.5 * (u - {total}) / {x0}", "{x} = {r}", "{y} = {r}"),
    EXPONENTIAL: ("{x} = {K} * u", "{r} = ({total} + {x} * {y0}) * {inverse}", "{y} = {r}"),
    LOGARITHM: ("{y} = {z}", "{r} = (u - {total} * {inverse}) / {y0}", "{x} = {K} * {r}"),
}
RECURRENCES[ARCTANGENT] = RECURRENCES[LOGARITHM]

FRAME = """
def expand(f, w, options, memory, t, unit, tolerances, state, new_state):
    n, n_rows, order = {n}, {n_rows}, int(options[ORDER])
    N, X1, Y1, X2, Y2, total1, total2, r, c = arrays_of(options, memory, n, n_rows)
    series = series_of(memory, order, n, memory[TARGET])
    begin_series(options, t, unit, state, N, series, {first}, X1[0], Y1[0], r, c)
    for k in range(order - 1):
        K = k + 1
        scale, inverse_k, inverse_K = -K / unit, 1.0 / max(k, 1), 1.0 / K
        n_k, n_K, x1, y1, x2, y2 = N[k], N[K], X1[K], Y1[K], X2[k], Y2[k]
        if K > 1:
            n_K[0] = 0.0
        interior(X1, Y1, K, total1)
        {early}
        {rows}
        if k == 0:
            begin_operations(options, LATE, n_k, N[0, {second}:], X2[0], Y2[0])
        else:
            interior(X2, Y2, k, total2)
            {late}
        {balance}
        if k == 0:
            {constants}
        a, lam = n_k[{A} : {LAM}], n_k[{LAM} : {first}]
        if w.rows_v.size < n_rows:
            lam[:] = 0.0
        solve_for_order(f, w, r, c, a, lam)
        take_order(w, K, unit, N, series, a)
        {seconds}
    return end_series(w, order, series), 0.0
"""


def source_of(program: SeriesProgram) -> str:
    """The code for a program.

    Raises
    ------
    ValueError
        If it would be too long to compile.
    """
    size = program.n_operations
    if size > LARGEST:
        raise ValueError(
            f"compiled=True is for equations of at most {LARGEST} operations; these are {size}. Leave it out"
        )
    n, n_rows = program.n_q, program.n_rows
    first = 1 + 3 * n + n_rows
    second = first + len(program.early.first.column)
    early = _operations(program.early, first, "K", "n_K", "1")
    late = _operations(program.late, second, "k", "n_k", "2")
    seconds = [*_forms(program.early, "n_K", "1"), *_forms(program.late, "n_k", "2")]
    constants = zip(program.balance_places, program.balance.constant, strict=True)
    return FRAME.format(
        n=n,
        n_rows=n_rows,
        first=first,
        second=second,
        A=1 + 2 * n,
        LAM=1 + 3 * n,
        early=_lines(early, 2),
        rows=_lines(_all(program.rows, program.row_places, "n_K", "c", "scale * "), 2),
        late=_lines(late, 3),
        balance=_lines(_all(program.balance, program.balance_places, "n_k", "r", ""), 2),
        constants=_lines([f"r[{i}] += {float(value)!r}" for i, value in constants if value != 0.0], 3),
        seconds=_lines(seconds, 2),
    )


def _lines(lines: list[str], depth: int) -> str:
    return ("\n" + 4 * depth * " ").join(lines or ["pass"])


def _terms(sums: Sums, o: int, row: int) -> list[tuple[int, float]]:
    more = [(c, x) for k, c, x in zip(sums.row, sums.more_column, sums.more_coefficient, strict=True) if k == row]
    every = [(sums.column[o], sums.coefficient[o]), *more]
    return [(int(column), float(coefficient)) for column, coefficient in every if coefficient != 0.0]


def _text(terms: list[tuple[int, float]], values: str) -> str:
    signs = {1.0: "", -1.0: "-"}
    parts = [f"{signs.get(x, f'{x!r} * ')}{values}[{column}]" for column, x in terms]
    return " + ".join(parts) or "0.0"


def _operations(table: Table, base: int, order: str, values: str, number: str) -> list[str]:
    """Order K or k of the operations of a table; `base` is the quantity that the first makes."""
    lines = []
    for kind, first, last in table.groups[:, :3].tolist():
        half = (last - first) // 2 if kind == SINE else last - first
        for o in range(first, first + half):
            u = _text(_terms(table.first, o, o), values)
            if kind == SINE:
                p = o + half
                lines += [
                    f"u = {order} * ({u})",
                    f"x{number}[{o}] = x{number}[{p}] = u",
                    f"sine = (total{number}[{o}] + u * Y{number}[0, {o}]) * inverse_{order}",
                    f"cosine = (total{number}[{p}] + u * Y{number}[0, {p}]) * inverse_{order}",
                    f"{values}[{base + o}], {values}[{base + p}] = sine, cosine",
                    f"y{number}[{o}], y{number}[{p}] = cosine, -sine",
                ]
                continue
            names = {
                "x": f"x{number}[{o}]",
                "y": f"y{number}[{o}]",
                "x0": f"X{number}[0, {o}]",
                "y0": f"Y{number}[0, {o}]",
                "total": f"total{number}[{o}]",
                "r": f"{values}[{base + o}]",
                "z": _text(_terms(table.second, o, o), values),
                "K": order,
                "inverse": f"inverse_{order}",
            }
            lines += [f"u = x{number}[{o}] = {u}", *(line.format(**names) for line in RECURRENCES[kind])]
    return lines


def _forms(table: Table, values: str, number: str) -> list[str]:
    """The second factors of the products that wait."""
    _, first, last = table.groups[-1, :3].tolist()
    return [f"y{number}[{o}] = {_text(_terms(table.second, o, o), values)}" for o in range(first, last)]


def _all(sums: Sums, places: Any, values: str, out: str, scale: str) -> list[str]:
    terms = [(place, _terms(sums, o, place)) for o, place in enumerate(places.tolist())]
    return [f"{out}[{place}] = {scale}({_text(each, values)})" for place, each in terms]


@cache
def compiled_series(source: str) -> Dispatcher:
    """The code, compiled as a step is; its machine code is kept on disk."""
    from twoloop.kernels import common, taylor
    from twoloop.linking import VectorizingCompiler

    key = hashlib.sha256(source.encode()).hexdigest()[:32]
    path = sources_folder() / f"series_{key}.py"
    missing = not path.exists() or path.read_text(encoding="utf-8") != source
    function = module_of(f"twoloop_series_{key}", path, source, missing, vars(taylor))["expand"]
    stamp = (common.stamp("taylor"), "")
    return compile_kept(function, common.STEP, stamp, pipeline_class=VectorizingCompiler, **common.OPTIONS)
