"""Small computations behind the claims: equations and coefficients of the paper that need no run."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import DOP853, RK45

from references.four_bar_minimal import MinimalFourBar
from studies.claims_sweeps import Step, choice, independents, kkt
from studies.runs import Y3
from twoloop.mechanisms import Problem
from twoloop.tableaux import sun_radau_iib

Array = NDArray[np.float64]
Row = dict[str, Any]

PHASES = 40  # instants of a period at which an equation is looked at


def row(check: str, case: str, value: float, setting: float = np.nan, problem: str = "none") -> Row:
    """One number of claims.csv."""
    return {"check": check, "problem": problem, "case": case, "setting": setting, "value": float(value)}


def motion(problem: Problem, n: int = PHASES) -> tuple[Array, Array, Array]:
    """Times and true states over a period, rest left out."""
    truth = MinimalFourBar.from_parameters(problem.parameters)
    t = truth.period * (np.arange(n) + 0.37) / n
    return t, *truth.states(t)


def closure(problem: Problem) -> Iterator[Row]:
    """(35) as printed and with a sine, along the true motion."""
    lengths = np.array([problem.parameters[name] for name in ("L1", "L2", "L3")])
    _, q, _ = motion(problem)
    angles = np.column_stack([problem.q0, q])[2::3]
    vertical = lengths @ np.sin(angles)
    printed = vertical + lengths[2] * (np.cos(angles[2]) - np.sin(angles[2]))
    for case, values in (("printed, cosine", printed), ("sine", vertical)):
        yield row("(35)", f"{case}: largest residual, m", np.abs(values).max(), problem=problem.name)
        yield row("(35)", f"{case}: residual at q0, m", abs(values[0]), problem=problem.name)


def equations(problem: Problem) -> Iterator[Row]:
    """(6)-(8), (14), (15), the sizes of Sect. 2.2 and the index along the true motion."""
    system, name = problem.system, problem.name
    worst = {"lam by (7)": 0.0, "a by (8)": 0.0, "v by (14)": 0.0, "dq by (15)": 0.0}
    ranks, singular = [], []
    for t, q, v in zip(*(np.atleast_2d(x).T if x.ndim > 1 else x for x in motion(problem)), strict=True):
        a, lam = kkt(system, t, q, v)
        C_q, M, Q, Q_d = system.jacobian(t, q), system.mass(t, q), system.force(t, q, v), system.gamma(t, q, v)
        S = C_q @ np.linalg.solve(M, C_q.T)
        lam_7 = np.linalg.solve(S, C_q @ np.linalg.solve(M, Q) - Q_d)
        a_8 = np.linalg.solve(M, Q) - np.linalg.solve(M, C_q.T @ lam_7)
        i = independents(C_q)
        d = [k for k in range(system.n_q) if k not in i]
        matrix = np.vstack([C_q, choice(system.n_q, i)])
        v_14 = np.linalg.solve(matrix, np.concatenate([np.zeros(system.n_c), v[i]]))
        v_direct = v.copy()
        v_direct[d] = np.linalg.solve(C_q[:, d], -C_q[:, i] @ v[i])
        off = q + 1e-3 * np.sin(1.0 + np.arange(system.n_q))
        C, C_off = system.constraint(t, off), system.jacobian(t, off)
        dq_15 = np.linalg.solve(np.vstack([C_off, choice(system.n_q, i)]), np.concatenate([-C, np.zeros(len(i))]))
        dq_direct = np.zeros(system.n_q)
        dq_direct[d] = np.linalg.solve(C_off[:, d], -C)
        for case, one, two in (
            ("lam by (7)", lam_7, lam),
            ("a by (8)", a_8, a),
            ("v by (14)", v_14, v_direct),
            ("dq by (15)", dq_15, dq_direct),
        ):
            worst[case] = max(worst[case], float(np.abs(one - two).max() / np.abs(two).max()))
        values = np.linalg.svd(C_q, compute_uv=False)
        ranks.append(int((values > 1e-10 * values[0]).sum()))
        values = np.linalg.eigvalsh(S)
        singular.append(values[0] / values[-1])
    for case, value in worst.items():
        yield row("(6)-(15)", f"{case}: relative difference from the direct solution", value, problem=name)
    yield row("sizes", "least rank of C_q", min(ranks), problem=name)
    yield row("sizes", "n_q", system.n_q, problem=name)
    yield row("sizes", "n_c", system.n_c, problem=name)
    yield row("sizes", "components of z", len(np.concatenate([problem.q0, problem.v0])), problem=name)
    yield row("index", "least eigenvalue of C_q M^-1 C_q^T over the largest", min(singular), problem=name)


def partitions(problem: Problem) -> Iterator[Row]:
    """What LU, QR and SVD take for independent, and how long the first choice of LU is good."""
    system, name = problem.system, problem.name
    C_q = system.jacobian(0.0, problem.q0)
    first = independents(C_q)
    tangent = np.linalg.svd(C_q)[2][system.n_c :]
    complement = np.linalg.qr(C_q.T, mode="complete")[0][:, system.n_c :].T
    for case, basis in (("LU", choice(system.n_q, first)), ("SVD", tangent), ("QR", complement)):
        used = int((np.abs(basis) > 1e-8).sum(axis=1).max())
        yield row("independent coordinates", f"{case}: coordinates in one of them", used, problem=name)
    d = [k for k in range(system.n_q) if k not in first]
    _, q, _ = motion(problem, 20 * PHASES)
    signs = [np.linalg.slogdet(system.jacobian(0.0, state)[:, d])[0] for state in q.T]
    lost = float(np.count_nonzero(np.diff(signs)))
    yield row("independent coordinates", "first choice becomes singular, times a period", lost, problem=name)


def heights(problem: Problem, name: str) -> Iterator[Row]:
    """How high the centre of bar 3 comes in the true motion, and how large its numbers are."""
    truth = MinimalFourBar.from_parameters(problem.parameters)
    q, v = truth.states(np.linspace(0.0, truth.period, 4001))
    yield row("true motion", "highest y3, m", q[Y3].max(), problem=name)
    yield row("true motion", "largest component of q or v", max(np.abs(q).max(), np.abs(v).max()), problem=name)


def moving_base() -> Iterator[Row]:
    """(5) and (24) where the constraint depends on time: a pendulum whose pivot moves by X = sin(w t) / 2."""
    rate, path_rate = 3.0, 1.3

    def pivot(t: float) -> tuple[float, float, float]:
        phase = rate * t
        return 0.5 * np.sin(phase), 0.5 * rate * np.cos(phase), -0.5 * rate**2 * np.sin(phase)

    def path(t: float) -> Array:
        return np.array([np.cos(t) + 0.3 * np.sin(2.0 * t), np.sin(path_rate * t)])

    def violation(t: float) -> float:
        x, y = path(t)
        return float((x - pivot(t)[0]) ** 2 + y**2 - 1.0)

    worst = {"as printed": 0.0, "opposite sign": 0.0}
    for t in np.linspace(0.1, 2.0, 20):
        d = 1e-3  # differences of order 4: the error is about 1e-9
        q = path(t)
        v = np.array([-np.sin(t) + 0.6 * np.cos(2.0 * t), path_rate * np.cos(path_rate * t)])
        a = np.array([-np.cos(t) - 1.2 * np.sin(2.0 * t), -(path_rate**2) * np.sin(path_rate * t)])
        X, dX, ddX = pivot(t)
        C_q = np.array([2.0 * (q[0] - X), 2.0 * q[1]])
        C_tt = 2.0 * dX**2 - 2.0 * (q[0] - X) * ddX
        Q_d = -(2.0 * v @ v + 2.0 * (-2.0 * dX * v[0]) + C_tt)
        values = [violation(t + k * d) for k in (-2, -1, 0, 1, 2)]
        second = (-values[0] + 16.0 * values[1] - 30.0 * values[2] + 16.0 * values[3] - values[4]) / (12.0 * d * d)
        worst["as printed"] = max(worst["as printed"], abs(C_q @ a - Q_d - second))
        worst["opposite sign"] = max(worst["opposite sign"], abs(C_q @ a + Q_d - second))
    for case, value in worst.items():
        yield row("(5)", f"{case}: largest error of C'' = C_q a - Q_d", value, problem="moving pivot")
    # (24): y is dependent; the same rate of x at two places, and at two instants of one place
    rates = []
    for t, angle in ((0.1, 0.4), (0.1, 0.9), (0.8, 0.4)):
        _, dX, _ = pivot(t)
        rates.append(np.tan(angle) * (1.0 - dX))  # v_y where x = X + sin, y = -cos and v_x = 1, from C_q v = -C_t
    yield row("(24)", "change of v_d with q_i at equal v_i, m/s", abs(rates[1] - rates[0]), problem="moving pivot")
    yield row("(24)", "change of v_d with t at equal q_i, v_i, m/s", abs(rates[2] - rates[0]), problem="moving pivot")


def tableau() -> Iterator[Row]:
    """Table 1: what its legible entries determine, the simplifying assumptions, symplecticity, spectral radius."""
    r = np.sqrt(6.0)
    b = np.array([(16 - r) / 36, (16 + r) / 36, 0.0])
    b[2] = 1.0 - b.sum()  # lost in the text: weights add up to one, the method is symplectic, nodes are row sums
    A = np.array(
        [
            [(16 - r) / 72, (328 - 167 * r) / 1800, (-2 + 3 * r) / 450],
            [(328 + 167 * r) / 1800, (16 + r) / 72, (-2 - 3 * r) / 450],
            [(85 - 10 * r) / 180, (85 + 10 * r) / 180, b[2] / 2.0],
        ]
    )
    c = A.sum(axis=1)
    yield row(
        "Table 1", "difference of its first two nodes from the row sums", max(abs(c[:2] - [0.4 - r / 10, 0.4 + r / 10]))
    )
    lost = np.zeros_like(A)
    lost[:2], lost[2, :2] = A[:2], A[2, :2]
    for case, matrix, weights in (("restored", A, b), ("lost entries zero", lost, b * [1, 1, 0])):
        nodes = matrix.sum(axis=1)
        defects = [abs(weights @ nodes ** (k - 1) - 1.0 / k) for k in range(1, 7)]
        C = max(np.abs(matrix @ nodes ** (k - 1) - nodes**k / k).max() for k in (1, 2))
        D = max(np.abs((weights * nodes ** (k - 1)) @ matrix - weights * (1.0 - nodes**k) / k).max() for k in (1, 2))
        bA = weights[:, None] * matrix
        yield row("Table 1", f"{case}: worst of B(5), C(2), D(2)", max(*defects[:5], C, D))
        yield row("Table 1", f"{case}: B(6)", defects[5])
        yield row(
            "Table 1", f"{case}: b_i a_ij + b_j a_ji - b_i b_j", np.abs(bA + bA.T - np.outer(weights, weights)).max()
        )
    yield row("Table 1", "restored: spectral radius of A", np.abs(np.linalg.eigvals(A)).max())
    yield row("Table 1", "difference of twoloop's tableau from it", np.abs(sun_radau_iib(3).A - A).max())


EXPLICIT: dict[str, tuple[list[list[float]], list[float]]] = {
    "Euler": ([[0.0]], [1.0]),
    "midpoint": ([[0.0, 0.0], [0.5, 0.0]], [0.0, 1.0]),
    "classical of order 4": (
        [[0.0] * 4, [0.5, 0.0, 0.0, 0.0], [0.0, 0.5, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]],
        [1 / 6, 1 / 3, 1 / 3, 1 / 6],
    ),
    "Dormand-Prince 5": (RK45.A.tolist(), RK45.B.tolist()),
    "Dormand-Prince 8": (DOP853.A.tolist(), DOP853.B.tolist()),
}


def explicit() -> Iterator[Row]:
    """b_i a_ij + b_j a_ji - b_i b_j of explicit tableaux; on its diagonal stands -b_i^2."""
    for name, (rows, weights) in EXPLICIT.items():
        b = np.array(weights)
        A = np.zeros((b.size, b.size))
        given = np.array(rows)
        A[: given.shape[0], : given.shape[1]] = given
        yield row("explicit tableaux", f"{name}: largest entry above or on the diagonal", np.abs(np.triu(A)).max())
        defect = b[:, None] * A + (b[:, None] * A).T - np.outer(b, b)
        yield row("explicit tableaux", f"{name}: largest diagonal entry of the defect", np.abs(np.diag(defect)).max())


def newmark_map() -> Iterator[Row]:
    """Determinant of Newmark's step as a map of (q, v), for q'' = -sin q: 1 where it is symplectic."""

    def step(beta: float, gamma: float, q: float, v: float, h: float = 0.2) -> Array:
        a, a1 = -np.sin(q), -np.sin(q)
        for _ in range(60):
            q1 = q + h * v + h * h * ((0.5 - beta) * a + beta * a1)
            a1 = -np.sin(q1)
        return np.array([q1, v + h * ((1.0 - gamma) * a + gamma * a1)])

    d = 1e-3
    for beta, gamma in ((0.0, 0.5), (0.25, 0.5), (0.5, 0.5), (0.25, 0.6)):
        columns = []
        for dq, dv in ((d, 0.0), (0.0, d)):
            two, one, minus, minus2 = (step(beta, gamma, 1.0 + k * dq, 0.5 + k * dv) for k in (2, 1, -1, -2))
            columns.append((minus2 - 8.0 * minus + 8.0 * one - two) / (12.0 * d))
        determinant = np.linalg.det(np.array(columns).T)
        yield row(
            "Newmark's map",
            f"beta = {beta:g}, gamma = {gamma:g}: |det - 1|",
            abs(determinant - 1.0),
            problem="q'' = -sin q",
        )


def iteration_map(problem: Problem) -> Iterator[Row]:
    """(18): two sets of stages that give the same y_{n+1}, and what a sweep makes of each."""
    t, q, v = motion(problem)
    one, two = (Step(problem.system, sun_radau_iib(3), t[3], 0.05, q[:, 3], v[:, 3]) for _ in range(2))
    b = one.tableau.b
    two.A_stage += 0.1 * np.array([[b[1]], [-b[0]], [0.0]])  # across b: sum b K stays as it is
    two.V_stage += 0.1 * np.array([[b[1]], [-b[0]], [0.0]])
    given = [np.concatenate([step.tableau.b @ step.A_stage, step.tableau.b @ step.V_stage]) for step in (one, two)]
    for step in (one, two):
        step.sweep()
    name = problem.name
    yield row("(18)", "difference of the given sums b K", np.abs(given[0] - given[1]).max(), problem=name)
    yield row("(18)", "difference of the stages", np.abs(0.1 * b[:2]).max(), problem=name)
    difference = max(np.abs(one.q1 - two.q1).max(), np.abs(one.v1 - two.v1).max())
    yield row("(18)", "difference of the next y", difference, problem=name)


def stopping_test() -> Iterator[Row]:
    """(32) as printed, |D / max(D, 1)|, against |D| / max(|y|, 1)."""
    for change in (1e-10, 1e-3, -5.0, 5.0, 1e6):
        yield row("(32)", "printed ratio for the change given as setting", abs(change / max(change, 1.0)), change)
    for size in (1.0, 1e3, 1e8):  # the least change that floating-point numbers of that size can have
        change = float(np.spacing(size))
        yield row(
            "(32)",
            "printed ratio of the least change of a value as large as the setting",
            change / max(change, 1.0),
            size,
        )
        yield row(
            "(32)",
            "corrected ratio of the least change of a value as large as the setting",
            change / max(size, 1.0),
            size,
        )
