"""Equations from SymPy that cannot be those of a mechanism, or of one that is smooth."""

import sympy as sp
from sympy.physics.mechanics import KanesMethod, Point, ReferenceFrame, dynamicsymbols

from tests.bad_input.case import Case, cases_of
from twoloop.symbolic import from_lagrangian, from_matrices, from_method

t = dynamicsymbols._t
x, y, u1, u2 = dynamicsymbols("x y u1 u2")
xd, yd = x.diff(t), y.diff(t)
m, g, L = sp.symbols("m g L")
T = m * (xd**2 + yd**2) / 2
NUMBERS = {m: 1.0, g: 9.81, L: 1.0}


def lagrangian(**changed):
    given = {"T": T, "V": m * g * y, "constraints": [x**2 + y**2 - L**2], "coordinates": [x, y], "parameters": NUMBERS}
    return from_lagrangian(**{**given, **changed})


def matrices(**changed):
    given = {"M": sp.diag(m, m), "Q": [0, -m * g], "constraints": [x**2 + y**2 - L**2], "coordinates": [x, y]}
    return from_matrices(**{**given, "parameters": NUMBERS, **changed})


def dependent_speeds():
    frame, origin = ReferenceFrame("N"), Point("O")
    origin.set_vel(frame, 0)
    kane = KanesMethod(frame, [x, y], [u1], [u1 - xd, u2 - yd], u_dependent=[u2], velocity_constraints=[u1 - u2])
    return from_method(kane)


def case(what, words, advice, error=ValueError, call=lagrangian, group="symbolic.from_lagrangian", **changed):
    return Case(group, f"`{what}`", lambda: call(**changed), words, advice, error)


ONE_LIST = "give a list of expressions, each of which is zero"
REAL = "write it with the functions that are listed"
SMOOTH = "smooth it, or end the run by an event where it switches"
of_mechanism = cases_of("symbolic.SymbolicMechanism")
SYMBOLIC = [
    case("V=m * g * h * y", "V depends on h, which is neither a coordinate nor one of the parameters", "give its value in parameters", V=m * g * sp.Symbol("h") * y),
    case("V=Symbol('m', positive=True) * g * y", "V depends on m.*other assumptions", "make each symbol once", V=sp.Symbol("m", positive=True) * g * y),
    case("T=..., a function z(t) that is no coordinate", r"T depends on z\(t\), which is not among the coordinates x, y", "name it in coordinates, or give the formula of its motion", T=T + dynamicsymbols("z").diff(t) ** 2),
    case("T=m * x'**4", r"dT/dv\[0\] must be linear in the velocities", "give a T that is at most quadratic in the velocities", T=m * xd**4),
    case("V=m * x' * y", r"V may depend on coordinates and time only", "give it as forces=", V=m * xd * y),
    case("T=m * x''", "T may not depend on accelerations", "leave accelerations out: they are the unknowns", T=m * xd.diff(t)),
    case("T='m*v**2/2'", "T must be a SymPy expression", "give a SymPy expression", TypeError, T="m*v**2/2"),
    case("constraints=[x' - y']", r"constraints\[0\] may depend on coordinates and time only; given the velocity", "give it as nonholonomic=", constraints=[xd - yd]),
    case("constraints=[Eq(x, y)]", r"constraints\[0\] must be an expression that is zero", "write lhs - rhs", TypeError, constraints=[sp.Eq(x, y)]),
    case("constraints=x - y", "constraints must be a list of SymPy expressions", ONE_LIST, TypeError, constraints=x - y),
    case("constraints=[x - x]", r"constraints\[0\] must depend on the coordinates; given 0", "leave it out", constraints=[0]),
    case("constraints=[sqrt(-1) * x]", r"constraints\[0\] must be made of real numbers", REAL, constraints=[sp.I * x]),
    case("constraints=[Abs(x) - L]", r"constraints\[0\] must be smooth; given Abs", SMOOTH, constraints=[sp.Abs(x) - L]),
    case("constraints=[gamma(x) - L]", r"constraints\[0\] must be made of real numbers, powers and", REAL, constraints=[sp.gamma(x)]),
    case("V=oo", "V must be made of real numbers, powers and", REAL, V=sp.oo),
    case("V=nan", "V must be made of real numbers, powers and", REAL, V=sp.nan),
    case("forces={x: -sign(x')}", r"forces\[x\(t\)\] must be smooth; given sign", SMOOTH, forces={x: -sp.sign(xd)}),
    case("forces=[0]", "forces must have 2 entries, one for each coordinate; given 1", "give one for each coordinate", forces=[0]),
    case("forces={z: 1}", "forces must be for coordinates, x, y; given one for z", "give it for a coordinate", forces={dynamicsymbols("z"): 1}),
    case("nonholonomic=[x'**2 - y']", r"nonholonomic\[0\] must be linear in the velocities", "give rows that are linear in the velocities", nonholonomic=[xd**2 - yd]),
    case("nonholonomic=[x - y]", r"nonholonomic\[0\] must depend on the velocities", "give it as one of the constraints", nonholonomic=[x - y]),
    case("coordinates=symbols('x y')", "coordinates must be functions of time", "make them by dynamicsymbols", TypeError, coordinates=sp.symbols("x y")),
    case("coordinates=[x, x]", "coordinates must differ in their names", "name each once", coordinates=[x, x]),
    case("coordinates=[]", "coordinates must name at least one", "name the coordinates", coordinates=[]),
    case("parameters={'m': 1.0}", "parameters must have SymPy symbols", "use the symbol itself as key", TypeError, parameters={"m": 1.0}),
    case("parameters={m: nan}", r"parameters\[m\] must be finite", "find out where the NaN comes from", parameters={**NUMBERS, m: float("nan")}),
    case("parameters={m: '1'}", r"parameters\[m\] must be a number", "convert text to numbers first", TypeError, parameters={**NUMBERS, m: "1"}),
]


def of_matrices(what, words, advice, error=ValueError, **changed):
    return case(what, words, advice, error, matrices, "symbolic.from_matrices", **changed)


SYMBOLIC += [
    of_matrices("M=eye(3)", r"M must have shape \(2, 2\).*given \(3, 3\)", "leave out rows of constraints", M=sp.eye(3)),
    of_matrices("M=[[1, x], [0, 1]]", "M must be symmetric; given 0 in row 1, column 0", "correct it", M=[[1, x], [0, 1]]),
    of_matrices("M=diag(x', 1)", r"M\[0, 0\] may depend on coordinates and time only", "what depends on velocities goes into Q", M=sp.diag(xd, 1)),
    of_matrices("Q=[0]", "Q must have 2 entries, one for each row of M; given 1", "give one for each row", Q=[0]),
    of_matrices("speeds=[u1, u2]", "speeds must map generalised speeds", "give {u1: its formula in the velocities, ...}", TypeError, speeds=[u1, u2]),
    of_matrices("speeds={u1: x'**2, u2: y'}", r"speeds\[0\] must be linear in the velocities", "choose other speeds", speeds={u1: xd**2, u2: yd}),
    cases_of("symbolic.from_method")("`method=KanesMethod(..., u_dependent=...)`", dependent_speeds).says("method must have independent coordinates and speeds only", "give its constraints to from_method"),
    cases_of("symbolic.from_method")("`method='Kane'`", lambda: from_method("Kane")).says("method must be a LagrangesMethod, a KanesMethod or a System; given 'Kane'", "give the object itself; energies go to from_lagrangian", TypeError),
    of_mechanism("`with_parameters({'mass': 2.0})`", lambda: lagrangian().with_parameters({"mass": 2.0})).says("parameters must be of m, g, L; given mass", "use the symbols, or their names"),
    of_mechanism("`with_parameters([2.0])`", lambda: lagrangian().with_parameters([2.0])).says(r"parameters must map symbols to numbers; given \[2.0\]", "write {m: 2.0}", TypeError),
    of_mechanism("`problem(..., t_span=2.0)`", lambda: lagrangian().problem([1.0, 0.0], [0.0, 0.0], 2.0)).says(r"t_span must have shape \(2,\)", "give (start, end)"),
    of_mechanism("`problem({'z': 1.0}, ...)`", lambda: lagrangian().problem({"z": 1.0}, [0.0, 0.0], (0.0, 1.0))).says("q0 must name coordinates, x, y; given z", "use the coordinates, or their names"),
]
