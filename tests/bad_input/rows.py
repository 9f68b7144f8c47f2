"""Non-holonomic and redundant rows, and coordinates without inertia: what users get wrong."""

import numpy as np

from tests.bad_input.case import HUGE, WRONG, argument, cases_of
from tests.general.systems import EDGE, EDGE_FUNCTIONS, KNIFE_EDGE, parted_drives, parted_velocities, without_inertia
from twoloop import ConstrainedSystem, consistent_state, solve_dae
from twoloop.mechanisms.knife_edge import SPIN


def edge(**changed):
    """The knife edge, with other arguments in place of its own."""
    return ConstrainedSystem.from_python(**EDGE_FUNCTIONS | changed) if changed else EDGE


def slide(system=None, v0=None, **options):
    q, v = KNIFE_EDGE.motion(0.0)
    return solve_dae(edge() if system is None else system, (0.0, 0.1), q, v if v0 is None else v0, **options)


def drive(power):
    return solve_dae(parted_drives(power), (0.0, 0.1), [0.0, 0.0], [1.0, 1.0])


def drift(mass):
    return solve_dae(without_inertia(mass), (0.0, 0.1), [1.0, 0.0, 0.0], [0.0, 0.0, 0.0])


case = cases_of("Rows and inertia")


def shape_cases():
    shapes = {"nonholonomic": (1, 3), "nonholonomic_rate": (1,), "nonholonomic_gamma": (1,)}
    for kind, shape in shapes.items():
        words = str(shape).replace("(", r"\(").replace(")", r"\)")
        wrong = [(np.zeros((3, 3)), r"\(3, 3\)"), (np.zeros(3), r"\(3,\)"), (0.0, r"\(\)")]
        for value, given in wrong:
            yield case(f"`{kind}` returns an array of shape {np.shape(value)}", lambda kind=kind, value=value: slide(edge(**{kind: lambda *arguments: value}))).says(
                rf"{kind} of system 'knife edge' must return an array of shape {words}.*returned shape {given}", "return an array of the shape named"
            )
        yield case(f"`{kind}` returns NaN", lambda kind=kind, shape=shape: slide(edge(**{kind: lambda *arguments: np.full(shape, np.nan)}))).says(f"{kind} of 'knife edge' returned values that are not finite", "find out where the NaN comes from")
        yield case(f"`{kind}` returns None", lambda kind=kind: slide(edge(**{kind: lambda *arguments: None}))).says(f"{kind} of system 'knife edge' must return a real array.*returned None", "return an array of real numbers", TypeError)


COUNT = "give the number of non-holonomic rows, an int"
ROWS = [
    # --- numbers of rows, and the functions that go with them
    *argument(
        "ConstrainedSystem.from_python",
        edge,
        "n_a",
        (-1, ValueError, "must be at least 0; given -1", COUNT),
        (1.0, TypeError, r"must be an int; given 1\.0", COUNT),
        ("1", TypeError, "must be an int; given '1'", COUNT),
        (True, TypeError, "must be an int; given True", COUNT),
        (HUGE, ValueError, "must fit into 64 bits", COUNT),
    ),
    case("`n_a=1` without `nonholonomic`", lambda: edge(nonholonomic=None, nonholonomic_gamma=None)).says("n_a = 1.*nonholonomic", "give nonholonomic(t, q), or leave n_a out", WRONG),
    case("`nonholonomic` without `n_a`", lambda: edge(n_a=0)).says("nonholonomic.*n_a", "give n_a, the number of its rows", WRONG),
    case("`nonholonomic_rate` without `nonholonomic`", lambda: edge(n_a=0, nonholonomic=None, nonholonomic_gamma=None, nonholonomic_rate=lambda t, q: np.zeros(0))).says("nonholonomic_rate.*nonholonomic", "give nonholonomic(t, q) too", WRONG),
    case("`nonholonomic_gamma` without `nonholonomic`", lambda: edge(n_a=0, nonholonomic=None)).says("nonholonomic_gamma.*nonholonomic", "give nonholonomic(t, q) too", WRONG),
    case("`n_c=1` without `constraint`", lambda: edge(n_c=1), "constraint", "give constraint(t, q), or n_c=0", WRONG),
    case("`constraint` with `n_c=0`", lambda: edge(constraint=lambda t, q: np.zeros(1))).says("constraint.*n_c", "give n_c, the number of its rows", WRONG),
    case("`jacobian` with `n_c=0`", lambda: edge(jacobian=lambda t, q: np.zeros((1, 3)))).says("jacobian.*(n_c|constraint)", "leave it out: non-holonomic rows have none", WRONG),
    case("`nonholonomic` with its arguments in another order", lambda: edge(nonholonomic=lambda q, t: np.zeros((1, 3)))).says(r"nonholonomic is called as nonholonomic\(t, q\); the function given takes \(q, t\)", "name and order the arguments as they are called", TypeError),
    case("`nonholonomic` that is an array", lambda: edge(nonholonomic=np.zeros((1, 3)))).says("nonholonomic must be a function; given", "give nonholonomic(t, q)", TypeError),
    # --- what the functions return
    *shape_cases(),
    case("`nonholonomic_gamma` with the wrong sign", lambda: slide(edge(nonholonomic_gamma=lambda t, q, v: -EDGE.nonholonomic_gamma(t, q, v)), v0=[1.0, 0.0, SPIN])).says(
        "nonholonomic_gamma of 'knife edge' is not .*entry 0 is", "correct the formula, or leave nonholonomic_gamma out"
    ),
    case("`nonholonomic_gamma` that forgets how the rate changes", lambda: slide(edge(nonholonomic_rate=lambda t, q: np.array([-np.sin(t)])))).says("nonholonomic_gamma of 'knife edge' is not .*entry 0 is", "correct the formula, or leave nonholonomic_gamma out"),
    # --- the start
    case("velocities across the blade", lambda: slide(v0=[0.0, 0.3, SPIN])).says(r"v0 is not consistent.*'knife edge'.*0\.3.*consistent_state", "project the guess with consistent_state"),
    case("rows that no velocity satisfies", lambda: solve_dae(parted_velocities(), (0.0, 0.1), [0.0, 0.0], [1.0, 0.0])).says("(v0 is not consistent|contradict)", "correct one of the rows"),
    case("rows that no velocity satisfies, to be projected upon", lambda: consistent_state(parted_velocities(), 0.0, [0.0, 0.0], [1.0, 0.0])).says(r"(A v|velocit|contradict)", "correct one of the rows"),
    case("a row that follows from another but for its accelerations", lambda: drive(2)).says("'two drives' contradict one another at t = 0: row.s. .2. depend on the others .row 2 = 1 row 1", "correct one of the rows named"),
    # --- inertia
    case("a coordinate without mass that no row holds", lambda: drift((1.0, 1.0, 0.0))).says(r"mass of 'drifter'.*coordinate\(?s?\)? .*2.*inertia|mass of 'drifter'.*inertia.*coordinate\(?s?\)? .*2", "give the coordinate a mass, or a row that holds it"),
    case("no mass in the only direction that the rows allow", lambda: drift((1.0, 0.0, 1.0))).says(r"mass of 'drifter'.*coordinate\(?s?\)? .*1.*inertia|mass of 'drifter'.*inertia.*coordinate\(?s?\)? .*1", "give the coordinate a mass, or a row that holds it"),
    case("a negative mass where the rows allow motion", lambda: drift((1.0, 1.0, -1.0))).says("mass of 'drifter' must be positive definite", "correct the mass matrix"),
]
