"""Systems and callbacks that make no sense."""

from functools import partial

import numpy as np

from tests.bad_input.case import HUGE, argument, cases_of, linkage
from twoloop import ConstrainedSystem, callback


def make(**changed):
    arguments = {"n_q": 2, "n_c": 1, "mass": np.eye(2), "force": lambda t, q, v: np.zeros(2), "constraint": lambda t, q: q[:1], "jacobian": lambda t, q: np.eye(2)[:1]}
    return ConstrainedSystem.from_python(**{**arguments, **changed})


def compiled(**changed):
    functions = linkage().system.functions
    arguments = {kind: getattr(functions, kind) for kind in ("mass", "force", "constraint", "jacobian", "gamma")}
    return ConstrainedSystem(**{"n_q": 9, "n_c": 8, "parameters": [1.0, 2.0, 1.5, 3.0], **arguments, **changed})


COUNT = "give the number of coordinates, an int"
of_from_python = cases_of("ConstrainedSystem.from_python")
of_compiled = cases_of("ConstrainedSystem")
of_callback = cases_of("callback")
of_compiled_argument = partial(argument, "ConstrainedSystem", compiled)
of_argument = partial(argument, "ConstrainedSystem.from_python", make)
SYSTEMS = [
    *of_argument(
        "n_q",
        (0, ValueError, "must be at least 1; given 0", COUNT),
        (-2, ValueError, "must be at least 1; given -2", COUNT),
        (2.0, TypeError, "must be an int; given 2.0", COUNT),
        ("2", TypeError, "must be an int; given '2'", COUNT),
        (True, TypeError, "must be an int; given True", COUNT),
        (None, TypeError, "must be an int; given None", COUNT),
        (HUGE, ValueError, "must fit into 64 bits", COUNT),
    ),
    *of_argument("n_c", (-1, ValueError, "must be at least", "give the number of constraints"), (True, TypeError, "must be an int; given True", "give the number of constraints")),
    *of_argument(
        "mass",
        (np.eye(3), ValueError, r"must have shape \(2, 2\); given .*shape \(3, 3\)", "give an (n_q, n_q) array"),
        ("heavy", TypeError, "must be an array of real numbers", "give an (n_q, n_q) array or a function"),
        ([[1.0, 0.0], [1.0]], TypeError, "must be an array of real numbers", "give an (n_q, n_q) array"),
        (np.eye(2, dtype=bool), TypeError, "must be an array of real numbers", "write 1.0 and 0.0"),
        (np.eye(2, dtype=complex), TypeError, "must be an array of real numbers", "give real numbers"),
        (1.0, ValueError, r"must have shape \(2, 2\)", "write 1.0 * np.eye(2)"),
    ),
    *of_argument("force", (None, TypeError, "must be a function; given None", "give force(t, q, v)"), ([0.0, -9.81], TypeError, "must be a function; given", "give force(t, q, v)")),
    *of_argument("gamma", (0.0, TypeError, "must be a function; given 0.0", "give gamma(t, q, v), or leave it out")),
    *of_argument("constraint_rate", ("linear", TypeError, "must be a function; given 'linear'", "give constraint_rate(t, q), or leave it out")),
    *of_argument("bandwidth", (-1, ValueError, "must be at least 0; given -1", "give an int of at least 0, or leave it out"), (1.5, TypeError, "must be an int; given 1.5", "give an int of at least 0, or leave it out")),
    of_from_python("`force(t, v, q)`: arguments in another order").when(lambda: make(force=lambda t, v, q: np.zeros(2))).says(r"force is called as force\(t, q, v\); the function given takes \(t, v, q\)", "put them in the order named", TypeError),
    *of_argument("name", (3, TypeError, "must be a string; given 3", "give text")),
    of_from_python("`force(t, q)`: an argument too few", lambda: make(force=lambda t, q: np.zeros(2))).says(r"force is called as force\(t, q, v\); the function given takes \(t, q\)", "take the arguments named", TypeError),
    of_from_python("`mass(t, q, v)`: an argument too many", lambda: make(mass=lambda t, q, v: np.eye(2))).says(r"mass is called as mass\(t, q\); the function given takes \(t, q, v\)", "take the arguments named", TypeError),
    of_from_python("`force(t, q, v, p)` without `parameters`").when(lambda: make(force=lambda t, q, v, p: p)).says(r"force is called as force\(t, q, v\).*parameters=\[...\]", "give parameters=[...]", TypeError),
    of_from_python("`force(t, q, v, p, w)` with `parameters`").when(lambda: make(force=lambda t, q, v, p, w: p, parameters=[1.0])).says(r"force is called as force\(t, q, v, p\)", "put all numbers into p", TypeError),
    of_from_python("`force_by_v` without `force_by_q`", lambda: make(force_by_v=lambda t, q, v: np.zeros((2, 2)))).says("force_by_v.* go with force_by_q", "give force_by_q too"),
    of_from_python("`bandwidth` with a mass that is a function").when(lambda: make(bandwidth=1, mass=lambda t, q: np.eye(2))).says("bandwidth needs a constant mass", "give the mass as an array"),
    *of_compiled_argument(
        "parameters",
        (["long"], TypeError, "must be an array of real numbers", "give a vector of numbers"),
        ([[1.0, 2.0]], ValueError, "must be a vector of finite numbers", "give a vector of numbers"),
        ([1.0, np.nan, 1.5, 3.0], ValueError, "must be a vector of finite numbers", "give finite numbers"),
        ([True, 2.0, 1.5, 3.0], TypeError, "must be an array of real numbers", "give a vector of numbers"),
        ([HUGE, 2.0, 1.5, 3.0], ValueError, "must hold numbers that fit into a float", "give finite numbers"),
    ),
    *of_compiled_argument("constant_mass", ("yes", TypeError, "must be True or False; given 'yes'", "give True or False"), (1, TypeError, "must be True or False; given 1", "give True or False")),
    *of_compiled_argument("bandwidth", (2, ValueError, "needs a constant mass matrix", "give constant_mass=True where that is so")),
    of_compiled("`evaluate('friction', ...)`", lambda: linkage().system.evaluate("friction", 0.0)).says("kind must be one of mass, .*given 'friction'", "take one of the kinds named"),
    of_compiled("`system.force(t, q)`, without v", lambda: linkage().system.evaluate("force", 0.0, np.zeros(9))).says(r"force is evaluated at \(t, q, v\); given 1 arrays", "give t, q and v", TypeError),
    of_compiled("a plain function as `force`", lambda: compiled(force=lambda t, q, v, p, Q: None)).says(r"force must be compiled by @twoloop.callback\('force'\).*from_python", "decorate it with @callback, or use from_python", TypeError),
    of_compiled("the callback of another kind as `force`").when(lambda: compiled(force=linkage().system.functions.constraint)).says(r"force must be compiled by @twoloop.callback\('force'\)", "give the callback made for this kind", TypeError),
    of_callback('`@callback("friction")`', lambda: callback("friction")).says("kind must be one of mass.*given 'friction'", "take one of the kinds named"),
    of_callback("`@callback` without a kind", lambda: callback(lambda t, q, v, p, Q: None)).says("the decorator needs the kind of callback", 'write @callback("force")', TypeError),
    of_callback("a force with the arguments `(t, q, Q)`", lambda: callback("force")(lambda t, q, Q: None)).says(r"declared as the callback 'force', whose arguments are \(t, q, v, p, Q\); it has \(t, q, Q\)", "take the arguments named", TypeError),
]
