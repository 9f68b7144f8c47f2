"""The paper's equations and outer loop in plain NumPy, independent of the kernels, for the analysis of single steps."""

from dataclasses import dataclass

import numpy as np

from references.paper.four_bar_minimal import MinimalFourBar
from twoloop import ConstrainedSystem
from twoloop.mechanisms import Problem
from twoloop.methods.tableaux import Tableau
from twoloop.problem.problem import Array

NEWTON_TOL = 1e-14
MAX_NEWTON = 30
MAX_ITERATIONS = 200  # as in the kernel
HOPELESS = 1e6  # a change per iteration above this means divergence


def true_states(problem: Problem, n: int) -> list[tuple[float, Array, Array]]:
    """Return times and exact states of a linkage at n phases of a period, without rest positions."""
    truth = MinimalFourBar.from_parameters(problem.parameters)
    t = truth.period * (np.arange(n) + 0.37) / n
    q, v = truth.states(t)
    return list(zip(t.tolist(), q.T, v.T, strict=True))


def independents(jacobian: Array) -> list[int]:
    """Return the independent coordinates: the columns without pivots in Gaussian elimination with full pivoting."""
    matrix, columns = jacobian.copy(), list(range(jacobian.shape[1]))
    for k in range(len(matrix)):
        row, column = (int(place) for place in np.unravel_index(np.abs(matrix[k:, k:]).argmax(), matrix[k:, k:].shape))
        matrix[[k, k + row]] = matrix[[k + row, k]]
        matrix[:, [k, k + column]] = matrix[:, [k + column, k]]
        columns[k], columns[k + column] = columns[k + column], columns[k]
        matrix[k + 1 :] -= np.outer(matrix[k + 1 :, k] / matrix[k, k], matrix[k])
    return sorted(columns[len(matrix) :])


def kkt(system: ConstrainedSystem, t: float, q: Array, v: Array) -> tuple[Array, Array]:
    """Return accelerations and multipliers from (6), solved as a whole."""
    jacobian = system.jacobian(t, q)
    zero = np.zeros((system.n_c, system.n_c))
    matrix = np.block([[system.mass(t, q), jacobian.T], [jacobian, zero]])
    solution = np.linalg.solve(matrix, np.concatenate([system.force(t, q, v), system.gamma(t, q, v)]))
    return solution[: system.n_q], solution[system.n_q :]


@dataclass
class Step:
    """The outer loop of one step, iteration by iteration, from an explicit Euler prediction.

    `A_stage`, `V_stage` (s, n_q) are the stage derivatives K = [a, v]; `q1`, `v1` (n_q,) are the end of the step after
    the last iteration, satisfying the constraints.
    """

    system: ConstrainedSystem
    tableau: Tableau
    t: float
    h: float
    q: Array
    v: Array

    def __post_init__(self) -> None:
        self.independent = independents(self.system.jacobian(self.t, self.q))
        self.I_in = np.eye(self.system.n_q)[self.independent]  # of (14), (15)
        a, _ = kkt(self.system, self.t, self.q, self.v)
        self.q1, self.v1 = self.dependents(self.t + self.h, self.q + self.h * self.v, self.v + self.h * a)
        a1, _ = kkt(self.system, self.t + self.h, self.q1, self.v1)
        stages = self.tableau.stages
        self.A_stage, self.V_stage = np.tile(a1, (stages, 1)), np.tile(self.v1, (stages, 1))

    def continue_from(self, previous: "Step") -> None:
        """Predict the stages by extrapolating the collocation polynomial of the previous step, instead of by Euler."""
        x, c = (previous.h + self.h * self.tableau.c) / previous.h, self.tableau.c
        weights = np.linalg.solve(np.vander(c).T, np.vander(x, len(c)).T).T
        self.A_stage, self.V_stage = weights @ previous.A_stage, weights @ previous.V_stage

    def dependents(self, t: float, q: Array, v: Array) -> tuple[Array, Array]:
        """Return dependent positions by (15) and dependent velocities by (14)."""
        q = q.copy()
        for _ in range(MAX_NEWTON):
            matrix = np.vstack([self.system.jacobian(t, q), self.I_in])
            zero = np.zeros(len(self.independent))
            correction = np.linalg.solve(matrix, np.concatenate([-self.system.constraint(t, q), zero]))
            q += correction
            if np.abs(correction).max() < NEWTON_TOL * max(1.0, np.abs(q).max()):
                break
        matrix = np.vstack([self.system.jacobian(t, q), self.I_in])
        v = np.linalg.solve(matrix, np.concatenate([-self.system.constraint_rate(t, q), v[self.independent]]))
        return q, v

    def iterate(self) -> tuple[float, float]:
        """Perform one iteration, stage by stage; return the change by (32), corrected, and the norm of (33)."""
        old = np.concatenate([self.q1, self.v1])
        A, b, c = self.tableau.A, self.tableau.b, self.tableau.c
        for j in range(self.tableau.stages):
            q, v = self._combine_stages(A[j])
            q, v = self.dependents(self.t + c[j] * self.h, q, v)
            self.A_stage[j], _ = kkt(self.system, self.t + c[j] * self.h, q, v)
            self.V_stage[j] = v
        self.q1, self.v1 = self.dependents(self.t + self.h, *self._combine_stages(b))
        new = np.concatenate([self.q1, self.v1])
        return float(np.max(np.abs(new - old) / np.maximum(np.abs(new), 1.0))), float(np.linalg.norm(new - old))

    def _combine_stages(self, weights: Array) -> tuple[Array, Array]:
        """Return y_n + h sum(weights K) for the independents; the others keep their values at the start of the step."""
        q, v, i = self.q.copy(), self.v.copy(), self.independent
        q[i] += self.h * weights @ self.V_stage[:, i]
        v[i] += self.h * weights @ self.A_stage[:, i]
        return q, v

    def converge(self, tolerance: float) -> int | None:
        """Iterate until (32) holds and return the number of iterations; None if it does not converge."""
        for n in range(1, MAX_ITERATIONS + 1):
            try:
                change, size = self.iterate()
            except np.linalg.LinAlgError:
                return None
            if change <= tolerance:
                return n
            if not size < HOPELESS:
                return None
        return None


def advance(
    system: ConstrainedSystem, tableau: Tableau, t: float, h: float, q: Array, v: Array, n: int, tolerance: float
) -> tuple[Array, int]:
    """Return the state [q, v] after n steps that cover h together, and the number of iterations.

    Raises RuntimeError if a step does not converge.
    """
    count = 0
    for k in range(n):
        step = Step(system, tableau, t + k * h / n, h / n, q, v)
        needed = step.converge(tolerance)
        if needed is None:
            raise RuntimeError(f"a step of {h / n:g} s at {t:g} s does not converge")
        q, v, count = step.q1, step.v1, count + needed
    return np.concatenate([q, v]), count
