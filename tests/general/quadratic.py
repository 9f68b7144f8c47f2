"""Constraints quadratic in the coordinates, C = sum of c q_i q_j + linear + constant, and their derivatives."""

import numpy as np


class Rows:
    """Rows under construction; a scalar is a dict from coordinate to coefficient, with None for the constant."""

    def __init__(self, n_q):
        self.n_q, self.n_c = n_q, 0
        self._quadratic, self._linear, self._constant = [], [], []

    def add(self, *products):
        """A row: the sum of c a b over the products (c, a, b) of two scalars, equal to zero; returns its number."""
        row, constant = self.n_c, 0.0
        for factor, first, second in products:
            for i, a in first.items():
                for j, b in second.items():
                    c = factor * a * b
                    if i is None and j is None:
                        constant += c
                    elif i is None or j is None:
                        self._linear.append((row, j if i is None else i, c))
                    else:
                        self._quadratic.append((row, i, j, c))
        self._constant.append(constant)
        self.n_c += 1
        return row

    def functions(self):
        """The callbacks constraint, jacobian and gamma, which numba can compile."""
        n_q, n_c = self.n_q, self.n_c
        constant = np.array(self._constant)
        quadratic = np.array([term[:3] for term in self._quadratic], dtype=np.int64).reshape(-1, 3)
        by_two = np.array([term[3] for term in self._quadratic])
        linear = np.array([term[:2] for term in self._linear], dtype=np.int64).reshape(-1, 2)
        by_one = np.array([term[2] for term in self._linear])

        def constraint(t, q):
            C = constant.copy()
            for k in range(by_one.size):
                C[linear[k, 0]] += by_one[k] * q[linear[k, 1]]
            for k in range(by_two.size):
                C[quadratic[k, 0]] += by_two[k] * q[quadratic[k, 1]] * q[quadratic[k, 2]]
            return C

        def jacobian(t, q):
            Cq = np.zeros((n_c, n_q))
            for k in range(by_one.size):
                Cq[linear[k, 0], linear[k, 1]] += by_one[k]
            for k in range(by_two.size):
                row, i, j = quadratic[k]
                Cq[row, i] += by_two[k] * q[j]
                Cq[row, j] += by_two[k] * q[i]
            return Cq

        def gamma(t, q, v):
            Qd = np.zeros(n_c)
            for k in range(by_two.size):
                Qd[quadratic[k, 0]] -= 2.0 * by_two[k] * v[quadratic[k, 1]] * v[quadratic[k, 2]]
            return Qd

        return {"constraint": constraint, "jacobian": jacobian, "gamma": gamma}


ONE = {None: 1.0}


def difference(a, b):
    """The scalar a - b."""
    result = dict(a)
    for place, value in b.items():
        result[place] = result.get(place, 0.0) - value
    return result


def distance(rows, first, second, length):
    """A row: half the square of the distance of two points (lists of scalars) is that of the length."""
    parts = [(0.5, difference(a, b), difference(a, b)) for a, b in zip(first, second, strict=True)]
    return rows.add(*parts, (-0.5 * length**2, ONE, ONE))
