"""The method of Dormand and Prince of order 5 at index 1, with steps by tolerance; each is projected."""

import numpy as np

A = (
    (),
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
C = (0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0)
E = (71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40)
CUTOFF = 1e-6


def least(A, b):
    """The smallest x of A x = b."""
    size = np.linalg.norm(A, axis=1, keepdims=True)
    return np.linalg.lstsq(A / size, b / size[:, 0], rcond=CUTOFF)[0]


def accelerations(problem, t, q, v):
    """a and lam of M a + C_q^T lam = Q, C_q a = gamma."""
    M, J, Q = problem.mass(t, q), problem.jacobian(t, q), problem.force(t, q, v)
    n, m = len(q), len(J)
    heavy, long = np.abs(M).max(), np.linalg.norm(J, axis=1)
    rows = J / long[:, None]
    matrix = np.block([[M / heavy, rows.T], [rows, np.zeros((m, m))]])
    right = np.concatenate([Q / heavy, problem.gamma(t, q, v) / long])
    if not np.isfinite(right).all():
        raise ArithmeticError("not finite")
    x = np.linalg.lstsq(matrix, right, rcond=CUTOFF)[0]
    return x[:n], x[n:] * heavy / long


def projected(problem, t, q, v):
    """The nearest state on the constraints."""
    for _ in range(12):
        change = least(problem.jacobian(t, q), -problem.constraint(t, q))
        q = q + change
        if np.abs(change).max() < 1e-11 * max(1.0, np.abs(q).max()):
            break
    else:
        raise ArithmeticError("no projection")
    J = problem.jacobian(t, q)
    return q, v - least(J, J @ v + problem.constraint_rate(t, q))


def one_step(problem, t, h, q, v):
    """The state after a step, and the estimate of its error."""
    qs, vs = [], []
    for k in range(7):
        qk = q + h * sum((a * each for a, each in zip(A[k], qs, strict=False)), 0.0 * q)
        vk = v + h * sum((a * each for a, each in zip(A[k], vs, strict=False)), 0.0 * v)
        qs.append(vk)
        vs.append(accelerations(problem, t + C[k] * h, qk, vk)[0])
    error_q = h * sum(e * each for e, each in zip(E, qs, strict=True))
    error_v = h * sum(e * each for e, each in zip(E, vs, strict=True))
    new_q, new_v = projected(problem, t + h, qk, vk)
    return new_q, new_v, error_q, error_v


def simulate(problem, times, tolerance):
    """Rows of q, v and lam at the times, at each of which a step ends."""
    t, q, v = times[0], problem.q0, problem.v0
    scale_q, scale_v = np.abs(q).max(), np.abs(v).max()
    rows = [(q, v, accelerations(problem, t, q, v)[1])]
    h = 1e-3 * (times[-1] - times[0])
    for end in times[1:]:
        n_tries = 0
        while t < end:
            n_tries += 1
            if n_tries > 20000:
                raise ArithmeticError("too many steps")
            step = min(h, end - t)
            new_q, new_v, error_q, error_v = one_step(problem, t, step, q, v)
            scale_q, scale_v = max(scale_q, np.abs(new_q).max()), max(scale_v, np.abs(new_v).max())
            ratio = max(np.abs(error_q).max() / scale_q, np.abs(error_v).max() / scale_v) / tolerance
            factor = min(5.0, max(0.2, 0.9 * max(ratio, 1e-10) ** -0.2))
            if ratio <= 1.0:
                t, q, v = (end if step == end - t else t + step), new_q, new_v
            h = step * factor if ratio > 1.0 or step == h else max(h, step * factor)
            if h < 1e-12 * (times[-1] - times[0]):
                raise ArithmeticError("step too short")
        rows.append((q, v, accelerations(problem, t, q, v)[1]))
    return tuple(np.array(each) for each in zip(*rows, strict=True))
