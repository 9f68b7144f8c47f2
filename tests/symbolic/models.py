"""Ready mechanisms, written again as energies and constraints for SymPy, with their numbers."""

from collections.abc import Callable, Sequence
from typing import Any

import sympy as sp
from sympy.physics.mechanics import dynamicsymbols

from twoloop import mechanisms
from twoloop.problem.problem import Problem
from twoloop.symbolic import SymbolicMechanism, from_lagrangian

t = dynamicsymbols._t


def rates(coordinates: Sequence[Any]) -> list[Any]:
    """Their derivatives by time."""
    return [each.diff(t) for each in coordinates]


Made = tuple[Problem, SymbolicMechanism]
MODELS: dict[str, Callable[..., Made]] = {}


def model(name: str) -> Callable[[Callable[[], tuple[Any, ...]]], Callable[..., Made]]:
    """Make of a function that gives a problem, T, V, constraints, q, numbers and options its problem and mechanism."""

    def decorate(parts: Callable[[], tuple[Any, ...]]) -> Callable[..., Made]:
        def made(tangents: bool = False) -> Made:
            problem, *energies, values, more = parts()
            return problem, from_lagrangian(*energies, parameters=values, tangents=tangents, name=name, **more)

        MODELS[name] = made
        return made

    return decorate


@model("four-bar")
def symbolic_four_bar() -> tuple[Any, ...]:
    q = dynamicsymbols("x1 y1 th1 x2 y2 th2 x3 y3 th3")
    lengths, ground, g = sp.symbols("L1:4"), sp.Symbol("L"), sp.Symbol("g")
    T = V = x = y = sp.S.Zero
    constraints = []
    for i, length in enumerate(lengths):
        px, py, angle = q[3 * i : 3 * i + 3]
        T += length * (px.diff(t) ** 2 + py.diff(t) ** 2 + length**2 / 12 * angle.diff(t) ** 2) / 2
        V += length * g * py
        dx, dy = length / 2 * sp.cos(angle), length / 2 * sp.sin(angle)
        constraints += [px - x - dx, py - y - dy]
        x, y = x + 2 * dx, y + 2 * dy
    values = dict(zip([*lengths, ground, g], [1.0, 2.0, 1.5, 3.0, 9.81], strict=True))
    return mechanisms.four_bar(), T, V, [*constraints, y, x - ground], q, values, {}


@model("slider-crank with spring and damper")
def symbolic_slider_crank() -> tuple[Any, ...]:
    """With a spring, a damper and a constant force: forces, dissipation and potential each have their part."""
    problem = mechanisms.sundials_slider_crank()
    q = crank, slider, rod = dynamicsymbols("crank slider rod")
    p = a, J1, m2, J2, k, c, l0, F = sp.symbols("a J1 m2 J2 k c l0 F")
    w1, u, w2 = rates(q)
    T = (J1 * w1**2 + m2 * u**2 + J2 * w2**2) / 2
    x, y = slider - (sp.cos(rod) + a * sp.cos(crank)) / 2, (sp.sin(rod) + a * sp.sin(crank)) / 2
    length = sp.sqrt(x**2 + y**2)
    V = k * (length - l0) ** 2 / 2 - F * (slider + sp.cos(rod))
    constraints = [slider - sp.cos(rod) - a * sp.cos(crank), -sp.sin(rod) - a * sp.sin(crank)]
    values = {symbol: problem.parameters[symbol.name] for symbol in p}
    return problem, T, V, constraints, q, values, {"dissipation": c * length.diff(t) ** 2 / 2}


@model("driven crank")
def symbolic_driven_crank() -> tuple[Any, ...]:
    problem = mechanisms.driven_crank()
    q = x1, y1, th1, x2, y2, th2 = dynamicsymbols("x1 y1 th1 x2 y2 th2")
    u1, v1, w1, u2, v2, w2 = rates(q)
    p = L1, L2, m1, m2, g, start, rate, amplitude, frequency = sp.symbols(
        "L1 L2 m1 m2 g start rate amplitude frequency"
    )
    T = (m1 * (u1**2 + v1**2 + L1**2 / 12 * w1**2) + m2 * (u2**2 + v2**2 + L2**2 / 12 * w2**2)) / 2
    constraints = [
        x1 - L1 / 2 * sp.cos(th1),
        y1 - L1 / 2 * sp.sin(th1),
        x2 - L2 / 2 * sp.cos(th2) - x1 - L1 / 2 * sp.cos(th1),
        y2 - L2 / 2 * sp.sin(th2) - y1 - L1 / 2 * sp.sin(th1),
        th1 - start - rate * t - amplitude * sp.sin(frequency * t),
    ]
    known = problem.parameters
    numbers = [known["crank"], known["rod"], *known["masses"], known["gravity"], *known["drive"].values()]
    values = dict(zip(p, numbers, strict=True))
    return problem, T, g * (m1 * y1 + m2 * y2), constraints, q, values, {}


@model("knife edge")
def symbolic_knife_edge() -> tuple[Any, ...]:
    problem = mechanisms.knife_edge()
    q = x, _, angle = dynamicsymbols("x y angle")
    u, v, w = rates(q)
    m, J, pull = sp.symbols("m J pull")
    values = dict(zip((m, J, pull), problem.system.parameters.tolist(), strict=True))
    across = {"nonholonomic": [u * sp.sin(angle) - v * sp.cos(angle)]}
    return problem, (m * (u**2 + v**2) + J * w**2) / 2, -pull * x, [], q, values, across


@model("rolling disc")
def symbolic_rolling_disc() -> tuple[Any, ...]:
    problem = mechanisms.rolling_disc()
    q = dynamicsymbols("x y z yaw lean spin")
    z, yaw, lean = q[2:5]
    u, v, w, yaw_rate, ahead, spin_rate = rates(q)
    m, R, g = sp.symbols("m R g")
    upright, turn = yaw_rate * sp.cos(lean), spin_rate - yaw_rate * sp.sin(lean)
    T = m * (u**2 + v**2 + w**2) / 2 + m * R**2 * (ahead**2 + upright**2) / 8 + m * R**2 * turn**2 / 4
    centre = sp.Matrix([u, v])
    forward, side = sp.Matrix([sp.cos(yaw), sp.sin(yaw)]), sp.Matrix([-sp.sin(yaw), sp.cos(yaw)])
    slip = centre + R * (spin_rate - yaw_rate * sp.sin(lean)) * forward + R * ahead * sp.cos(lean) * side
    known = problem.parameters
    values = dict(zip((m, R, g), (known["mass"], known["radius"], known["gravity"]), strict=True))
    return problem, T, m * g * z, [z - R * sp.cos(lean)], q, values, {"nonholonomic": slip}


def body_spin(e: Sequence[Any]) -> sp.Matrix:
    """Angular velocity in the axes of a body, 2 G(e) e'."""
    e0, e1, e2, e3 = e
    G = sp.Matrix([[-e1, e0, e3, -e2], [-e2, -e3, e0, e1], [-e3, e2, -e1, e0]])
    return 2 * G * sp.Matrix(rates(e))


def rotation(e: Sequence[Any]) -> sp.Matrix:
    """The rotation matrix of Euler parameters, homogeneous of degree two as in `twoloop.bodies.rotation`."""
    e0, f = e[0], sp.Matrix(e[1:])
    cross = sp.Matrix([[0, -e[3], e[2]], [e[3], 0, -e[1]], [-e[2], e[1], 0]])
    return (e0**2 - f.dot(f)) * sp.eye(3) + 2 * f * f.T + 2 * e0 * cross


@model("heavy top")
def symbolic_heavy_top() -> tuple[Any, ...]:
    problem = mechanisms.heavy_top()
    x, e = dynamicsymbols("x y z"), dynamicsymbols("e0:4")
    m, length, g, *J = sp.symbols("m length g J1:4")
    spin = body_spin(e)
    T = m * sum(each**2 for each in rates(x)) / 2 + sum(J[i] * spin[i] ** 2 for i in range(3)) / 2
    pivot = sp.Matrix(x) + rotation(e) * sp.Matrix([0, -length, 0])
    known = problem.parameters
    values = dict(zip((m, length, g, *J), (known["mass"], known["length"], 9.81, *known["inertia"]), strict=True))
    constraints = [(sum(each**2 for each in e) - 1) / 2, *(-pivot)]
    return problem, T, m * g * x[2], constraints, [*x, *e], values, {}
