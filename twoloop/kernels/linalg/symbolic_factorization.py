"""Factor large systems symbolically: choose the order of elimination, and write the program for the factors.

    [M  G^T]
    [G   0 ]  = L D L^T

M is the mass matrix, and G the constraint Jacobian. The order of elimination is chosen once, by the pattern of entries
alone. Pivots are single entries: see sparse_ldl.py and sparse_lu.py. A "slot" is the index of a number in the array of
the factors, which contains the pivots in their order, then the columns of L, each downwards.

Terms: coordinates that M couples, or that the system declares as a group, form a body. The rows of G that involve the
same bodies form a joint. A body with more than MAX_JOINTS joints is a hub. A part is a set of bodies that eliminated
joints connect. A support of a part is the ground, or a hub, to which an eliminated joint connects the part.

Bodies other than hubs are eliminated first. G M^-1 G^T remains, which is positive definite, so that any order of its
joints is stable. If hubs were also eliminated first, all joints of a hub would be coupled. So hubs are ordered among
the joints by minimum degree, with one condition. A joint may be eliminated before a hub that it involves, directly or
through eliminated joints, only if its rows are independent even while the hub is at rest: one of the parts that the
joint connects must have no support yet.
"""

import heapq
from collections.abc import Iterable, Sequence
from collections.abc import Set as AbstractSet

import numpy as np
from numpy.typing import NDArray

from twoloop.kernels.data.common import inlined

MAX_JOINTS = 4  # a body with more joints is a hub; other bodies are eliminated before their joints

Integers = NDArray[np.int64]


class _DisjointSets:
    """Disjoint sets of the integers below n (union-find), each represented by its smallest member."""

    def __init__(self, n: int):
        self.parent = list(range(n))

    def find(self, i: int) -> int:
        """Return the smallest member of the set that contains i."""
        while self.parent[i] != i:
            self.parent[i] = self.parent[self.parent[i]]
            i = self.parent[i]
        return i

    def join(self, i: int, j: int) -> int:
        """Merge the sets that contain i and j; return the smallest member of their union."""
        i, j = self.find(i), self.find(j)
        self.parent[max(i, j)] = min(i, j)
        return min(i, j)


class _PartSupports:
    """Supports of each part (bodies connected by eliminated joints): the ground, and hubs (bodies with many joints)."""

    def __init__(self, joints: Sequence[frozenset[int]], n_bodies: int, hubs: set[int], lone_bodies: AbstractSet[int]):
        self.joints, self.hubs = joints, set(hubs)  # bodies of each joint; hubs that are not eliminated yet
        # hubs with one coordinate. A joint with such a hub may immobilize other bodies, and counts as a ground joint
        self.lone_bodies = lone_bodies
        self.parts = _DisjointSets(n_bodies)
        self.is_grounded = [False] * n_bodies
        self.hubs_by_part: list[set[int]] = [set() for _ in range(n_bodies)]  # [k]: hubs that joints connect to part k
        self.supported_bodies: dict[int, list[int]] = {hub: [] for hub in hubs}  # [hub]: bodies of parts joined to it

    def can_eliminate(self, joint: int) -> bool:
        """Return True if a joint may be eliminated before the remaining hubs (bodies with many joints).

        A part is a set of bodies that eliminated joints connect. Supports of a part are the ground and hubs to which
        eliminated joints connect the part. The joint may be eliminated in either of two cases:
        - The joint involves no hub, and no part that the joint connects has a hub as a support.
        - The joint involves none of the `lone_bodies` (hubs with one coordinate), and connects a part without support.
        """
        bodies = self.joints[joint]
        parts = {self.parts.find(body) for body in bodies if body not in self.hubs}
        if not bodies & self.lone_bodies and any(not self.is_grounded[p] and not self.hubs_by_part[p] for p in parts):
            return True
        return not bodies & self.hubs and not any(self.hubs_by_part[p] for p in parts)

    def eliminate_joint(self, joint: int) -> None:
        """Merge the parts (sets of connected bodies) that an eliminated joint connects; record the joint's hubs."""
        bodies = self.joints[joint]
        is_grounded = len(bodies) == 1 or bool(bodies & self.lone_bodies)
        self._merge_parts((body for body in bodies if body not in self.hubs), is_grounded, bodies & self.hubs)

    def eliminate_hub(self, hub: int) -> None:
        """Merge an eliminated hub (body with many joints) with the parts to which joints connect it."""
        self.hubs.discard(hub)
        supported_bodies = self.supported_bodies.pop(hub)
        for body in supported_bodies:
            self.hubs_by_part[body].discard(hub)
        self._merge_parts([hub, *supported_bodies], False, frozenset())

    def _merge_parts(self, bodies: Iterable[int], is_grounded: bool, hubs: AbstractSet[int]) -> None:
        """Merge the parts that contain `bodies`; join the result to `hubs` and, if `is_grounded`, to the ground."""
        first, *others = bodies
        part = self.parts.find(first)
        for body in others:
            other_part = self.parts.find(body)
            if other_part != part:
                is_grounded = is_grounded or self.is_grounded[other_part] or self.is_grounded[part]
                hubs = {*hubs, *self.hubs_by_part[other_part], *self.hubs_by_part[part]}
                part = self.parts.join(part, other_part)
        self.is_grounded[part] = self.is_grounded[part] or is_grounded
        for hub in hubs - self.hubs_by_part[part]:
            self.hubs_by_part[part].add(hub)
            self.supported_bodies[hub].append(part)


def elimination_order(
    n_q: int,
    n_rows: int,
    mass_entries: tuple[Integers, Integers],
    jacobian_entries: tuple[Integers, Integers],
    body_groups: Iterable[Sequence[int]] = (),
    early_rows: Sequence[int] = (),
    couplings: tuple[Integers, Integers] | None = None,
) -> Integers:
    """Return the order of elimination (n_q + n_rows): j for coordinate j, n_q + i for row i of G.

    mass_entries, jacobian_entries : rows and columns of the entries of M (mass matrix) and G (constraint Jacobian).
    body_groups : groups of coordinates that form one body each, even if M does not couple them.
    early_rows : rows of G that involve a single body each. Unless the body is a hub (it has many joints), these rows
        are eliminated before all joints, so that a dependence on other rows cannot make their pivots small.
    couplings : rows and columns of the entries of K and D (derivatives of the forces), which couple bodies as springs
        do. If given, all bodies are treated as hubs, and each body is eliminated together with its `early_rows`.
    """
    body_of = bodies_of(n_q, mass_entries, body_groups)
    bodies_in_row: list[set[int]] = [set() for _ in range(n_rows)]
    for i, j in zip(*(indices.tolist() for indices in jacobian_entries), strict=True):
        bodies_in_row[i].add(body_of[j])
    early_row_set = set(early_rows)
    rows_by_joint: dict[frozenset[int], list[int]] = {}
    for i, bodies in enumerate(bodies_in_row):
        if i not in early_row_set:
            rows_by_joint.setdefault(frozenset(bodies), []).append(i)
    joints = list(rows_by_joint)
    joints_of: list[list[int]] = [[] for _ in range(n_q)]  # indices of the joints of each body
    for k, joint in enumerate(joints):
        for body in joint:
            joints_of[body].append(k)
    hubs = {body for body in range(n_q) if len(joints_of[body]) > MAX_JOINTS}
    if couplings is not None:
        hubs = set(body_of)
    coordinates: dict[int, list[int]] = {}
    for j, body in enumerate(body_of):
        coordinates.setdefault(body, []).append(j)
    order = [j for j in range(n_q) if body_of[j] not in hubs]
    order += [n_q + i for i in early_rows if not bodies_in_row[i] & hubs]
    rows_of_hubs = [n_q + i for i in early_rows if bodies_in_row[i] & hubs]
    if couplings is not None:
        for i in early_rows:
            coordinates[next(iter(bodies_in_row[i]))].append(n_q + i)
        rows_of_hubs = []
    nodes = [[n_q + i for i in rows_by_joint[joint]] for joint in joints] + [coordinates[hub] for hub in sorted(hubs)]
    pairs: set[tuple[int, int]] = set()
    lone_bodies: set[int] = set()
    if couplings is not None:
        pairs = {(body_of[i], body_of[j]) for i, j in zip(*couplings, strict=True)}
        lone_bodies = {hub for hub in hubs if len(coordinates[hub]) == 1}
    sizes = [len(node) for node in nodes]
    for node in _minimum_degree_order(joints, joints_of, sorted(hubs), sizes, n_q, pairs, lone_bodies):
        order += nodes[node]
    order += rows_of_hubs
    return np.array(order, dtype=np.int64)


def bodies_of(n_q: int, mass_entries: tuple[Integers, Integers], groups: Iterable[Sequence[int]]) -> list[int]:
    """Return, for each coordinate, the first coordinate of its body, which identifies the body.

    Coordinates belong to the same body if an entry of M couples them, or if they are in one of the `groups`.
    """
    pairs = np.array([(first, other) for first, *others in groups for other in others], dtype=np.int64).reshape(-1, 2)
    rows, columns = (np.concatenate([entries, column]) for entries, column in zip(mass_entries, pairs.T, strict=True))
    representatives, previous = np.arange(n_q), np.full(n_q, -1)
    while (representatives != previous).any():
        previous = representatives.copy()
        smaller = np.minimum(representatives[rows], representatives[columns])
        np.minimum.at(representatives, rows, smaller)
        np.minimum.at(representatives, columns, smaller)
        representatives = representatives[representatives]
    return representatives.tolist()  # type: ignore[no-any-return]


def _minimum_degree_order(
    joints: Sequence[frozenset[int]],
    joints_of: Sequence[Sequence[int]],
    hubs: Sequence[int],
    sizes: Sequence[int],
    n_bodies: int,
    pairs: Iterable[tuple[int, int]],
    lone_bodies: AbstractSet[int],
) -> list[int]:
    """Return the order of elimination of joints and hubs as indices: k for joint k, len(joints) + k for hub k.

    Hubs are bodies with many joints. Next is the hub, or joint allowed by `can_eliminate`, whose neighbours have the
    fewest rows and coordinates (`sizes`). `pairs`: hubs coupled without a joint. `lone_bodies`: see `_PartSupports`.
    """
    n_joints = len(joints)
    node_of = {hub: n_joints + k for k, hub in enumerate(hubs)}
    neighbours: list[set[int]] = [set() for _ in sizes]
    for body, joint_indices in enumerate(joints_of):
        if body in node_of:
            neighbours[node_of[body]].update(joint_indices)
            for k in joint_indices:
                neighbours[k].add(node_of[body])
        else:
            for k in joint_indices:
                neighbours[k].update(joint_indices)
    for hub_a, hub_b in pairs:
        neighbours[node_of[hub_a]].add(node_of[hub_b])
        neighbours[node_of[hub_b]].add(node_of[hub_a])
    for node, adjacent in enumerate(neighbours):
        adjacent.discard(node)
    supports = _PartSupports(joints, n_bodies, set(hubs), lone_bodies)

    def degree(node: int) -> int:
        return sum(sizes[neighbour] for neighbour in neighbours[node])

    heap = [(degree(node), node) for node in range(len(sizes))]
    heapq.heapify(heap)
    is_eliminated, order = [False] * len(sizes), []
    while heap:
        degree_on_heap, node = heapq.heappop(heap)
        if is_eliminated[node] or degree_on_heap != degree(node):
            continue  # this entry of the heap is outdated, and a newer one is also in the heap
        if node < n_joints and not supports.can_eliminate(node):
            continue  # wait: the elimination of an adjacent hub will put this joint on the heap again
        is_eliminated[node] = True
        order.append(node)
        affected_nodes = neighbours[node]
        for neighbour in affected_nodes:
            neighbours[neighbour] |= affected_nodes
            neighbours[neighbour] -= {node, neighbour}
        if node < n_joints:
            supports.eliminate_joint(node)
        else:
            supports.eliminate_hub(hubs[node - n_joints])
        for neighbour in affected_nodes:
            heapq.heappush(heap, (degree(neighbour), neighbour))
    return order


Entries = tuple[Integers, Integers]  # row indices and column indices of the nonzero entries of a matrix

# indices of the sizes at the beginning of a program; functions at the end of this module return its later sections
(
    N_COORDINATES,  # number of coordinates
    N_PIVOTS,  # number of pivots: coordinates plus rows of G
    N_OFF_DIAGONAL,  # number of entries of L below the diagonal
    N_UPDATES,  # number of updates in the elimination, each a multiplication and a subtraction
    N_RUNS,  # length of the list from `update_runs_of`: two numbers for each range of updates
    N_OF_MASS,  # number of entries of the mass matrix M in the list from `mass_entries_of`
    N_OF_JACOBIAN,  # number of entries of the constraint Jacobian G in the list from `jacobian_entries_of`
    N_STIFFENED,  # number of terms s g_i g_j (s: factor, g: row of G) that are added to M if M is singular
    N_HEAD,
) = range(9)
ALWAYS_ALLOWED_UPDATES = 3_000_000  # a program is always written if it has at most this number of updates
MAX_UPDATE_RATIO = 1e-3  # largest (number of updates) / n^3 for n pivots, unless ALWAYS_ALLOWED_UPDATES allows more
MAX_UPDATES = 30_000_000  # largest number of updates of a program; a longer one would take too much memory to write


def factorization_program(
    n_q: int,
    n_rows: int,
    mass: Entries,
    jacobian: Entries,
    body_groups: Iterable[Sequence[int]] = (),
    stiff_rows: Sequence[int] = (),
) -> NDArray[np.int32] | None:
    """Return the program that factors [M G^T; G 0]; None if it would have too many updates (see MAX_UPDATES).

    mass, jacobian : entries of M, both triangles, and of G. If an entry is listed repeatedly, its values are added.
    body_groups : groups of coordinates that form one body each, even if M does not couple them.
    stiff_rows : rows g of G that are added to M as s g^T g, because M is singular; M must have the entries of g^T g.
    """
    order = elimination_order(n_q, n_rows, mass, jacobian, body_groups, stiff_rows)
    return program_in_order(order, n_q, mass, jacobian, stiff_rows)


def program_in_order(
    order: Integers, n_q: int, mass: Entries, jacobian: Entries, stiff_rows: Sequence[int], unsymmetric: bool = False
) -> NDArray[np.int32] | None:
    """Return the program for an order of elimination; None if its updates would be too many (see MAX_UPDATES).

    If `unsymmetric`, factors are L U: entry (i, j) of U is program[N_OFF_DIAGONAL] numbers after entry (j, i) of L.
    """
    n = len(order)
    position = np.empty(n, dtype=np.int64)
    position[order] = np.arange(n)
    rows = np.concatenate([position[mass[0]], position[n_q + jacobian[0]]])
    columns = np.concatenate([position[mass[1]], position[jacobian[1]]])
    low, high = np.minimum(rows, columns), np.maximum(rows, columns)
    rows_below = _columns_of_factors(n, low, high)
    sizes = np.array([len(rows_in_column) for rows_in_column in rows_below], dtype=np.int64)
    if (sizes * (sizes + 1) // 2).sum() > max(ALWAYS_ALLOWED_UPDATES, min(MAX_UPDATES, MAX_UPDATE_RATIO * n**3)):
        return None
    begin = np.concatenate([[0], np.cumsum(sizes)])
    row_of = np.concatenate([np.zeros(0, np.int64), *rows_below])
    column_of = np.repeat(np.arange(n), sizes)
    entry_keys = column_of * n + row_of  # ascending numbers that identify the entries of L, searched by `slots_of`

    def slots_of(column: Integers, row: Integers) -> Integers:
        off_diagonal_slots = n + np.searchsorted(entry_keys, column * n + row)
        return np.where(column == row, column, off_diagonal_slots)

    first_rows_by_column, second_rows_by_column = [row_of[:0]], [row_of[:0]]
    for rows_in_column in rows_below:
        i, j = _index_pairs(len(rows_in_column))
        first_rows_by_column.append(rows_in_column[i])
        second_rows_by_column.append(rows_in_column[j])
    first_of, second_of = np.concatenate(first_rows_by_column), np.concatenate(second_rows_by_column)
    runs = _update_runs(slots_of(first_of, second_of), first_of == second_of)
    entry_slots = slots_of(low, high)
    n_mass = len(mass[0])
    # entries of M above the diagonal are stored in U or, if factors are symmetric, at an index that is never read
    is_above = rows[:n_mass] < columns[:n_mass]
    n_off_diagonal = len(entry_keys)
    entry_slots[:n_mass][is_above] = (
        entry_slots[:n_mass][is_above] + n_off_diagonal if unsymmetric else n + n_off_diagonal
    )
    product_rows, first, second = _products_of_entries(jacobian[0], stiff_rows)
    pivot_a, pivot_b = (position[jacobian[1][indices]] for indices in (first, second))
    products = [product_rows, first, second, slots_of(np.minimum(pivot_a, pivot_b), np.maximum(pivot_a, pivot_b))]
    head = [n_q, n, n_off_diagonal, len(first_of), len(runs), n_mass, len(jacobian[0]), len(product_rows)]
    parts = [order, begin, row_of, runs, *mass, entry_slots[:n_mass], *jacobian, entry_slots[n_mass:], *products]
    return np.concatenate([np.array(head), *parts]).astype(np.int32)


def _update_runs(targets: Integers, diagonal: NDArray[np.bool_]) -> Integers:
    """Find ranges of adjacent off-diagonal entries that successive updates of the elimination change.

    `targets`: for each update, the index of the entry that it changes; `diagonal`: whether this entry is on the
    diagonal. Return the length of each range and the index of its first entry. Ranges are long, because the rows of a
    joint are adjacent in all columns. So programs change vectors instead of entries, and are a tenth as long.
    """
    off_diagonal = np.flatnonzero(~diagonal)
    begins = np.flatnonzero(diagonal[off_diagonal - 1] | (targets[off_diagonal] != targets[off_diagonal - 1] + 1))
    lengths = np.diff(np.append(begins, len(off_diagonal)))
    return np.stack([lengths, targets[off_diagonal][begins]], axis=1).ravel()


def _products_of_entries(rows: Integers, chosen: Sequence[int]) -> tuple[Integers, Integers, Integers]:
    """For each pair of entries in a `chosen` row, return this row and both indices; `rows`: the row of each entry."""
    parts: list[tuple[Integers, Integers, Integers]] = [(rows[:0], rows[:0], rows[:0])]
    sequence = np.argsort(rows, kind="stable")
    sorted_rows = rows[sequence]
    for row in chosen:
        entries = sequence[np.searchsorted(sorted_rows, row) : np.searchsorted(sorted_rows, row + 1)]
        first_index, second_index = _index_pairs(len(entries))
        parts.append((np.full(len(first_index), row), entries[first_index], entries[second_index]))
    product_rows, first, second = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return product_rows, first, second


_INDEX_PAIRS: dict[int, Entries] = {}


def _index_pairs(m: int) -> Entries:
    """Return the first and second indices of all unordered pairs of m items, including each item with itself."""
    if m not in _INDEX_PAIRS:
        _INDEX_PAIRS[m] = tuple(indices.astype(np.int64) for indices in np.triu_indices(m))  # type: ignore[assignment]
    return _INDEX_PAIRS[m]


def _columns_of_factors(n: int, low: Integers, high: Integers) -> list[Integers]:
    """Return, for each column of L, the rows that have an entry below the diagonal, including fill-in.

    `low`, `high`: column and row of each entry of the matrix. Let i be the first row in a column of L: the elimination
    of this column creates entries in column i, in all other rows of the eliminated column.
    """
    rows_below: list[set[int]] = [set() for _ in range(n)]
    for column, row in zip(low.tolist(), high.tolist(), strict=True):
        rows_below[column].add(row)
    patterns = []
    for column in range(n):
        rows_below[column].discard(column)
        rows = sorted(rows_below[column])
        if rows:
            rows_below[rows[0]].update(rows[1:])
        patterns.append(np.array(rows, dtype=np.int64))
        rows_below[column] = set()
    return patterns


@inlined
def end_of_sections(program):
    """Return the index after the sections of a program, at which `newton_program` adds groups of columns."""
    begin = N_HEAD + 2 * program[N_PIVOTS] + 1 + program[N_OFF_DIAGONAL] + program[N_RUNS]
    return begin + 3 * (program[N_OF_MASS] + program[N_OF_JACOBIAN]) + 4 * program[N_STIFFENED]


@inlined
def pivot_order_of(program):
    """Return the indices of the pivots in the order of elimination: j for coordinate j, n_q + i for row i of G."""
    return program[N_HEAD : N_HEAD + program[N_PIVOTS]]


@inlined
def factor_columns_of(program):
    """Return the indices at which columns of L begin, then the end of the last column; also the rows of all entries."""
    begin = N_HEAD + program[N_PIVOTS]
    middle = begin + program[N_PIVOTS] + 1
    return program[begin:middle], program[middle : middle + program[N_OFF_DIAGONAL]]


@inlined
def update_runs_of(program):
    """Return, for each range of adjacent entries that updates change, its length and the index of its first entry."""
    begin = N_HEAD + 2 * program[N_PIVOTS] + 1 + program[N_OFF_DIAGONAL]
    return program[begin : begin + program[N_RUNS]]


@inlined
def mass_entries_of(program):
    """Return the rows and columns of the entries of M, and their slots (indices in the array of the factors)."""
    n = program[N_OF_MASS]
    begin = N_HEAD + 2 * program[N_PIVOTS] + 1 + program[N_OFF_DIAGONAL] + program[N_RUNS]
    return program[begin : begin + n], program[begin + n : begin + 2 * n], program[begin + 2 * n : begin + 3 * n]


@inlined
def jacobian_entries_of(program):
    """Return the rows and columns of the entries of G, and their slots (indices in the array of the factors)."""
    n = program[N_OF_JACOBIAN]
    begin = N_HEAD + 2 * program[N_PIVOTS] + 1 + program[N_OFF_DIAGONAL] + program[N_RUNS] + 3 * program[N_OF_MASS]
    return program[begin : begin + n], program[begin + n : begin + 2 * n], program[begin + 2 * n : begin + 3 * n]


@inlined
def stiffening_products_of(program):
    """For each product g_i g_j added to a singular M (g: row of G), return indices of g, g_i, g_j and the entry of M.

    The result consists of four lists. The index of the entry of M is its slot, the index in the array of the factors.
    """
    n = program[N_STIFFENED]
    begin = N_HEAD + 2 * program[N_PIVOTS] + 1 + program[N_OFF_DIAGONAL] + program[N_RUNS]
    begin += 3 * (program[N_OF_MASS] + program[N_OF_JACOBIAN])
    middle = begin + 2 * n
    slots = program[middle + n : middle + 2 * n]
    return program[begin : begin + n], program[begin + n : middle], program[middle : middle + n], slots
