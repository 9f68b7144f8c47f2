"""Stages of an explicit Runge-Kutta method in lanes, as code: sums of accelerations, and estimates of the error.

Velocities of stages are sums of accelerations, so that positions are such sums, too, with the weights A A: both are
made of the same accelerations, which are read once. Weights stand in the code, and those that are zero do not.
"""

import math

import numpy as np
from numpy.typing import NDArray

from twoloop.generate.lane_emitter import LaneEmitter
from twoloop.generate.lane_steps import Places, common
from twoloop.generate.llvm_text import Value, integer
from twoloop.kernels.lanes import lane_room as lanes

Array = NDArray[np.float64]

NOTHING = 1e-13  # of products of weights, what rounding leaves of zero


# A, b and c of an explicit method whose first stage is the state itself, and weights of two estimates of its error
Tableau = tuple[Array, Array, Array, Array, Array]


class LaneStages:
    """Writes the stages of a method with a tableau, for a mechanism of n coordinates."""

    def __init__(self, tableau: Tableau, n: int):
        self.tableau, self.n = tableau, n

    @property
    def structure(self) -> list[bytes]:
        """What the code depends on."""
        return [np.asarray(each).tobytes() for each in self.tableau]

    def write(self, emit: LaneEmitter, arguments: tuple[Value, Value, Value], at: Places) -> None:
        """NEW, X after the beginning of the step, and ERROR, if that is the whole step; FINE where it could be done."""
        A, b, c, fine, coarse = self.tableau
        _, control, room = arguments
        x, t = emit.load(room, lanes.X), emit.load(room, lanes.T)
        for i in range(1, len(b)):
            ahead = emit.add(t, emit.multiply(emit.constant(c[i]), x))
            emit.store(ahead, room, lanes.AHEAD)
            with emit.loop(integer(0), integer(self.n), []) as (j, _, _):
                own = _Coordinate(self, emit, at, j, i)
                own.move(A[i], A[i] @ A, x)
            emit.builder.run("there", arguments)
        rtol, zero = common(emit, control, lanes.RTOL), emit.constant(0.0)
        with emit.loop(integer(0), integer(self.n), [zero, zero, zero]) as (j, (e, d, total), new):
            own = _Coordinate(self, emit, at, j, len(b))
            moved = own.move(b, b @ A, x)
            place = emit.builder.gep(control, emit.builder.add(j, integer(lanes.ATOL)))
            atol = emit.splat(emit.builder.load(place))
            shares = [own.share(atol, rtol, *each) for each in zip(own.before, moved, strict=True)]
            for largest, weights in ((e, fine), (d, coarse)):
                of_q, of_v = emit.multiply(x, own.sum(weights @ A)), own.sum(weights)
                for off, share in zip((of_q, of_v), shares, strict=True):
                    largest = emit.larger(emit.multiply(emit.function("fabs", off), share), largest)
                    total = emit.add(total, emit.multiply(zero, off))
                new.append(largest)
            for each in moved:
                total = emit.add(total, emit.multiply(zero, each))
            new.append(total)
        e, d, total = (*(emit.multiply(x, each) for each in new[:2]), new[2])
        ratio = emit.divide(d, e)
        error = emit.divide(e, emit.function("sqrt", emit.add(emit.constant(1.0), emit.multiply(ratio, ratio))))
        select, compare = emit.builder.select, emit.builder.compare
        error = select(compare("fcmp ogt", e, zero), error, zero)
        error = select(compare("fcmp oeq", total, zero), error, emit.constant(math.inf))  # a NaN is no maximum
        emit.store(error, room, lanes.ERROR)


class _Coordinate:
    """One of the coordinates, in the loop over them, with the accelerations of so many stages."""

    def __init__(self, stages: LaneStages, emit: LaneEmitter, at: Places, j: Value, count: int):
        n, self.emit, self.new, self.n = stages.n, emit, emit.pointer(at.new, j), stages.n
        memory = emit.pointer(at.series, j)
        self.before = tuple(emit.load(memory, lanes.BEGIN * n + place) for place in (0, n))
        self._slopes = [(memory, (lanes.SLOPES + k) * n) for k in range(count)]
        self._loaded: dict[int, Value] = {}
        if count > 1:  # the last one was just found
            self._loaded[count - 1] = emit.load(emit.pointer(at.a, j))
            emit.store(self._loaded[count - 1], *self._slopes[count - 1])

    def sum(self, weights: Array) -> Value:
        """The sum of weights times accelerations."""
        total: Value | None = None
        for k, weight in enumerate(weights.tolist()):
            if abs(weight) > NOTHING:
                if k not in self._loaded:
                    self._loaded[k] = self.emit.load(*self._slopes[k])
                term = self.emit.multiply(self.emit.constant(weight), self._loaded[k])
                total = term if total is None else self.emit.add(total, term)
        return self.emit.constant(0.0) if total is None else total

    def share(self, atol: Value, rtol: Value, one: Value, other: Value) -> Value:
        """One over what an error may be, of a number that was one and is another."""
        emit = self.emit
        size = emit.larger(emit.function("fabs", one), emit.function("fabs", other))
        return emit.divide(emit.constant(1.0), emit.add(atol, emit.multiply(rtol, size)))

    def move(self, weights: Array, twice: Array, x: Value) -> tuple[Value, Value]:
        """NEW: the position and the velocity by weights of velocities, and by those of accelerations for positions."""
        emit, (q, v) = self.emit, self.before
        drift = emit.multiply(emit.constant(float(weights.sum())), v)
        q = emit.add(q, emit.multiply(x, emit.add(drift, emit.multiply(x, self.sum(twice)))))
        v = emit.add(v, emit.multiply(x, self.sum(weights)))
        for value, place in ((q, 0), (v, self.n)):
            emit.store(value, self.new, place)
        return q, v
