"""Compiled functions keep the numbers that they enclose: a change of these is refused, not ignored."""

import runpy
import sys
import types
from typing import NamedTuple

import numpy as np
import pytest
from numba import njit
from numba.extending import register_jitable

from tests.compiled import unit_mass
from tests.problems import pendulum, quick
from twoloop import ConstrainedSystem, Integrator, callback, consistent_state, consistent_states, ensemble, solve_dae
from twoloop.kernels.compile.dependencies import frozen_locations

GRAVITY = 9.81
START = [1.0, 0.0], [0.0, 0.0]
shop, mall = types.ModuleType("shop"), types.ModuleType("mall")
mall.shop, shop.pull, shop.table = shop, 9.81, np.array([9.81])
tables = (np.array([9.81]), np.array([1.0]))


class Pair(NamedTuple):
    table: np.ndarray
    count: int


pair = Pair(np.array([9.81]), 1)


@njit
def of_shop(t):
    return shop.pull + 0.0 * t


@njit
def heavy(t):
    return 9.81 + 0.0 * t


@njit
def light(t):
    return 4.0 + 0.0 * t


shop.helper, mall.helper = of_shop, heavy
of_law = heavy


@register_jitable
def registered(t):
    return GRAVITY + 0.0 * t


@njit
def pull_of(place, t):
    return place.pull + 0.0 * t


def system(pull):
    """A pendulum with this force along -y."""
    force = lambda t, q, v: np.array([0.0, -pull(t)])  # noqa: E731
    return pendulum(compile=True, constant_mass=True, force=force)


@pytest.fixture(autouse=True)
def restored():
    yield
    globals()["GRAVITY"] = shop.pull = 9.81
    shop.table[0] = tables[0][0] = pair.table[0] = 9.81
    globals()["of_law"] = mall.helper = heavy


def test_every_call_that_starts_looks():
    function, change, _ = pulls()["cell"]
    swing = system(njit(function))
    integrator = Integrator(swing)
    integrator.start(0.0, *START)
    integrator.step(0.1)
    change(4.0)
    calls = [
        lambda: integrator.step(0.1),
        lambda: integrator.start(0.0, *START),
        lambda: integrator.run((0.0, 1.0), *START),
        lambda: ensemble(swing, (0.0, 1.0), *START, t_eval=[1.0]),
        lambda: consistent_state(swing, 0.0, *START),
        lambda: consistent_states(swing, 0.0, *START),
    ]
    for call in calls:
        with pytest.raises(ValueError, match="was compiled with g"):
            call()


def pulls():
    """Functions that numba has not compiled yet, what changes the pull of 9.81 that each finds, and the name."""
    g, law, nested = 9.81, heavy, ((np.array([9.81]), 1.0), 2.0)
    record = np.array([(9.81, 1.0)], [("g", "f8"), ("c", "f8")])[0]
    table, store, laws = np.array([9.81]), shop, {9.81: heavy, 4.0: light}

    def of_default(t, pulls=tables):
        return pulls[0][0] + 0.0 * t

    def of_local(t):
        place = mall.shop
        return place.pull + 0.0 * t

    def within(t):
        def inner(x):
            return store.pull + x

        return inner(0.0 * t)

    def rebind(value):
        nonlocal g, table, law
        g, table, law = value, np.array([value]), laws[value]

    def fill(array, place=0):
        return lambda value: array.__setitem__(place, value)

    def set_pull(value):
        shop.pull = value

    def set_globals(value):
        globals().update(of_law=laws[value], GRAVITY=value)
        mall.helper = laws[value]

    return {
        "cell": (lambda t: g + 0.0 * t, rebind, "g"),
        "tuple": (lambda t: tables[0][0] + 0.0 * t, fill(tables[0]), r"tables\[0\]"),
        "table in two modules": (lambda t: mall.shop.table[0] + 0.0 * t, fill(shop.table), r"mall\.shop\.table"),
        "module in a cell": (lambda t: store.pull + 0.0 * t, set_pull, r"store\.pull"),
        "other helper in a cell": (lambda t: law(t), rebind, "law"),
        "array": (lambda t: table[0] + 0.0 * t, fill(table), "table"),
        "other array": (lambda t: table[0] + 0.0 * t, rebind, "table"),
        "global": (lambda t: GRAVITY + 0.0 * t, set_globals, "GRAVITY"),
        "nested tuple": (lambda t: nested[0][0][0] + 0.0 * t, fill(nested[0][0]), r"nested\[0\]\[0\]"),
        "named tuple": (lambda t: pair.table[0] + 0.0 * t, fill(pair.table), r"pair\.table"),
        "tuple as default": (of_default, fill(tables[0]), r"pulls\[0\]"),
        "record": (lambda t: record.g + 0.0 * t, fill(record, "g"), "record"),
        "helper in two modules": (lambda t: mall.shop.helper(t), set_pull, r"shop\.pull"),
        "module by another name": (of_local, set_pull, r"mall\.shop\.pull"),
        "inner function": (within, set_pull, r"store\.pull"),
        "module as an argument": (lambda t: pull_of(shop, t), set_pull, r"shop\.pull"),
        "register_jitable": (lambda t: registered(t), set_globals, "GRAVITY"),
        "other helper": (lambda t: of_law(t), set_globals, "of_law"),
        "other helper in a module": (lambda t: mall.helper(t), set_globals, r"mall\.helper"),
    }


# the same walk looks at what from_python compiles
CASES = [*((how, "callback") for how in [*pulls()][:5]), ("tuple as default", "compile=True")]
CASES += [(how, "callback") for how in [*pulls()][5:]]


@pytest.mark.filterwarnings("ignore:First-class function type feature is experimental")
@pytest.mark.parametrize(("how", "made"), quick(CASES, 6))
def test_a_changed_number_is_refused_by_its_name_until_it_is_as_it_was(how, made):
    function, change, name = pulls()[how]
    pull = njit(function)

    def make_system():
        if made == "compile=True":
            return system(pull)

        @callback("force")
        def force(t, q, v, p, Q):
            Q[1] = -pull(t)

        return ConstrainedSystem(n_q=2, n_c=0, mass=unit_mass, force=force, name="pendulum")

    swing = make_system()
    before = solve_dae(swing, (0.0, 1.0), *START)
    change(4.0)
    with pytest.raises(ValueError, match=rf"force of 'pendulum' was compiled with {name} = .*, which is .* now"):
        solve_dae(swing, (0.0, 1.0), *START)
    changed = solve_dae(make_system(), (0.0, 1.0), *START)
    assert abs(changed.q[:, -1] - before.q[:, -1]).max() > 0.1
    change(9.81)
    assert (solve_dae(swing, (0.0, 1.0), *START).q == before.q).all()


def test_a_callback_that_was_compiled_before_the_change_is_refused_in_a_new_system_too():
    @callback("force")
    def force(t, q, v, p, Q):
        Q[0] = -GRAVITY

    globals()["GRAVITY"] = 4.0
    falling = ConstrainedSystem(n_q=1, n_c=0, mass=unit_mass, force=force)
    with pytest.raises(ValueError, match=r"was compiled with GRAVITY = 9\.81, which is 4\.0 now"):
        solve_dae(falling, (0.0, 1.0), [0.0], [0.0])


def test_an_equal_helper_and_an_equal_tuple_are_no_change():
    def make_law():
        @njit
        def law(t):
            return 9.81 + 0.0 * t

        return law

    law, pair = make_law(), (np.array([9.81]), 1.0)
    swing = system(njit(lambda t: 0.5 * (law(t) + pair[0][0])))
    law, pair = make_law(), (np.array([9.81]), 1.0)
    assert solve_dae(swing, (0.0, 1.0), *START).success


def test_names_that_lead_back_to_themselves_and_long_tuples_end():
    many, modules = tuple(map(float, range(100_000))), [types.ModuleType("round") for _ in range(2)]
    modules[0].other, modules[1].other = modules[1], modules[0]
    for k in range(500):
        setattr(modules[0], f"number_{k}", float(k))

    def cyclic(t):
        return cyclic(t - 1.0) + loop[1] + many[5] + modules[0].other.other.number_3 if t > 0.0 else back.other

    back, cyclic = modules[0], njit(cyclic)
    loop = (cyclic, 1.0, many)
    names = [place.name for place in frozen_locations(cyclic.py_func)]
    assert {"loop", "loop[0]", "loop[2]", "many", "back", "back.other"} <= set(names) and len(names) < 20


# --- machine code on disk is read again only where all numbers and helpers that it encloses are the same
SCRIPT = """
import sys, types
import numpy as np
from numba import njit
from twoloop import callback
g = float(sys.argv[1])
@njit
def heavy(t):
    return 9.81 + 0.0 * t
@njit
def light(t):
    return 4.0 + 0.0 * t
@njit
def of_g(t):
    return g + 0.0 * t
@njit
def pull_of(place, t):
    return place.pull + 0.0 * t
def made(how):
    shop = types.ModuleType("shop")
    shop.pull, tables = g, ((np.array([g]),), 1.0)
    laws = (heavy, light, heavy if g == 9.81 else light)
    def in_tuple(t, q, v, p, Q):
        Q[0] = -tables[0][0][0]
    def again(t, q, v, p, Q):
        Q[0] = -laws[2](t) + 0.0 * heavy(t) + 0.0 * light(t)
    def of_helper(t, q, v, p, Q):
        Q[0] = -of_g(t)
    def module_as_argument(t, q, v, p, Q):
        Q[0] = -pull_of(shop, t)
    return callback("force")(locals()[how])
def values(how):
    Q, function = np.zeros(1), made(how)
    function(0.0, np.zeros(1), np.zeros(1), np.zeros(0), Q)
    return -Q[0]
hows = "in_tuple", "again", "of_helper", "module_as_argument"
print(*map(values, hows))
if g == 9.81:
    g = 5.0  # a helper that numba has compiled by now
    print(values("of_helper"))
"""


@pytest.mark.filterwarnings("ignore:First-class function type feature is experimental")
def test_machine_code_on_disk_is_that_of_the_same_values(tmp_path, monkeypatch, capsys):
    """Each run of the script makes all functions anew, as a process does: only the disk knows of those before."""
    numbers = {"9.81": [9.81] * 4 + [5.0], "4.0": [4.0] * 4, "5.0": [5.0, 4.0, 5.0, 5.0]}
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    for g, values in numbers.items():
        monkeypatch.setattr(sys, "argv", [str(script), g])
        runpy.run_path(str(script), run_name="script")
        assert [float(each) for each in capsys.readouterr().out.split()] == values
