"""Faults to plant into the integrators of docs/examples: which text becomes which, and what a check should say."""

from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
RK, ALPHA, RATTLE = "runge_kutta", "generalised_alpha", "rattle"
ORDERS = {RK: 4.0, ALPHA: 2.0, RATTLE: 2.0}


@dataclass(frozen=True)
class Planted:
    """A fault: where, which text becomes which, a problem on which it shows, words of the hint, and steps."""

    name: str
    example: str
    old: str
    new: str
    problem: str
    words: str
    steps: tuple[int, ...] = (100, 200)


def module_of(example, old="", new=""):
    """An example as a module, a text of it replaced."""
    source = (EXAMPLES / f"{example}.py").read_text(encoding="utf-8")
    assert old in source, f"{example}.py has no {old!r}"
    module = ModuleType(example)
    exec(compile(source.replace(old, new) if old else source, f"{example}.py", "exec"), vars(module))
    return module


MARCH = """            q, v = step_on(problem, t, h, q, v)
            t = end if k == n - 1 else t + h
        rows.append((q, v))"""
PROJECTED = "            q, v = projected(problem, t, q, v)\n"
LATE = """            J = problem.jacobian({})
            v = v - np.linalg.lstsq(J, J @ v + problem.constraint_rate({}), rcond=1e-10)[0]
"""
SHAKEN, FINE = "shaken_spring", (100, 200, 400)
FAULTS = [
    Planted("gamma has the other sign", RK, "problem.gamma(t, q, v)", "-problem.gamma(t, q, v)", "four_bar", "gamma"),
    Planted("gamma is left out", RK, "problem.gamma(t, q, v)", "0.0 * problem.gamma(t, q, v)", "driven_crank", "gamma"),
    Planted("C_tt is left out", RK, "problem.gamma(t, q, v)", "problem.gamma(0.0, q, v)", "driven_crank", "C_tt"),
    Planted("lam has the other sign", RK, "both[n:] * heavy", "-both[n:] * heavy", "pendulum", "other sign"),
    Planted("a wrong weight", RK, "2.0 * v2 + 2.0 * v3 + v4", "v2 + 3.0 * v3 + v4", "pendulum", "order"),
    Planted("stages at the start of the step", RK, "(problem, t + 0.5 * h,", "(problem, t,", "driven_crank", "order"),
    Planted("no projection", RK, "            q, v = projected(problem, t, q, v)\n", "", "pendulum", "Project"),
    Planted(
        "C_t is left out of the projection",
        RK,
        "J @ v + problem.constraint_rate(t, q)",
        "J @ v",
        "driven_crank",
        "C_t is left out",
    ),
    Planted(
        "gyroscopic forces are left out",
        RK,
        "problem.force(t, q, v)",
        "problem.force(t, q, 0.0 * v)",
        "heavy_top",
        "gyroscopic",
    ),
    Planted(
        "only the diagonal of M",
        RK,
        "M, J = problem.mass(t, q)",
        "M, J = np.diag(np.diag(problem.mass(t, q)))",
        "andrews",
        "diagonal",
    ),
    Planted(
        "M of the start",
        RK,
        "M, J = problem.mass(t, q)",
        "M, J = problem.mass(t, problem.q0)",
        "andrews",
        "mass matrix is that of the start",
    ),
    Planted(
        "gravity is fixed along -y",
        RK,
        "problem.force(t, q, v) / heavy",
        "M @ [0.0, -9.81] / heavy",
        "pendulum",
        "direction is fixed",
    ),
    Planted(
        "forces 1 % too large",
        RK,
        "problem.force(t, q, v) / heavy",
        "1.01 * problem.force(t, q, v) / heavy",
        "pendulum",
        "forces are 1.01 times",
    ),
    Planted(
        "a matrix with units",
        RK,
        "np.abs(M).max(), np.linalg.norm(J, axis=1)",
        "1.0, np.ones(m)",
        "driven_crank",
        "unit",
    ),
    Planted("rows one time late", RK, "np.array(each) for", "np.array((each[0], *each[:-1])) for", "pendulum", "late"),
    Planted(
        "angles jump back",
        RK,
        "np.array(each) for",
        "np.arctan2(np.sin(np.array(each)), np.cos(np.array(each))) for",
        "crank_rocker",
        "whole turns",
    ),
    Planted(
        "silent without convergence",
        ALPHA,
        '    raise RuntimeError(f"Newton',
        '    return new_q, new_v, new_a, new_between, lam\n    raise RuntimeError(f"Newton',
        "out_of_reach",
        "Success with a wrong answer",
    ),
    Planted("Newton stops early", ALPHA, "< 1e-13", "< 1e-4", "four_bar", "too early"),
    Planted("a wrong gamma of Newmark", ALPHA, "GAMMA = 0.5", "GAMMA = 0.6", "pendulum", "order"),
    Planted(
        "forces of the start of the step",
        ALPHA,
        "problem.force(t + h, new_q, new_v)",
        "problem.force(t, q, v)",
        "andrews",
        "First order",
    ),
    Planted(
        "impulses for multipliers",
        ALPHA,
        "rows.append((q, v, lam))",
        "rows.append((q, v, lam * step))",
        "pendulum",
        "impulses",
    ),
    Planted(
        "velocities of the middle",
        RATTLE,
        MARCH,
        MARCH.replace("q, v =", "before, (q, v) = q,").replace("((q, v))", "((q, (q - before) / h))"),
        "pendulum",
        "middle of the step",
    ),
    Planted("velocities are not projected", RATTLE, "return q, free + change", "return q, free", "pendulum", "velocit"),
    Planted(
        "the drive of the start of the step",
        RATTLE,
        "-problem.constraint(t + h, q",
        "-problem.constraint(t, q",
        "driven_crank",
        "another instant",
    ),
    # found by trying what no hint had been written for
    Planted(
        "forces at the time of the start",
        RK,
        "problem.force(t, q",
        "problem.force(problem.t_span[0], q",
        SHAKEN,
        "time at the start",
    ),
    Planted(
        "forces at the time since the start", RK, "force(t, q", "force(t - problem.t_span[0], q", SHAKEN, "not at 0"
    ),
    Planted(
        "forces of the first positions",
        RK,
        "force(t, q, v)",
        "force(t, problem.q0, v)",
        SHAKEN,
        "positions at the start",
    ),
    Planted(
        "gravity of one body has the other sign",
        RK,
        "problem.force(t, q, v) / heavy",
        "problem.force(t, q, v) * np.where(np.arange(n) == 3, -1.0, 1.0) / heavy",
        SHAKEN,
        "force on q[3] (y) is of the other sign",
    ),
    Planted(
        "the second half-step's force is the first's",
        RATTLE,
        "problem.force(t, q, middle)",
        "force",
        SHAKEN,
        "First order",
    ),
    Planted(
        "C_t of one step before",
        RK,
        PROJECTED,
        PROJECTED + LATE.format("t, q", "t - h, q"),
        "driven_crank",
        "of one step before",
    ),
    Planted(
        "C_q of one step before",
        RK,
        PROJECTED,
        PROJECTED + LATE.format("t - h, q - h * v", "t, q"),
        "driven_crank",
        "of one step before",
    ),
    Planted("steps that have a longest", RK, "h = (end - t) / n", "h = min((end - t) / n, 0.005)", "pendulum", "clock"),
    Planted(
        "a smallest step",
        RK,
        "n = round((end - t) / step)",
        "n = min(2, round((end - t) / step))",
        "pendulum",
        "a bound of its own",
        FINE,
    ),
    Planted(
        "a projection that adds", RK, "return q, v - np", "return q, v + np", "pendulum", "a sign in a projection", FINE
    ),
    Planted(
        "a factor on the velocities",
        RK,
        "return q, v - np",
        "return q, (1.0 - 1e-6) * v - np",
        "pendulum",
        "a factor on the velocities",
        FINE,
    ),
    Planted(
        "impulses along the rows of the end",
        RATTLE,
        "solved(M, to, J, 0",
        "solved(M, J, J, 0",
        "pendulum",
        "First order",
    ),
    Planted(
        "single precision",
        RK,
        "return q, v - np.linalg",
        "return q, np.float32(v) - np.linalg",
        "pendulum",
        "single precision",
    ),
    Planted(
        "a little damping",
        ALPHA,
        "force(t + h, new_q, new_v)",
        "force(t + h, new_q, new_v) - 1e-3 * new_v",
        SHAKEN,
        "a damping",
        FINE,
    ),
    Planted(
        "multipliers of the middle",
        ALPHA,
        "(q, v, lam))\n    ret",
        "(q, v, 0.5 * (lam + rows[-1][2])))\n    ret",
        "pendulum",
        "another instant",
    ),
]
