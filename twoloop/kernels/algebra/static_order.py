"""The order in which the matrix of a large system is eliminated without looking at its numbers.

The coordinates that M couples, or that a joint names together, are a body; the rows that touch the same bodies are a
joint. Bodies of a few joints come first: what they leave is G M^-1 G^T, positive definite, and any order of its joints
is a stable one. A body with more joints than that, a hub, would couple all of them, and waits among the joints: with
hubs the order is that of constrained minimum degree. A joint may come before a hub that it touches, or that others
before it touch, only where its rows cannot have become dependent for want of the hub's motion: one of its bodies must
hang on nothing yet.
"""

import heapq
from collections.abc import Iterable, Sequence
from collections.abc import Set as AbstractSet

import numpy as np
from numpy.typing import NDArray

MOST_JOINTS = 4  # of a body that comes before its joints

Integers = NDArray[np.int64]


class _Sets:
    """Disjoint sets of the numbers below n."""

    def __init__(self, n: int):
        self.parent = list(range(n))

    def find(self, i: int) -> int:
        while self.parent[i] != i:
            self.parent[i] = self.parent[self.parent[i]]
            i = self.parent[i]
        return i

    def join(self, i: int, j: int) -> int:
        i, j = self.find(i), self.find(j)
        self.parent[max(i, j)] = min(i, j)
        return min(i, j)


class _Holds:
    """What holds the parts that eliminated bodies and joints make up: the ground, and hubs that are to come."""

    def __init__(self, joints: Sequence[frozenset[int]], n_bodies: int, hubs: set[int], lone: AbstractSet[int]):
        self.joints, self.hubs = joints, set(hubs)  # those that are left
        self.lone = lone  # single coordinates, of whose body nothing else is known: no part of these is surely free
        self.parts = _Sets(n_bodies)
        self.grounded = [False] * n_bodies
        self.hangs: list[set[int]] = [set() for _ in range(n_bodies)]
        self.hanging: dict[int, list[int]] = {hub: [] for hub in hubs}  # bodies whose parts hang, or hung, on a hub

    def lets(self, joint: int) -> bool:
        """Whether a joint may be eliminated."""
        bodies = self.joints[joint]
        parts = {self.parts.find(body) for body in bodies if body not in self.hubs}
        if not bodies & self.lone and any(not self.grounded[part] and not self.hangs[part] for part in parts):
            return True
        return not bodies & self.hubs and not any(self.hangs[part] for part in parts)

    def eliminate(self, joint: int) -> None:
        """Join the parts that a joint connects."""
        bodies = self.joints[joint]
        grounded = len(bodies) == 1 or bool(bodies & self.lone)
        self._join((body for body in bodies if body not in self.hubs), grounded, bodies & self.hubs)

    def eliminate_hub(self, hub: int) -> None:
        """Join the parts that hang on a hub, and the hub."""
        self.hubs.discard(hub)
        hanging = self.hanging.pop(hub)
        for body in hanging:
            self.hangs[body].discard(hub)
        self._join([hub, *hanging], False, frozenset())

    def _join(self, bodies: Iterable[int], grounded: bool, hubs: AbstractSet[int]) -> None:
        first, *others = bodies
        part = self.parts.find(first)
        for other in others:
            other = self.parts.find(other)
            if other != part:
                grounded = grounded or self.grounded[other] or self.grounded[part]
                hubs = {*hubs, *self.hangs[other], *self.hangs[part]}
                part = self.parts.join(part, other)
        self.grounded[part] = self.grounded[part] or grounded
        for hub in hubs - self.hangs[part]:
            self.hangs[part].add(hub)
            self.hanging[hub].append(part)


def elimination_order(
    n_q: int,
    n_rows: int,
    mass_entries: tuple[Integers, Integers],
    jacobian_entries: tuple[Integers, Integers],
    together: Iterable[Sequence[int]] = (),
    first: Sequence[int] = (),
    couplings: tuple[Integers, Integers] | None = None,
) -> Integers:
    """Coordinates j, and rows i as n_q + i, in the order of elimination.

    Parameters
    ----------
    n_q, n_rows : int
    mass_entries, jacobian_entries : (rows, columns)
        Of M and of G.
    together : iterable of sequence of int
        Coordinates of one body each, beyond those that M couples.
    first : sequence of int
        Rows of single bodies that come before all joints, but for those of hubs, so that they always count.
    couplings : (rows, columns), optional
        Entries by which bodies are coupled beside their joints, as by springs. All bodies then are hubs, each with the
        first of its rows.
    """
    body_of = bodies_of(n_q, mass_entries, together)
    touched: list[set[int]] = [set() for _ in range(n_rows)]
    for i, j in zip(*(each.tolist() for each in jacobian_entries), strict=True):
        touched[i].add(body_of[j])
    early = set(first)
    rows_of: dict[frozenset[int], list[int]] = {}
    for i, bodies in enumerate(touched):
        if i not in early:
            rows_of.setdefault(frozenset(bodies), []).append(i)
    joints = list(rows_of)
    joints_of: list[list[int]] = [[] for _ in range(n_q)]  # by body
    for k, joint in enumerate(joints):
        for body in joint:
            joints_of[body].append(k)
    hubs = {body for body in range(n_q) if len(joints_of[body]) > MOST_JOINTS}
    if couplings is not None:
        hubs = set(body_of)
    coordinates: dict[int, list[int]] = {}
    for j, body in enumerate(body_of):
        coordinates.setdefault(body, []).append(j)
    order = [j for j in range(n_q) if body_of[j] not in hubs]
    order += [n_q + i for i in first if not touched[i] & hubs]
    late = [n_q + i for i in first if touched[i] & hubs]
    if couplings is not None:
        for i in first:
            coordinates[next(iter(touched[i]))].append(n_q + i)
        late = []
    nodes = [[n_q + i for i in rows_of[joint]] for joint in joints] + [coordinates[hub] for hub in sorted(hubs)]
    pairs: set[tuple[int, int]] = set()
    lone: set[int] = set()
    if couplings is not None:
        pairs = {(body_of[i], body_of[j]) for i, j in zip(*couplings, strict=True)}
        lone = {hub for hub in hubs if len(coordinates[hub]) == 1}
    sizes = [len(node) for node in nodes]
    for node in _minimum_degree(joints, joints_of, sorted(hubs), sizes, n_q, pairs, lone):
        order += nodes[node]
    order += late
    return np.array(order, dtype=np.int64)


def bodies_of(n_q: int, mass_entries: tuple[Integers, Integers], together: Iterable[Sequence[int]]) -> list[int]:
    """Of each coordinate, the first of its body."""
    pairs = np.array([(first, other) for first, *others in together for other in others], dtype=np.int64).reshape(-1, 2)
    ones, others = (np.concatenate([entries, column]) for entries, column in zip(mass_entries, pairs.T, strict=True))
    first_of, before = np.arange(n_q), np.full(n_q, -1)
    while (first_of != before).any():
        before = first_of.copy()
        least = np.minimum(first_of[ones], first_of[others])
        np.minimum.at(first_of, ones, least)
        np.minimum.at(first_of, others, least)
        first_of = first_of[first_of]
    return first_of.tolist()  # type: ignore[no-any-return]


def _minimum_degree(
    joints: Sequence[frozenset[int]],
    joints_of: Sequence[Sequence[int]],
    hubs: Sequence[int],
    sizes: Sequence[int],
    n_bodies: int,
    pairs: Iterable[tuple[int, int]],
    lone: AbstractSet[int],
) -> list[int]:
    """Joints, and hubs as len(joints) + their place: each time, of those that may come, one with fewest neighbours.

    `pairs`: of hubs that are coupled beside their joints. `lone`: see _Holds.
    """
    n_joints = len(joints)
    place = {hub: n_joints + k for k, hub in enumerate(hubs)}
    near: list[set[int]] = [set() for _ in sizes]
    for body, numbers in enumerate(joints_of):
        if body in place:
            near[place[body]].update(numbers)
            for k in numbers:
                near[k].add(place[body])
        else:
            for k in numbers:
                near[k].update(numbers)
    for one, other in pairs:
        near[place[one]].add(place[other])
        near[place[other]].add(place[one])
    for k, others in enumerate(near):
        others.discard(k)
    holds = _Holds(joints, n_bodies, set(hubs), lone)

    def degree(node: int) -> int:
        return sum(sizes[other] for other in near[node])

    heap = [(degree(node), node) for node in range(len(sizes))]
    heapq.heapify(heap)
    done, order = [False] * len(sizes), []
    while heap:
        known, node = heapq.heappop(heap)
        if done[node] or known != degree(node):
            continue  # there is a newer entry
        if node < n_joints and not holds.lets(node):
            continue  # it comes up again when a hub is gone that others before it hang on: the two are neighbours
        done[node] = True
        order.append(node)
        changed = near[node]
        for other in changed:
            near[other] |= changed
            near[other] -= {node, other}
        if node < n_joints:
            holds.eliminate(node)
        else:
            holds.eliminate_hub(hubs[node - n_joints])
        for other in changed:
            heapq.heappush(heap, (degree(other), other))
    return order
