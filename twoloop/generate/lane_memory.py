"""Vectors of eight numbers in memory, whose places are counted in numbers; and sums and columns of such vectors."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from twoloop.generate.lane_emitter import LaneEmitter
from twoloop.generate.llvm_code import Emitter
from twoloop.generate.llvm_text import INTEGER, Value, integer
from twoloop.kernels.data.collocation import LANES


def place_of(emit: LaneEmitter, k: Value) -> Value:
    """The place of vector k."""
    return emit.builder.mul(k, integer(LANES))


def load_lanes(emit: LaneEmitter, base: Value, place: int = 0) -> Value:
    """A vector at a place, which is counted in numbers."""
    return Emitter(emit.builder).load_vector(base, place, LANES)


def store_lanes(emit: LaneEmitter, value: Value, base: Value, place: int = 0) -> None:
    """Put a vector at a place."""
    Emitter(emit.builder).store_vector(value, base, place)


def two_sums(emit: LaneEmitter, a: Value, b: Value) -> list[Value]:
    """The sums of the numbers of two vectors, which are added side by side."""
    builder, half = emit.builder, LANES // 2
    lower, upper = ([*range(k, k + half), *range(LANES + k, LANES + k + half)] for k in (0, half))
    total = emit.add(builder.shuffle(a, b, lower), builder.shuffle(a, b, upper))
    for distance in (2, 1):
        total = emit.add(total, builder.shuffle(total, total, [k ^ distance for k in range(LANES)]))
    return [builder.extract(total, k) for k in (0, half)]


def column(emit: LaneEmitter, vectors: Sequence[Value], lane: int) -> Value:
    """One lane of each of some vectors, side by side."""
    builder, places = emit.builder, [lane, LANES + lane]
    if len(vectors) == 1:
        return builder.extract(vectors[0], lane)
    while len(vectors) > 1:
        pairs = zip(vectors[::2], vectors[1::2], strict=True)
        vectors = [builder.shuffle(*pair, places) for pair in pairs]
        places = list(range(2 * len(places)))
    return vectors[0]


@contextmanager
def over(
    emit: LaneEmitter, coordinates: Sequence[int], carried: Sequence[Value] = ()
) -> Iterator[tuple[Value, Value, list[Any], list[Any]]]:
    """A loop over some coordinates: how many there were before, which it is, and as of `Emitter.loop`."""
    builder = emit.builder
    table = None if list(coordinates) == list(range(len(coordinates))) else builder.module.table(coordinates)
    with emit.loop(integer(0), integer(len(coordinates)), carried) as (k, values, new):
        i = k if table is None else builder.convert("sext", builder.load(builder.gep(table, k), 4), INTEGER)
        yield k, i, values, new
