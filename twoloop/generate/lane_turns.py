"""Whether a step may have passed a singular position, as code for lanes: the sign of det G1 G0^T.

G0 and G1 are the rows of the constraints at both ends of the step. The determinant is the inner product of their
maximal minors, and near the square of these while a step turns little. A step straight through a position at which the
rows lose rank, which leads to another assembly, changes the signs of all of them: they pass through zero. No partition
of the coordinates is needed.
"""

from twoloop.generate.lane_emitter import LaneEmitter
from twoloop.generate.llvm_text import Value

Rows = list[dict[int, Value]]  # entries that are not zero


def turned(emit: LaneEmitter, before: Rows, after: Rows) -> Value:
    """In which lanes det G1 G0^T is not positive, or cannot be had without a search for pivots."""
    matrix: list[dict[int, Value]] = [{} for _ in before]
    for i, row in enumerate(after):
        for k, other in enumerate(before):
            total: Value | None = None
            for j in sorted(row.keys() & other.keys()):
                term = emit.multiply(row[j], other[j])
                total = term if total is None else emit.add(total, term)
            if total is not None:
                matrix[i][k] = total
    one, zero, select, compare = emit.constant(1.0), emit.constant(0.0), emit.builder.select, emit.builder.compare
    left, sign = set(range(len(matrix))), one
    while left:
        i = min(left, key=lambda each: (len(matrix[each]), each))  # rows and columns have the same pattern
        left.remove(i)
        pivot = matrix[i].pop(i)
        below = select(compare("fcmp olt", pivot, zero), emit.negative(sign), zero)
        sign = select(compare("fcmp ogt", pivot, zero), sign, below)
        inverse = emit.divide(one, pivot)
        for k in sorted(left):
            if i in matrix[k]:
                multiple = emit.multiply(matrix[k].pop(i), inverse)
                for j, value in matrix[i].items():
                    change = emit.multiply(multiple, value)
                    old = matrix[k].get(j)
                    matrix[k][j] = emit.negative(change) if old is None else emit.subtract(old, change)
    return compare("fcmp ule", sign, zero)
