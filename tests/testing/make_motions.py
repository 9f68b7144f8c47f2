"""Makes the known motions of the wheel: `python -m tests.testing.make_motions [NAME...]`, some ten minutes for all.

Two unlike routes: `twoloop` on the plain equations, at 1e-13; and SciPy's DOP853 on equations in few coordinates where
tests/mechanisms/motions has them, otherwise on the equations of index 1, put on the constraints at every output.
"""

import sys
import warnings
from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp

from references.as_shown import rate_of
from tests.mechanisms.motions import planar, spatial
from tests.mechanisms.motions.integrate import by_scipy
from tests.testing.systems import system_of
from twoloop import ConstraintWarning, mechanisms, solve_dae
from twoloop.testing.mechanisms import FILE, MAKERS, N_TIMES
from twoloop.testing.problem import Motion

IN_FEW_COORDINATES = {
    "pendulum": planar.a01,
    "double_pendulum": planar.double_pendulum,
    "closed_chain": lambda: planar.closed_chain(4),
    "parallelogram": lambda: planar.a02(1),
    "slider_crank": planar.slider_crank,
    "redundant_slider_crank": planar.slider_crank,
    "driven_crank": planar.driven_crank,
    "andrews": planar.andrews,
    "heavy_top": spatial.heavy_top,
    "spatial_four_bar": spatial.spatial_four_bar,
}
TIGHT = {"rtol": 1e-13, "atol": 1e-14}
MOST = 15.5  # digits


def times_of(problem):
    return np.linspace(*problem.t_span, N_TIMES)


def by_twoloop(problem, q0, v0, times):
    """States (n_t, n_q) at times by the Gauss method of six stages."""
    run = solve_dae(system_of(problem), (times[0], times[-1]), q0, v0, "Gauss12", t_eval=times, rtol=1e-13, atol=1e-13)
    assert run.success, run.message
    return run.q.T, run.v.T


def projected(problem, t, q, v):
    """The nearest state on the constraints."""
    for _ in range(4):
        q = q - np.linalg.lstsq(problem.jacobian(t, q), problem.constraint(t, q), rcond=1e-10)[0]
    J = problem.jacobian(t, q)
    return q, v - np.linalg.lstsq(J, J @ v + problem.constraint_rate(t, q), rcond=1e-10)[0]


def by_index_1(problem, q0, v0, times):
    """States (n_t, n_q) at times by SciPy's DOP853 from one to the next."""
    states = [np.concatenate([q0, v0])]
    for span in pairwise(times):
        y = solve_ivp(lambda t, y: rate_of(problem, t, y), span, states[-1], "DOP853", **TIGHT).y[:, -1]
        states.append(np.concatenate(projected(problem, span[1], *np.split(y, 2))))
    return np.split(np.array(states), 2, axis=1)


def in_few_coordinates(name, times, change=0.0):
    """States (n_t, n_q) at times, in equations that share nothing with those of the problem; of a changed start."""
    rate, start, known = IN_FEW_COORDINATES[name]()
    start = np.array(start) + change
    both = [known(t, y) for t, y in zip(times, by_scipy(rate, start, times[-1], times).T, strict=True)]
    return [np.array(each, dtype=float) for each in zip(*both, strict=True)]


def other_route(problem, times):
    if problem.name in IN_FEW_COORDINATES:
        return in_few_coordinates(problem.name, times)
    return by_index_1(problem, problem.q0, problem.v0, times)


def multipliers(problem, times, q, v):
    return np.array([problem.acceleration(*state)[1] for state in zip(times, q, v, strict=True)])


def digits(first, second):
    """Decimals of agreement at each time (n_t,), over max(1, largest)."""
    worst = np.abs(first - second).max(axis=1) / max(1.0, np.abs(first).max())
    return np.minimum(MOST, -np.log10(np.maximum(worst, 1e-30)))


def neighbours(problem, q, v, step=1e-6):
    """Starts at a distance of `step` in all directions that the constraints allow."""
    J, scales = problem.jacobian(problem.t_span[0], q), scales_of(q, v)
    values, rows = np.linalg.svd(J)[1:]
    free = rows[int((values > 1e-9 * values[0]).sum()) :]
    for change_q, change_v in [(d, 0 * d) for d in free] + [(0 * d, d) for d in free]:
        yield projected(problem, problem.t_span[0], q + step * scales[0] * change_q, v + step * scales[1] * change_v)


def scales_of(q, v):
    return max(1.0, np.abs(q).max()), max(1.0, np.abs(v).max())


def growth(q, v, others):
    """By which factor, at most, a perturbation at an earlier time has grown (n_t,), and at least 1.

    From the motions `others` from neighbouring starts.
    """
    if not others:
        return np.ones(len(q))
    scales = scales_of(q, v)
    columns = [np.hstack([(there_q - q) / scales[0], (there_v - v) / scales[1]]) for there_q, there_v in others]
    moved = np.moveaxis(np.array(columns), 0, -1)  # (n_t, 2 n_q, n_directions)
    back = [np.linalg.pinv(each, rcond=1e-5) for each in moved]
    most = [max(np.linalg.norm(moved[k] @ back[j], 2) for j in range(k + 1)) for k in range(len(moved))]
    return np.maximum(1.0, np.maximum.accumulate(most))


def made(name):
    """The motion of a problem."""
    problem = MAKERS[name]()
    times = times_of(problem)
    other_q, other_v = other_route(problem, times)
    if problem.singular_times:  # which the first route does not cross at such tolerances; a closed form is known
        both = zip(*map(mechanisms.n_four_bar(1).motion, times), strict=True)
        q, v = (np.array(each) for each in both)
        others = [in_few_coordinates(name, times, change) for change in 1e-6 * np.eye(2)]
    else:
        q, v = by_twoloop(problem, problem.q0, problem.v0, times)
        starts = neighbours(problem, problem.q0, problem.v0)
        others = [by_twoloop(problem, *start, times) for start in starts]
    lam, other_lam = (multipliers(problem, times, *state) for state in ((q, v), (other_q, other_v)))
    held = {"q": digits(q, other_q), "v": digits(v, other_v), "lam": digits(lam, other_lam)}
    return Motion(times, q, v, lam, held, growth(q, v, others))


def main(names):
    stored = dict(np.load(FILE)) if FILE.exists() else {}
    for name, maker in MAKERS.items():
        if (names and name not in names) or maker().ends is not None:
            continue
        motion = made(name)
        held = {kind: f"{each.min():.1f}" for kind, each in motion.digits.items()}
        print(name, held, f"growth {motion.growth[-1]:.3g}", flush=True)
        for key in ("t", "q", "v", "lam", "growth"):
            stored[f"{name}/{key}"] = getattr(motion, key)
        stored[f"{name}/digits"] = np.floor(10.0 * np.array(list(motion.digits.values()))) / 10.0
        np.savez_compressed(FILE, **stored)


if __name__ == "__main__":
    warnings.simplefilter("ignore", ConstraintWarning)  # the redundant row is meant
    main(sys.argv[1:])
