"""Test mechanisms from M and Q, in velocities and in generalised speeds, and from sympy.physics.mechanics."""

import numpy as np
import pytest
import sympy as sp
from sympy.physics import mechanics as me

from tests.marks import slow
from tests.symbolic.models import body_spin, rates, rotation, symbolic_heavy_top, t
from twoloop.symbolic import from_lagrangian, from_matrices, from_method

m, length, g, k, span = sp.symbols("m length g k span")
VALUES = {m: 2.0, length: 0.7, g: 9.81, k: 3.0, span: 0.9}


def evaluated(mechanism, kind, t, *state):
    """What generated code gives without numba."""
    n, n_c, n_a = len(mechanism.coordinates), mechanism.n_c, mechanism.n_a
    shape = {"mass": (n, n), "jacobian": (n_c, n), "nonholonomic": (n_a, n), "force": n, "constraint": n_c}
    out = np.zeros(shape.get(kind, n_a if kind.startswith("nonholonomic") else n_c))
    mechanism.code.value(kind)(t, *state, np.array(list(mechanism.parameters.values())), out)
    return out


def same(one, other, kinds=None):
    """Whether two mechanisms give the same at random states."""
    assert one.code.kinds == other.code.kinds
    generic, n = np.random.default_rng(5), len(one.coordinates)
    for _ in range(4):
        q, v = generic.uniform(0.2, 1.2, n), generic.normal(size=n)
        for kind in kinds or [kind for kind in one.code.kinds if kind != "kinematics" and "_by_" not in kind]:
            state = (q, v) if kind in ("force", "gamma", "nonholonomic_gamma") else (q,)
            assert evaluated(one, kind, 0.3, *state) == pytest.approx(
                evaluated(other, kind, 0.3, *state), rel=1e-12, abs=1e-12
            ), kind


def two_rods(pivot=0):
    """Two masses on two rods in absolute angles, the second on a rail: energies, coordinates, constraint."""
    q = a, b = me.dynamicsymbols("a b")
    first = sp.Matrix([pivot + length * sp.cos(a), length * sp.sin(a)])
    second = first + sp.Matrix([length * sp.cos(b), length * sp.sin(b)])
    T = m * sum(each.diff(t) ** 2 for each in [*first, *second]) / 2
    return T, m * g * (first[1] + second[1]), [second[1] - span * sp.sin(k * t)], q


@pytest.mark.parametrize("pivot", [0, slow(span * sp.sin(k * t))])  # the second: T depends on time
def test_lagranges_method_gives_what_the_energies_give(pivot):
    T, V, constraints, q = two_rods(pivot)
    known = from_lagrangian(T, V, constraints, q, parameters=VALUES)
    same(from_method(me.LagrangesMethod(T - V, q, hol_coneqs=constraints), parameters=VALUES), known)
    free = me.LagrangesMethod(T - V, q)
    free.form_lagranges_equations()
    same(from_method(free, constraints=constraints, parameters=VALUES), known)
    same(from_matrices(free.mass_matrix, sp.ImmutableMatrix(free.forcing), constraints, q, parameters=VALUES), known)


def particles(u_of_rate=None):
    """The same two masses for Kane's method; `u_of_rate` maps a rate to its generalised speed."""
    q, u = me.dynamicsymbols("a b"), me.dynamicsymbols("u1 u2")
    frame, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(frame, 0)
    kinematic = [u[i] - (u_of_rate or (lambda each, i: each))(q[i].diff(t), i) for i in range(2)]
    known = sp.solve(kinematic, rates(q))
    place, bodies, loads = origin, [], []
    for i in range(2):
        axis = frame.orientnew(f"A{i}", "Axis", [q[i], frame.z])
        axis.set_ang_vel(frame, known[q[i].diff(t)] * frame.z)
        point = place.locatenew(f"P{i}", length * axis.x)
        point.v2pt_theory(place, frame, axis)
        bodies.append(me.Particle(f"B{i}", point, m))
        loads.append((point, -m * g * frame.y))
        place = point
    return frame, q, u, kinematic, bodies, loads


@pytest.mark.parametrize("of_rate", [None, lambda rate, i: (1 + i) * rate + sp.Rational(1, 2) * me.dynamicsymbols("a")])
def test_kanes_method_with_linear_kinematics(of_rate):
    T, V, constraints, coordinates = two_rods()
    frame, q, u, kinematic, bodies, loads = particles(of_rate)
    kane = me.KanesMethod(frame, q, u, kd_eqs=kinematic)
    kane.kanes_equations(bodies, loads)
    made = from_method(kane, constraints=constraints, potential=V, parameters=VALUES)
    same(made, from_lagrangian(T, V, constraints, coordinates, parameters=VALUES))
    q, v = np.array([0.3, 0.8]), np.array([1.0, -2.0])
    known = from_lagrangian(T, V, [], coordinates, parameters=VALUES)
    assert made.energy(0.0, q, v) == pytest.approx(known.energy(0.0, q, v), rel=1e-13)
    assert not made.conserved  # the rail moves
    assert from_method(kane, potential=V, parameters=VALUES).conserved
    assert not from_method(kane, parameters=VALUES).conserved  # without the potential


def test_euler_parameters_with_angular_velocities_as_speeds():
    """A tangent that constraints allow sees the same M and Q, though they differ across e.e = 1."""
    _, known = symbolic_heavy_top()
    x, e, u = me.dynamicsymbols("x y z"), me.dynamicsymbols("e0:4"), me.dynamicsymbols("u1:7")
    J = sp.symbols("J1:4")
    mass = sp.diag(m, m, m, *J)
    spin = sp.Matrix(u[3:])
    force = [0, 0, -m * g, *(-spin.cross(sp.diag(*J) * spin))]
    pivot = sp.Matrix(x) + rotation(e) * sp.Matrix([0, -length, 0])
    values = {symbol: known.parameters[symbol.name] for symbol in (m, length, g, *J)}
    constraints = [(sum(each**2 for each in e) - 1) / 2, *pivot]
    speeds = dict(zip(u, [*rates(x), *body_spin(e)], strict=True))
    made = from_matrices(mass, force, constraints, [*x, *e], speeds=speeds, potential=m * g * x[2], parameters=values)
    generic = np.random.default_rng(7)
    q, v = generic.normal(size=7), generic.normal(size=7)
    q[3:] /= np.linalg.norm(q[3:])
    v[3:] -= (v[3:] @ q[3:]) * q[3:]
    T = np.linalg.svd(q[None, 3:])[2][1:]  # directions along e.e = 1
    tangent = np.block([[np.eye(3), np.zeros((3, 4))], [np.zeros((3, 3)), T]])
    assert evaluated(made, "mass", 0.0, q) == pytest.approx(evaluated(known, "mass", 0.0, q), rel=1e-13, abs=1e-13)
    # accelerations along e.e = 1 satisfy e . e'' = -|e'|^2, on which both forces are taken
    assert tangent @ evaluated(made, "force", 0.0, q, v) == pytest.approx(
        tangent @ evaluated(known, "force", 0.0, q, v), rel=1e-12, abs=1e-12
    )
    assert made.energy(0.0, q, v) == pytest.approx(known.energy(0.0, q, v), rel=1e-13) and made.conserved
