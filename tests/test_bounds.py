"""Indices out of bounds are found before machine code reads or writes outside its arrays, at every entry point."""

import numpy as np
import pytest
from numba import njit
from numba.extending import register_jitable

from tests.compiled import HEAVY_PENDULUM
from tests.problems import pendulum, quick
from tests.processes import run_python
from twoloop import ConstrainedSystem, callback, consistent_state, solve_dae
from twoloop.kernels.compile.callbacks import KINDS

FAR = 10**7  # a write so far out would end the process
Q, V = [-1.0, 0.0], [0.0, 0.0]


@callback("force_by_q")
def constant_force(t, q, v, p, K):
    pass


NO_TANGENT = {"force_by_q": constant_force}


def beyond(kind):
    """A callback that writes beyond the end of its array."""
    entry, scope = KINDS[kind], {"FAR": FAR}
    index = "0, FAR" if len(entry.shape) == 2 else "FAR"
    exec(f"def beyond({', '.join(entry.arguments)}):\n    {entry.output}[{index}] = 1.0", scope)
    return callback(kind)(scope["beyond"])


def system(**changed):
    return ConstrainedSystem(**{**HEAVY_PENDULUM, "parameters": [2.0], "name": "far", **changed})


ENTRIES = {
    "solve_dae": lambda system: solve_dae(system, (0.0, 0.1), Q, V),
    "consistent_state": lambda system: consistent_state(system, 0.0, Q, V),
}


@pytest.mark.parametrize("kind", [kind for kind in KINDS if not kind.startswith(("nonholonomic", "kinematics"))])
def test_every_callback_is_watched_when_it_is_called_alone(kind):
    tangents = NO_TANGENT if kind in ("force_by_v", "reaction_by_q") else {}
    places = {"mass_values": {"mass_entries": ([0, 1], [0, 1])}}
    places["jacobian_values"] = {"jacobian_entries": ([0, 0], [0, 1])}
    state = [V if name == "v" else [1.0] if name == "lam" else Q for name in KINDS[kind].state]
    with pytest.raises(ValueError, match=rf"{kind} of 'far' goes out of bounds: index {FAR} .*n_q = 2, n_c = 1"):
        getattr(system(**tangents, **places.get(kind, {}), **{kind: beyond(kind)}), kind)(0.0, *state)


@pytest.mark.parametrize("entry", ENTRIES)
@pytest.mark.parametrize("kind", quick(["mass", "force", "constraint", "jacobian", "gamma", "reaction_by_q"], 4))
def test_every_entry_point_watches_every_callback(entry, kind):
    tangents = NO_TANGENT if kind == "reaction_by_q" else {}
    with pytest.raises(ValueError, match=rf"{kind} of 'far' goes out of bounds: index {FAR}"):
        ENTRIES[entry](system(**tangents, **{kind: beyond(kind)}))


@pytest.mark.parametrize("entry", ENTRIES)
def test_too_few_parameters_are_reported_as_such(entry):
    with pytest.raises(ValueError, match=r"(?s)of 'far' goes out of bounds.*p has 0.*Give more `parameters`"):
        ENTRIES[entry](system(parameters=[]))


@njit
def fill(out, place):
    out[place] = 1.0


@njit
def pass_on(out, place):
    fill(out, place)


@njit
def countdown(out, place):
    if place > FAR:
        countdown(out, place - 1)
    else:
        fill(out, place)


@pytest.mark.parametrize("helper", [fill, pass_on, countdown])
def test_helpers_are_watched(helper):
    def force(t, q, v, p, Q):
        helper(Q, FAR + 3)

    words = r"force of 'far' goes out of bounds: index 1000000\d is .*`out\[place\] = 1.0`"
    with pytest.raises(ValueError, match=words):
        system(force=callback("force")(force)).force(0.0, Q, V)


@pytest.mark.parametrize("make", [system, pendulum], ids=["compiled", "plain"])
@pytest.mark.parametrize(
    ("kind", "arguments", "error", "words"),
    [
        ("jacobian", (0.0, [0.0]), ValueError, r"q must have shape \(2,\), as n_q = 2 in '\w+'; given shape \(1,\)"),
        ("force", (0.0, Q, [0.0] * 3), ValueError, r"v must have shape \(2,\).*given shape \(3,\)"),
        ("reaction_by_q", (0.0, Q, V), ValueError, r"lam must have shape \(1,\), as n_c = 1.*given shape \(2,\)"),
        ("mass", (np.nan, Q), ValueError, "t must be finite; given nan"),
        ("mass", (0.0, ["left", "down"]), TypeError, "q must be an array of real numbers"),
        ("force", (0.0, Q), TypeError, r"force\(t, q, v\): missing a required argument: 'v'"),
    ],
)
def test_arguments_of_single_callbacks_are_checked(make, kind, arguments, error, words):
    with pytest.raises(error, match=words):
        getattr(make(), kind)(*arguments)


# --- indices that are computed: their bounds are watched in every call
TABLE = np.sin(np.linspace(0.0, 2.0, 401))
SPACING = 2.0 / 400.0


@njit
def looked_up(x):
    i = int(x / SPACING)
    s = x / SPACING - i
    return (1.0 - s) * TABLE[i] + s * TABLE[i + 1]


@callback("mass")
def of_one(t, q, p, M):
    M[0, 0] = 1.0


@callback("force")
def in_a_table(t, q, v, p, Q):
    i = int(t / SPACING)
    Q[0] = TABLE[i + 1] - q[0]


@callback("force")
def in_a_table_by_a_helper(t, q, v, p, Q):
    Q[0] = looked_up(t) - q[0]


looked_up_there = register_jitable(looked_up.py_func)
LAWS = (looked_up,)


@callback("force")
def in_a_table_by_what_is_registered(t, q, v, p, Q):
    Q[0] = looked_up_there(t) - q[0]


@callback("force")
def in_a_table_by_a_tuple(t, q, v, p, Q):
    Q[0] = LAWS[0](t) - q[0]


OTHERS = [in_a_table_by_what_is_registered, in_a_table_by_a_tuple]


@pytest.mark.parametrize("force", [in_a_table, in_a_table_by_a_helper, *OTHERS])
@pytest.mark.parametrize("method", quick(["auto", "RadauIIA5"]))
def test_a_run_beyond_the_end_of_a_table_is_no_success(force, method):
    system = ConstrainedSystem(n_q=1, n_c=0, mass=of_one, force=force, name="table")
    assert solve_dae(system, (0.0, 1.9), [0.0], [0.0], method).success
    for end in (2.5, 300.0):
        with pytest.raises(IndexError) as caught:
            solve_dae(system, (0.0, end), [0.0], [0.0], method)
        (note,) = caught.value.__notes__
        assert "compiled callback of system 'table'" in note and "beyond the end of an array" in note


CAM = """
import numpy as np
from twoloop import ConstrainedSystem, callback, solve_dae
TABLE, SPACING = np.sin(np.linspace(0.0, 2.0, 401)), 2.0 / 400.0
@callback("mass")
def mass(t, q, p, M):
    M[0, 0] = M[1, 1] = 1.0
@callback("force")
def force(t, q, v, p, Q):
    Q[1] = -1.0
@callback("constraint")
def constraint(t, q, p, C):
    i = int(q[0] / SPACING)
    s = q[0] / SPACING - i
    C[0] = q[1] - (1.0 - s) * TABLE[i] - s * TABLE[i + 1]
@callback("jacobian")
def jacobian(t, q, p, Cq):
    i = int(q[0] / SPACING)
    Cq[0, 0], Cq[0, 1] = (TABLE[i] - TABLE[i + 1]) / SPACING, 1.0
@callback("gamma")
def gamma(t, q, v, p, Qd):
    Qd[0] = 0.0
given = {"mass": mass, "force": force, "constraint": constraint, "jacobian": jacobian, "gamma": gamma}
system = ConstrainedSystem(n_q=2, n_c=1, **given)
start = np.array([1.5025, 0.5 * (TABLE[300] + TABLE[301])])
print(solve_dae(system, (0.0, 1e-3), start, np.zeros(2), rtol=1e-5, atol=1e-5).success)
"""


@pytest.mark.slow
def test_checks_of_a_start_that_look_beyond_a_table_do_not_end_the_process():
    assert run_python(CAM).stdout.split() == ["True"]
