"""Define the slider-crank with a spring-damper of SUNDIALS' example for IDA, in two angles and the slider position."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from twoloop.kernels.compile.callbacks import callback
from twoloop.mechanisms.registry import stored_reference
from twoloop.problem.callbacks import callbacks_in
from twoloop.problem.description import Drawing
from twoloop.problem.problem import Array, Problem, Reference
from twoloop.problem.system import ConstrainedSystem

# p = [a, J1, m2, J2, k, c, l0, F]: half of the crank's length over the rod's, and so on; all in units of the example
PARAMETERS = {"a": 0.5, "J1": 1.0, "m2": 1.0, "J2": 2.0, "k": 1.0, "c": 1.0, "l0": 1.0, "F": 1.0}


@callback("mass")
def mass(t, q, p, M):
    M[0, 0], M[1, 1], M[2, 2] = p[1], p[2], p[3]


@callback("force")
def force(t, q, v, p, Q):
    a, s1, c1, s2, c2 = p[0], math.sin(q[0]), math.cos(q[0]), math.sin(q[2]), math.cos(q[2])
    # the spring connects the midpoints of crank and rod
    x, y = q[1] - 0.5 * (c2 + a * c1), -0.5 * (s2 + a * s1)
    xv, yv = v[1] + 0.5 * (s2 * v[2] + a * s1 * v[0]), -0.5 * (c2 * v[2] + a * c1 * v[0])
    length = math.hypot(x, y)
    pull = (p[4] * (length - p[6]) + p[5] * (x * xv + y * yv) / length) / length
    Q[0] = -0.5 * pull * a * (x * s1 - y * c1)
    Q[1] = -pull * x + p[7]
    Q[2] = -0.5 * pull * (x * s2 - y * c2) - p[7] * s2


@callback("constraint")
def constraint(t, q, p, C):
    C[0] = q[1] - math.cos(q[2]) - p[0] * math.cos(q[0])
    C[1] = -math.sin(q[2]) - p[0] * math.sin(q[0])


@callback("jacobian")
def jacobian(t, q, p, Cq):
    Cq[0, 0], Cq[0, 1], Cq[0, 2] = p[0] * math.sin(q[0]), 1.0, math.sin(q[2])
    Cq[1, 0], Cq[1, 2] = -p[0] * math.cos(q[0]), -math.cos(q[2])


@callback("gamma")
def gamma(t, q, v, p, Qd):
    crank, rod = p[0] * v[0] ** 2, v[2] ** 2
    Qd[0] = -crank * math.cos(q[0]) - rod * math.cos(q[2])
    Qd[1] = -crank * math.sin(q[0]) - rod * math.sin(q[2])


@dataclass(frozen=True, eq=False)
class Energy:
    """Evaluate kinetic energy, spring energy, and the potential of F; the damper dissipates them."""

    p: Array

    def __call__(self, t: Any, q: Array, v: Array) -> Any:
        """Evaluate for one state, or for many given as columns."""
        q, v = np.asarray(q), np.asarray(v)
        a, J1, m2, J2, k, _, l0, F = self.p
        x = q[1] - 0.5 * (np.cos(q[2]) + a * np.cos(q[0]))
        length = np.hypot(x, 0.5 * (np.sin(q[2]) + a * np.sin(q[0])))
        kinetic = 0.5 * (J1 * v[0] ** 2 + m2 * v[1] ** 2 + J2 * v[2] ** 2)
        return kinetic + 0.5 * k * (length - l0) ** 2 - F * (q[1] + np.cos(q[2]))


def joints(q: Array) -> Array:
    """Return crank centre, crank pin, slider, and both ends of the spring: (5, 2) or (5, 2, n_t)."""
    zero = np.zeros_like(q[0])
    pin = PARAMETERS["a"] * np.stack([np.cos(q[0]), np.sin(q[0])])
    slider = np.stack([q[1], zero])
    return np.stack([np.stack([zero, zero]), pin, slider, 0.5 * pin, 0.5 * (pin + slider)])


def sundials_slider_crank() -> Problem:
    """Return the slider-crank of SUNDIALS' example released from rest with its crank upright, over 10 s.

    Examples
    --------
    >>> from twoloop.mechanisms import sundials_slider_crank
    >>> problem = sundials_slider_crank()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (3, 2, 10.0)
    """
    p = np.array(list(PARAMETERS.values()))
    tilt = math.asin(-PARAMETERS["a"])
    system = ConstrainedSystem(
        n_q=3,
        n_c=2,
        **callbacks_in(globals()),
        parameters=p,
        constant_mass=True,
        name="SUNDIALS slider-crank",
    )
    return Problem(
        name="SUNDIALS slider-crank",
        system=system,
        q0=np.array([0.5 * math.pi, math.cos(tilt), tilt]),
        v0=np.zeros(3),
        t_span=(0.0, 10.0),
        energy=Energy(p),
        drawing=Drawing(joints, ((0, 1), (1, 2), (3, 4)), (1, 4)),
        parameters=PARAMETERS,
        reference=stored_reference("SUNDIALS slider-crank"),
        published=Reference(
            t=10.0,
            q=np.array([1.2757, 1.0236, -0.49881]),
            v=np.full(3, np.nan),
            source="LLNL/sundials, idaSlCrank_dns.out (rtol = atol = 1e-6), five printed digits",
            digits={"q": 4.4},
            verified="one degree of freedom, in extended precision: off by 4.3e-5 at most over the printed times",
        ),
        source="LLNL/sundials, examples/ida/serial/idaSlCrank_dns.c, there in a stabilised form of index 2",
        tags=("closed chain", "rigid", "planar", "dissipative"),
        purpose="A closed loop with a spring-damper and a constant force: forces that depend on velocities.",
        conserved=False,
        coordinates=("crank angle (rad)", "slider position (m)", "rod angle (rad)"),
    )
