"""Test the problems of `twoloop.testing`: their equations, what is known of their motions, what an import loads."""

import numpy as np
import pytest

from tests.mechanisms.make_references import solution
from tests.problems import row_errors
from tests.processes import run_python
from tests.testing.systems import system_of
from twoloop import mechanisms
from twoloop.testing.mechanisms import MAKERS

SAME_NAME = ("pendulum", "double_pendulum", "closed_chain", "four_bar", "redundant_slider_crank", "driven_slider_crank")
SAME_NAME += ("driven_crank", "andrews", "heavy_top", "spatial_four_bar")
OURS = {name: getattr(mechanisms, name) for name in SAME_NAME} | {"parallelogram": lambda: mechanisms.n_four_bar(1)}
ALL = {name: maker() for name, maker in MAKERS.items()}
MOVING = {name: problem for name, problem in ALL.items() if problem.reference is not None}


def near(a, b, digits=12.0):
    assert np.shape(a) == np.shape(b)
    assert np.abs(np.subtract(a, b)).max(initial=0.0) <= 10.0**-digits * max(1.0, np.abs(b).max(initial=0.0))


CHECKS = "twoloop.checks twoloop.checks.arguments"  # of wrong calls, which need numpy alone


@pytest.mark.slow
def test_an_import_is_of_numpy_only():
    told = run_python(
        """
        import sys
        import twoloop.testing.plugin
        print("numpy" in sys.modules)
        from twoloop import testing
        testing.problems(), testing.check_simulator
        print(*sorted({"numba", "scipy", "llvmlite", "pytest"} & set(sys.modules)))
        print(*sorted(name for name in sys.modules if name.startswith("twoloop.") and "testing" not in name))
        import twoloop
        print(twoloop.solve_dae.__name__, "numba" in sys.modules, hasattr(twoloop, "nothing"), "sweep" in dir(twoloop))
        """.replace("import twoloop.testing.plugin", "import twoloop.testing")
    )
    assert told.stdout.splitlines() == ["False", "", CHECKS, "solve_dae True False True"]


@pytest.mark.parametrize("name", OURS)
def test_equations_are_those_of_the_mechanism(name):
    """Entry by entry; where rows are others, or in another order, by what they make of a state."""
    here, there = ALL[name], OURS[name]()
    system, motion = there.system, here.reference
    begin = here.t_span[0]
    q0, v0 = there.motion(begin) if begin > 0.0 else (there.q0, there.v0)
    near(here.q0, q0)
    near(here.v0, v0)
    same_rows = name not in ("four_bar", "heavy_top", "spatial_four_bar")
    for k in (0, 37, 100):
        t, q, v = motion.t[k], motion.q[k], motion.v[k]
        near(here.mass(t, q), system.mass(t, q))
        near(here.force(t, q, v), system.force(t, q, v))
        if same_rows:
            for kind in ("constraint", "jacobian", "constraint_rate"):
                near(getattr(here, kind)(t, q), getattr(system, kind)(t, q))
            near(here.gamma(t, q, v), system.gamma(t, q, v))
        near(system.constraint(t, q), np.zeros(system.n_c), 11.0)
        if not here.singular_times:
            near(here.acceleration(t, q, v)[0], solution(system, t, q, v)[0], 9.0)


@pytest.mark.parametrize("name", ALL)
def test_rows_are_derivatives_of_the_constraints(name):
    problem, random = ALL[name], np.random.default_rng(3)
    system, most = system_of(problem), 1.0 if "andrews" not in name else 1e3
    for _ in range(2):
        q = problem.q0 + 0.1 * random.normal(size=problem.n_q)
        assert max(row_errors(system, 0.3, q, random.normal(size=problem.n_q))) < 1e-8 * most
    assert problem.row_powers.shape == (system.n_c,) and len(problem.coordinates) == problem.n_q
    state = problem.t_span[0], problem.q0
    near(problem.constraint(*state), np.zeros(problem.n_c))
    near(problem.jacobian(*state) @ problem.v0, -problem.constraint_rate(*state))
    with pytest.raises(ValueError, match="read-only"):
        problem.q0 += 1.0


@pytest.mark.parametrize("name", MOVING)
def test_the_motion_obeys_the_equations(name):
    problem = MOVING[name]
    motion = problem.reference
    near(motion.q[0], problem.q0)
    near(motion.v[0], problem.v0)
    assert (motion.t[0], motion.t[-1]) == problem.t_span and not motion.q.flags.writeable
    for t, q, v, lam in zip(motion.t, motion.q, motion.v, motion.lam, strict=True):
        near(problem.constraint(t, q), np.zeros(problem.n_c), 11.0)
        J = problem.jacobian(t, q)
        near(J @ v + problem.constraint_rate(t, q), np.zeros(problem.n_c), 10.0 - np.log10(motion.scales[1]))
        near(J.T @ lam, J.T @ problem.acceleration(t, q, v)[1], 6.0)
    kept = dict(problem.invariants) | ({} if problem.energy is None else {"energy": problem.energy})
    for quantity in kept.values():
        values = [quantity(*state) for state in zip(motion.t, motion.q, motion.v, strict=True)]
        assert np.ptp(values) < 1e-9 * max(1.0, np.abs(values).max())
    assert min(motion.digits["q"].min(), motion.digits["v"].min()) > 9.0 and (motion.growth >= 1.0).all()
