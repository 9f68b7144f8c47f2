"""Code for steps by collocation: the stages of a step side by side, one in each lane of a vector.

An implicit Runge-Kutta step whose stages are found by fixed-point iteration evaluates all of them anew in each sweep,
none of which waits for another: one sweep takes little longer than one evaluation. Accelerations depend on some
coordinates only, mostly; those are iterated, and the others follow from the accelerations at the end. Then states at
the ends of eight steps are moved to the constraints side by side, too.

The functions work in a memory that kernels/data/collocation.py describes; kernels/steps/lobatto_step.py calls them.
"""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.generate import lane_emitter, llvm_code, lobatto_tables
from twoloop.generate.accelerations import write_accelerations
from twoloop.generate.lane_emitter import LaneEmitter
from twoloop.generate.llvm_code import Emitter
from twoloop.generate.llvm_text import BIT, DOUBLE, INTEGER, Module, Value, constant, constants, integer
from twoloop.generate.lobatto_tables import tables
from twoloop.generate.straight_code import OwnCode, SharedCode
from twoloop.generate.straight_line import Outputs
from twoloop.generate.written import conditions_hold, results_of
from twoloop.kernels.compile.dependencies import digest_of
from twoloop.kernels.compile.own_functions import LaterFunctions, own_functions
from twoloop.kernels.data import collocation as at
from twoloop.kernels.data.collocation import LANES
from twoloop.kernels.data.tolerances import ATOL, ESTIMATE, RTOL

Array = NDArray[np.float64]
LONGEST = 8000  # operations of a projection
SMALLEST = 1e-300  # in place of a coefficient of zero
FAILED = -1.0  # what a sweep gives in place of a change where accelerations cannot be had


def suits(own: SharedCode) -> bool:
    """Whether the code of a mechanism takes no longer than some seconds to compile."""
    return len(own.equations.nearer.quantities(own.equations.graph)) <= LONGEST


class CollocationCode:
    """Writes the functions for a mechanism.

    Parameters
    ----------
    own : SharedCode

    Attributes
    ----------
    iterated : list of int
        Coordinates on which accelerations depend.
    numbers : Coefficients
        What the functions read.
    structure : str
        What the functions depend on, the values of these apart.
    """

    def __init__(self, own: SharedCode):
        self.equations, self.numbers, self.parts = own.equations, own.numbers, own.parts
        self.n, self.n_rows = self.equations.system.n_q, len(self.equations.all_rows)
        self.iterated = self._iterated()
        self.others = [i for i in range(self.n) if i not in self.iterated]
        self.a, self.q, self.v, self.polynomials, self.ends, self.end_a, self.lam, self.size = at.places(
            self.n, len(self.iterated), self.n_rows
        )

        if self.parts is None:
            outputs = [*self.equations.accelerations, self.equations.closer, self.equations.nearer]
        else:  # the digest of `own` tells the others
            outputs = self.equations.accelerations[:1]
        graph, numbers = self.equations.graph, self.numbers
        told = [[each.sizes, *numbers.structure(graph, each.forms)] for each in outputs]
        self.structure = hashlib.sha256(repr([own.digest, told]).encode()).hexdigest()

    def _iterated(self) -> list[int]:
        graph, forms = self.equations.graph, []
        for outputs in self.equations.accelerations:
            forms += outputs.forms
            forms += [form for i in outputs.quantities(graph) for form in graph.arguments(i)]
        found = {i for form in forms for i in form.terms if graph.operations[i] is None}
        return sorted({(i - 1) % self.n for i in found if i > 0})

    # the functions

    def begin(self, emit: LaneEmitter, room: Value, state: Value, tolerances: Value) -> None:
        """Weights of errors, accelerations as predicted, positions and velocities at the nodes by these.

        Errors are relative to what positions and velocities are at the beginning, or what half a step adds if that is
        more. Where no error is estimated, they are relative, of values below 1 absolute.
        """
        builder, one, n = emit.builder, Emitter(emit.builder), self.n
        fixed = builder.compare("fcmp oeq", one.load(tolerances, ESTIMATE), llvm_code.ZERO)
        h, rtol = one.load(room, at.H), builder.select(fixed, llvm_code.ONE, one.load(tolerances, RTOL))
        half = one.multiply(h, constant(DOUBLE, 0.5))
        with one.loop(integer(0), integer(n), [llvm_code.ZERO]) as (i, (most,), new):
            q, v, a = (one.function("fabs", one.load(one.pointer(state, i), m * n)) for m in range(3))
            q, v = (_larger(one, each, one.multiply(half, slope)) for each, slope in ((q, v), (v, a)))
            atol = builder.select(fixed, llvm_code.ONE, one.load(one.pointer(tolerances, i), ATOL))
            of_v, of_q = (one.add(atol, one.multiply(rtol, each)) for each in (v, q))
            of_q = one.divide(of_q, h)
            least = builder.select(builder.compare("fcmp olt", of_v, of_q), of_v, of_q)
            weight = one.divide(llvm_code.ONE, _larger(one, least, constant(DOUBLE, SMALLEST)))
            one.store(weight, one.pointer(room, i), at.WEIGHTS)
            new.append(_larger(one, weight, most))
        (of_all,) = new
        x = one.divide(h, one.load(room, at.H_BEFORE))
        powers = [x]
        while len(powers) < LANES:
            powers.append(one.multiply(powers[-1], x))
        powers_vector = emit.vector(powers)
        _put(emit, powers_vector, room, at.POWERS)
        degree = emit.splat(one.load(room, at.DEGREE))
        known = constants([float(k) for k in range(LANES)])
        kept = builder.select(builder.compare("fcmp olt", known, degree), powers_vector, emit.constant(0.0))
        old = self._polynomial(emit, room, other=False)
        nodes = np.array(tables().nodes)
        with _over(emit, self.iterated, [llvm_code.ZERO] * 2) as (k, i, (most, largest), new):
            weight = one.load(one.pointer(room, i), at.WEIGHTS)
            v, a = (one.load(one.pointer(state, i), m * n) for m in (1, 2))
            size = one.add(one.function("fabs", v), one.multiply(h, one.function("fabs", a)))
            new += [_larger(one, weight, most), _larger(one, one.multiply(weight, size), largest)]
            a0 = emit.splat(a)
            scaled = emit.multiply(_get(emit, one.pointer(old, _lanes(emit, k))), kept)
            total = a0
            for degree_, each in enumerate(_splats(emit, scaled)):
                total = emit.fused(each, constants(nodes ** (degree_ + 1)), total)
            _put(emit, total, one.pointer(room, _lanes(emit, i)), self.a)
        if self.iterated:
            one.store(one.divide(of_all, new[0]), room, at.STRICTER)
            one.store(new[1], room, at.SIZE)
        self._integrate(emit, room, state)

    def sweep(self, emit: LaneEmitter, room: Value, state: Value, numbers: Value) -> Value:
        """Accelerations at the nodes anew; the largest change of what follows from them, or FAILED."""
        builder, one, n = emit.builder, Emitter(emit.builder), self.n
        emit.numbers = emit.constants = numbers
        t, h = emit.splat(one.load(room, at.T)), emit.splat(one.load(room, at.H))
        t = emit.fused(constants(tables().nodes), h, t)
        zero = emit.constant(0.0)
        q, v = [zero] * n, [zero] * n
        for k, i in enumerate(self.iterated):
            q[i], v[i] = _get(emit, room, self.q + LANES * k), _get(emit, room, self.v + LANES * k)
        a, holds = write_accelerations(emit, self.equations, [t, *q, *v], self.numbers)
        for i, value in enumerate(a):
            _put(emit, value, room, self.a + LANES * i)
        change = self._integrate(emit, room, state)
        all_hold = builder.call(f"llvm.vector.reduce.and.v{LANES}i1", BIT, [holds])
        return builder.select(all_hold, change, constant(DOUBLE, FAILED))

    def judge(self, emit: LaneEmitter, room: Value, state: Value) -> None:
        """ERROR, CURVED and LARGEST, over the tolerances.

        The coefficients of a in Legendre polynomials tell how fast they fall: t is the larger one of degrees 7 and 8, s
        of 5 and 6, f of all from 3 on. The error is estimated as t (t / s)^1.5 or, if that is more, t^2 / f. Errors of
        steps over corners and peaks of forces are at most 20 times as large, in 99 % of them; those of smooth motion
        are smaller by decades, which costs few steps, as the estimate is of order 12.
        """
        builder, one, n = emit.builder, Emitter(emit.builder), self.n
        with one.loop(integer(0), integer(n), [llvm_code.ZERO] * 3) as (i, (error, curved, largest), new):
            a0 = one.load(one.pointer(state, i), 2 * n)
            values = emit.function("fabs", self._combined(emit, tables().spectrum, a0, room, i))
            before, top = (_larger(one, *(builder.extract(values, k + m) for m in range(2))) for k in (4, 6))
            first = _larger(one, *(builder.extract(values, k) for k in (2, 3)))
            falls = one.divide(top, _larger(one, _larger(one, before, top), constant(DOUBLE, SMALLEST)))
            far = one.divide(
                top, _larger(one, _larger(one, first, _larger(one, before, top)), constant(DOUBLE, SMALLEST))
            )
            falls = _larger(one, one.multiply(falls, one.function("sqrt", falls)), far)
            weight = one.load(one.pointer(room, i), at.WEIGHTS)
            new.append(_larger(one, one.multiply(one.multiply(top, weight), falls), error))
            new.append(_larger(one, one.multiply(before, weight), curved))
            middle = one.load(one.pointer(room, _lanes(emit, i)), self.a + LANES // 2 - 1)
            for each in (a0, middle):
                largest = _larger(one, one.multiply(one.function("fabs", each), weight), largest)
            new.append(largest)
        h = one.load(room, at.H)
        for value, place in zip(new, (at.ERROR, at.CURVED, at.LARGEST), strict=True):
            one.store(one.multiply(value, h), room, place)

    def audit(self, emit: LaneEmitter, room: Value, state: Value, numbers: Value) -> Value:
        """The largest defect between nodes: what a step as long as this one would make of it, over the tolerances."""
        builder, one, n = emit.builder, Emitter(emit.builder), self.n
        emit.numbers = emit.constants = numbers
        t, h = emit.splat(one.load(room, at.T)), emit.splat(one.load(room, at.H))
        length = emit.multiply(h, constants(tables().between))
        zero = emit.constant(0.0)
        q, v = [zero] * n, [zero] * n
        for i in self.iterated:
            q0, v0, a0 = (one.load(state, m * n + i) for m in range(3))
            of_v = self._combined(emit, tables().velocities_between, a0, room, integer(i))
            of_q = self._combined(emit, tables().positions_between, a0, room, integer(i))
            v[i] = emit.fused(h, of_v, emit.splat(v0))
            q[i] = emit.fused(emit.multiply(h, h), of_q, emit.fused(length, emit.splat(v0), emit.splat(q0)))
        a, holds = write_accelerations(emit, self.equations, [emit.add(t, length), *q, *v], self.numbers)
        worst = zero
        for i, value in enumerate(a):
            a0 = one.load(state, 2 * n + i)
            off = emit.subtract(value, self._combined(emit, tables().values_between, a0, room, integer(i)))
            weight = emit.splat(one.load(room, at.WEIGHTS + i))
            worst = emit.larger(emit.multiply(emit.function("fabs", off), weight), worst)
        largest = builder.call(f"llvm.vector.reduce.fmax.{emit.suffix}", DOUBLE, [emit.multiply(worst, h)])
        all_hold = builder.call(f"llvm.vector.reduce.and.v{LANES}i1", BIT, [holds])
        return builder.select(all_hold, largest, constant(DOUBLE, FAILED))

    def end(self, emit: LaneEmitter, room: Value, state: Value, new_state: Value) -> None:
        """[q, v, a] at the end of the step, and the polynomial that predicts the next, with the best DEGREE of this."""
        builder, one, n = emit.builder, Emitter(emit.builder), self.n
        last, h = LANES - 1, one.load(room, at.H)
        powers, new = _get(emit, room, at.POWERS), self._polynomial(emit, room, other=True)
        old, zero = self._polynomial(emit, room, other=False), emit.constant(0.0)
        with _over(emit, self.iterated, [zero]) as (k, i, (worst,), carried):
            place = one.pointer(room, _lanes(emit, k))
            here = one.pointer(new_state, i)
            a0, a1 = one.load(one.pointer(state, i), 2 * n), one.load(one.pointer(room, _lanes(emit, i)), self.a + last)
            for value, begin in ((one.load(place, self.q + last), 0), (one.load(place, self.v + last), n), (a1, 2 * n)):
                one.store(value, here, begin)
            terms = emit.multiply(_get(emit, one.pointer(old, _lanes(emit, k))), powers)
            off = emit.splat(one.subtract(a0, a1))
            for j, each in enumerate(_splats(emit, terms)):
                off = emit.fused(each, constants([float(m >= j) for m in range(LANES)]), off)
            weight = emit.splat(one.load(one.pointer(room, i), at.WEIGHTS))
            carried.append(emit.larger(emit.multiply(emit.function("fabs", off), weight), worst))
            _put(emit, self._combined(emit, tables().end, a0, room, i), one.pointer(new, _lanes(emit, k)))
        _put(emit, carried[0], room, at.WORST)
        if self.others:
            with _over(emit, self.others) as (_, i, _, _):
                first, here = one.pointer(state, i), one.pointer(new_state, i)
                a = _get(emit, one.pointer(room, _lanes(emit, i)), self.a)
                q, v, a0 = (one.load(first, m * n) for m in range(3))
                sums = []
                for table in (tables().velocities, tables().positions):
                    products = emit.multiply(constants(table[1:, last]), a)
                    total = builder.call(
                        f"llvm.vector.reduce.fadd.{emit.suffix}", DOUBLE, [constant(DOUBLE, -0.0), products], "reassoc"
                    )
                    sums.append(one.add(total, one.multiply(constant(DOUBLE, table[0, last]), a0)))
                further = one.multiply(h, one.add(v, one.multiply(h, sums[1])))
                one.store(one.add(q, further), here, 0)
                one.store(one.add(v, one.multiply(h, sums[0])), here, n)
                one.store(builder.extract(a, last), here, 2 * n)

    def closer(self, emit: LaneEmitter, room: Value, numbers: Value) -> None:
        """Positions at the ends of eight steps, moved towards the constraints; FINE and MOVED."""
        if self.parts is None:
            self._project(emit, room, numbers, self.equations.closer)
        else:
            self._project_in_parts(emit, room, numbers, self.parts.closer, ("moved", "q"))

    def nearer(self, emit: LaneEmitter, room: Value, numbers: Value) -> None:
        """The same, and velocities, accelerations and multipliers there."""
        if self.parts is None:
            self._project(emit, room, numbers, self.equations.nearer)
        else:
            self._project_in_parts(emit, room, numbers, self.parts.nearer, ("a", "moved", "q", "v", "lam"))

    # what they are made of

    def _project(self, emit: LaneEmitter, room: Value, numbers: Value, outputs: Outputs) -> None:
        emit.numbers = emit.constants = numbers
        inputs = [_get(emit, room, self.ends + LANES * k) for k in range(1 + 2 * self.n)]
        written, arrays = results_of(emit, self.equations.graph, outputs, inputs, self.numbers)
        values = dict(zip(outputs.arrays, arrays, strict=True))
        holds = conditions_hold(emit, written, outputs, [value for array in arrays for value in array])
        for name, place in self._places_of_ends().items():
            for k, value in enumerate(values.get(name, [])):
                _put(emit, value, room, place + LANES * k)
        self._keep_moved(emit, room, values["moved"], holds)

    def _project_in_parts(
        self, emit: LaneEmitter, room: Value, numbers: Value, write: Callable[..., Value], names: tuple[str, ...]
    ) -> None:
        """The same by a function of parts_code.py, which fills arrays of these names."""
        one, moved = Emitter(emit.builder), emit.builder.room(DOUBLE, LANES * self.n)
        places = {name: one.pointer(room, place) for name, place in self._places_of_ends().items()} | {"moved": moved}
        state = _get(emit, room, self.ends), places["q"], places["v"]
        holds = write(emit, *state, numbers, *(places[name] for name in names))
        self._keep_moved(emit, room, [_get(emit, moved, LANES * k) for k in range(self.n)], holds)

    def _places_of_ends(self) -> dict[str, int]:
        return {"q": self.ends + LANES, "v": self.ends + LANES * (1 + self.n), "a": self.end_a, "lam": self.lam}

    def _keep_moved(self, emit: LaneEmitter, room: Value, values: Sequence[Value], holds: Value) -> None:
        moved = emit.constant(0.0)
        for value in values:
            moved = emit.larger(emit.function("fabs", value), moved)
        _put(emit, moved, room, at.MOVED)
        before = _get(emit, room, at.FINE)
        _put(emit, emit.builder.select(holds, before, emit.constant(0.0)), room, at.FINE)

    def _integrate(self, emit: LaneEmitter, room: Value, state: Value) -> Value:
        """Positions and velocities at the nodes from accelerations there; the largest change of a velocity."""
        one, n = Emitter(emit.builder), self.n
        h = emit.splat(one.load(room, at.H))
        length = emit.multiply(h, constants(tables().nodes))
        squared = emit.multiply(h, h)
        with _over(emit, self.iterated, [emit.constant(0.0)]) as (k, i, (largest,), new):
            place, begin = one.pointer(room, _lanes(emit, k)), one.pointer(state, i)
            q0, v0, a0 = (one.load(begin, m * n) for m in range(3))
            of_v = self._combined(emit, tables().velocities, a0, room, i)
            of_q = self._combined(emit, tables().positions, a0, room, i)
            v = emit.fused(h, of_v, emit.splat(v0))
            q = emit.fused(squared, of_q, emit.fused(length, emit.splat(v0), emit.splat(q0)))
            change = emit.function("fabs", emit.subtract(v, _get(emit, place, self.v)))
            weight = emit.splat(one.load(one.pointer(room, i), at.WEIGHTS))
            new.append(emit.larger(emit.multiply(change, weight), largest))
            _put(emit, v, place, self.v)
            _put(emit, q, place, self.q)
        result: Value = emit.builder.call(f"llvm.vector.reduce.fmax.{emit.suffix}", DOUBLE, [new[0]])
        return result

    def _combined(self, emit: LaneEmitter, table: Array, first: Value, room: Value, i: Value) -> Value:
        """The sum of rows of a table times values of coordinate i at the nodes; `first` is that at the beginning."""
        one = Emitter(emit.builder)
        place = one.pointer(room, _lanes(emit, i))
        sums: list[Value] = [emit.multiply(emit.splat(first), constants(table[0]))]
        sums.append(emit.multiply(emit.splat(one.load(place, self.a)), constants(table[1])))
        for node in range(1, LANES):
            value = emit.splat(one.load(place, self.a + node))
            sums[node % 2] = emit.fused(value, constants(table[node + 1]), sums[node % 2])
        return emit.add(*sums)

    def _polynomial(self, emit: LaneEmitter, room: Value, other: bool) -> Value:
        """Where the coefficients begin of the polynomial of the last accepted step, or of the step being made."""
        builder, one = emit.builder, Emitter(emit.builder)
        second = builder.compare("fcmp one" if not other else "fcmp oeq", one.load(room, at.WHICH), llvm_code.ZERO)
        size = LANES * len(self.iterated)
        place = builder.select(second, integer(self.polynomials + size), integer(self.polynomials))
        return one.pointer(room, place)


def _larger(one: Emitter, a: Value, b: Value) -> Value:
    """The larger of two numbers."""
    return one.builder.select(one.builder.compare("fcmp ogt", a, b), a, b)


def _lanes(emit: LaneEmitter, k: Value) -> Value:
    """The place of vector k."""
    return emit.builder.mul(k, integer(LANES))


def _get(emit: LaneEmitter, base: Value, place: int = 0) -> Value:
    """A vector at a place, which is counted in numbers."""
    return Emitter(emit.builder).load_vector(base, place, LANES)


def _put(emit: LaneEmitter, value: Value, base: Value, place: int = 0) -> None:
    Emitter(emit.builder).store_vector(value, base, place)


def _splats(emit: LaneEmitter, vector: Value) -> list[Value]:
    """Each number of a vector in all lanes."""
    return [emit.splat(emit.builder.extract(vector, k)) for k in range(LANES)]


@contextmanager
def _over(
    emit: LaneEmitter, coordinates: Sequence[int], carried: Sequence[Value] = ()
) -> Iterator[tuple[Value, Value, list[Any], list[Any]]]:
    """A loop over some coordinates: how many there were before, which it is, and as of `Emitter.loop`."""
    builder = emit.builder
    table = None if list(coordinates) == list(range(len(coordinates))) else builder.module.table(coordinates)
    with emit.loop(integer(0), integer(len(coordinates)), carried) as (k, values, new):
        i = k if table is None else builder.convert("sext", builder.load(builder.gep(table, k), 4), INTEGER)
        yield k, i, values, new


class Collocation(NamedTuple):
    """Functions for the steps of a mechanism by collocation."""

    functions: LaterFunctions
    code: CollocationCode
    numbers: Any  # what they read, or formulas for it


def compiled_collocation(of_one: OwnCode) -> Collocation:
    """The code for a mechanism; its machine code is kept on disk, and compiled when steps are to call it."""
    own = of_one.shared
    made: Collocation = own.family.remembered(("collocation", own.equations.choice), lambda: _compiled(own))
    return made._replace(numbers=of_one.evaluate(made.numbers))


def _compiled(own: SharedCode) -> Collocation:
    from twoloop.kernels.data.common import KIT

    code = CollocationCode(own)
    parts: dict[str, Callable[..., Any]] = {
        "begin_nodes": code.begin,
        "sweep_nodes": code.sweep,
        "judge_nodes": code.judge,
        "end_nodes": code.end,
        "audit_nodes": code.audit,
        "closer_ends": code.closer,
        "nearer_ends": code.nearer,
    }
    long = own.parts is not None

    def write() -> tuple[list[str], str]:
        module = Module(divided=long)
        for name, emit in parts.items():
            llvm_code.write(module, name, KIT.own_type(name), emit, partial(LaneEmitter, lanes=LANES))
        return list(parts), str(module)

    functions = LaterFunctions(lambda: own_functions("collocation", _stamp(), code.structure, write, passes=not long))
    return Collocation(functions, code, code.numbers.formulas)


@cache
def _stamp() -> str:
    """A digest of what writes the functions; what they share with those of the equations is in the key."""
    return digest_of("", __file__, lane_emitter, lobatto_tables, at)
