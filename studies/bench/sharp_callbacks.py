"""Callbacks of the mechanisms under the forces of `sharp_forces`, whose parameters come after their own."""

from typing import Any

from studies.bench.sharp_forces import drive, force_along
from twoloop.bodies.callbacks import force as model_force
from twoloop.bodies.parameter_layout import HEAD
from twoloop.kernels.compile.callbacks import callback

GRAVITY = 9.81  # m/s^2

# --- callbacks of a chain of points, p = [n lengths, n masses, ...], that hangs from a pivot driven along x


@callback("mass")
def chain_mass(t, q, p, M):  # type: ignore[no-untyped-def]
    n = q.size // 2
    for i in range(q.size):
        M[i, i] = p[n + i // 2]


@callback("force")
def chain_force(t, q, v, p, Q):  # type: ignore[no-untyped-def]
    n = q.size // 2
    for k in range(n):
        Q[2 * k + 1] = -GRAVITY * p[n + k]
    Q[2 * n - 2] += force_along(t, q[2 * n - 2], v[2 * n - 2], p)


@callback("constraint")
def chain_constraint(t, q, p, C):  # type: ignore[no-untyped-def]
    for i in range(C.size):
        k, scale = i % (q.size // 2), 1.0 + i // (q.size // 2)  # a further row repeats one
        x = q[2 * k] - (drive(t, p)[0] if k == 0 else q[2 * k - 2])
        y = q[2 * k + 1] - (0.0 if k == 0 else q[2 * k - 1])
        C[i] = 0.5 * (x * x + y * y - p[k] * p[k]) * scale


@callback("jacobian")
def chain_jacobian(t, q, p, Cq):  # type: ignore[no-untyped-def]
    for i in range(Cq.shape[0]):
        k, scale = i % (q.size // 2), 1.0 + i // (q.size // 2)
        x = scale * (q[2 * k] - (drive(t, p)[0] if k == 0 else q[2 * k - 2]))
        y = scale * (q[2 * k + 1] - (0.0 if k == 0 else q[2 * k - 1]))
        Cq[i, 2 * k] = x
        Cq[i, 2 * k + 1] = y
        if k > 0:
            Cq[i, 2 * k - 2] = -x
            Cq[i, 2 * k - 1] = -y


@callback("constraint_rate")
def chain_rate(t, q, p, Ct):  # type: ignore[no-untyped-def]
    f, rate, _ = drive(t, p)
    for i in range(0, Ct.size, q.size // 2):
        Ct[i] = -(1.0 + i // (q.size // 2)) * (q[0] - f) * rate


@callback("gamma")
def chain_gamma(t, q, v, p, Qd):  # type: ignore[no-untyped-def]
    f, rate, second = drive(t, p)
    for i in range(Qd.size):
        k, scale = i % (q.size // 2), 1.0 + i // (q.size // 2)
        x = v[2 * k] - (rate if k == 0 else v[2 * k - 2])
        y = v[2 * k + 1] - (0.0 if k == 0 else v[2 * k - 1])
        Qd[i] = scale * ((q[0] - f) * second * (k == 0) - (x * x + y * y))


# --- of two masses on springs with x1 + x2 = the drive, p = [two stiffnesses, two masses, ...]


@callback("mass")
def row_mass(t, q, p, M):  # type: ignore[no-untyped-def]
    M[0, 0] = p[2]
    M[1, 1] = p[3]


@callback("force")
def row_force(t, q, v, p, Q):  # type: ignore[no-untyped-def]
    Q[0] = -p[0] * q[0]
    Q[1] = -p[1] * q[1] + force_along(t, q[1], v[1], p)


@callback("constraint")
def row_constraint(t, q, p, C):  # type: ignore[no-untyped-def]
    C[0] = q[0] + q[1] - drive(t, p)[0]


@callback("jacobian")
def row_jacobian(t, q, p, Cq):  # type: ignore[no-untyped-def]
    Cq[0, 0] = 1.0
    Cq[0, 1] = 1.0


@callback("constraint_rate")
def row_rate(t, q, p, Ct):  # type: ignore[no-untyped-def]
    Ct[0] = -drive(t, p)[1]


@callback("gamma")
def row_gamma(t, q, v, p, Qd):  # type: ignore[no-untyped-def]
    Qd[0] = drive(t, p)[2]


# --- of ready mechanisms: a torque on the first bar of the four-bar linkage, a force along the slider in space


@callback("force")
def four_bar_force(t, q, v, p, Q):  # type: ignore[no-untyped-def]
    for i in range(3):
        Q[3 * i + 1] = -p[i] * GRAVITY
    Q[2] += force_along(t, q[2], v[2], p)


@callback("force")
def slider_force(t, q, v, p, Q):  # type: ignore[no-untyped-def]
    model_force(t, q, v, p, Q)
    Q[14] += force_along(t, q[14], v[14], p[: p.size - HEAD])


CHAIN: dict[str, Any] = {"mass": chain_mass, "force": chain_force, "constraint": chain_constraint}
CHAIN |= {"jacobian": chain_jacobian, "constraint_rate": chain_rate, "gamma": chain_gamma}
ROW: dict[str, Any] = {"mass": row_mass, "force": row_force, "constraint": row_constraint}
ROW |= {"jacobian": row_jacobian, "constraint_rate": row_rate, "gamma": row_gamma}
