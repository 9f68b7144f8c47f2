"""Faults to plant into small integrators: which text becomes which, and what a check should say."""

from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

EXAMPLES, OTHERS = Path(__file__).parents[2] / "docs" / "examples", Path(__file__).parent / "integrators"
RK, ALPHA, RATTLE = "runge_kutta", "generalised_alpha", "rattle"
ORDERS = {RK: 4.0, ALPHA: 2.0, RATTLE: 2.0, "half_explicit": 2.0, "hht": 2.0}  # others take tolerances
STEPS, FINE = (100, 200), (100, 200, 400)


@dataclass(frozen=True)
class Planted:
    """A fault: where, a problem on which it shows, words of the hint, steps, and which texts become which."""

    name: str
    example: str
    problem: str
    words: str
    steps: tuple[int, ...] = STEPS
    edits: list[tuple[str, str]] = field(default_factory=list)

    @property
    def options(self):
        """Of `check_simulator`."""
        return {"steps": self.steps, "order": ORDERS[self.example]} if self.example in ORDERS else {}


def module_of(example, edits=()):
    """An example as a module, some texts of it replaced."""
    folder = EXAMPLES if (EXAMPLES / f"{example}.py").exists() else OTHERS
    source = (folder / f"{example}.py").read_text(encoding="utf-8")
    for old, new in edits:
        assert old in source, f"{example}.py has no {old!r}"
        source = source.replace(old, new)
    module = ModuleType(example)
    exec(compile(source, f"{example}.py", "exec"), vars(module))
    return module


# name, example, problem, words and, of faults that few steps do not show, "fine"; below, texts and what they become
TABLE = r"""
gamma has the other sign | runge_kutta | four_bar | gamma
    problem.gamma(t, q, v) => -problem.gamma(t, q, v)
gamma is left out | runge_kutta | driven_crank | gamma
    problem.gamma(t, q, v) => 0.0 * problem.gamma(t, q, v)
C_tt is left out | runge_kutta | driven_crank | C_tt
    problem.gamma(t, q, v) => problem.gamma(0.0, q, v)
lam has the other sign | runge_kutta | pendulum | other sign
    both[n:] * heavy => -both[n:] * heavy
a wrong weight | runge_kutta | pendulum | order
    2.0 * v2 + 2.0 * v3 + v4 => v2 + 3.0 * v3 + v4
stages at the start of the step | runge_kutta | driven_crank | order
    (problem, t + 0.5 * h, => (problem, t,
no projection | runge_kutta | pendulum | Project
    q, v = projected(problem, t, q, v) => pass
C_t is left out of the projection | runge_kutta | driven_crank | C_t is left out
    J @ v + problem.constraint_rate(t, q) => J @ v
gyroscopic forces are left out | runge_kutta | heavy_top | gyroscopic
    problem.force(t, q, v) => problem.force(t, q, 0.0 * v)
only the diagonal of M | runge_kutta | andrews | diagonal
    M, J = problem.mass(t, q) => M, J = np.diag(np.diag(problem.mass(t, q)))
M of the start | runge_kutta | andrews | mass matrix is that of the start
    M, J = problem.mass(t, q) => M, J = problem.mass(t, problem.q0)
gravity is fixed along -y | runge_kutta | pendulum | direction is fixed
    problem.force(t, q, v) / heavy => M @ [0.0, -9.81] / heavy
forces 1 % too large | runge_kutta | pendulum | forces are 1 % too large
    problem.force(t, q, v) / heavy => 1.01 * problem.force(t, q, v) / heavy
a matrix with units | runge_kutta | driven_crank | unit
    np.abs(M).max(), np.linalg.norm(J, axis=1) => 1.0, np.ones(m)
rows one time late | runge_kutta | pendulum | late
    np.array(each) for => np.array((each[0], *each[:-1])) for
angles jump back | runge_kutta | crank_rocker | whole turns
    np.array(each) for => np.arctan2(np.sin(np.array(each)), np.cos(np.array(each))) for
silent without convergence | generalised_alpha | out_of_reach | Success with a wrong answer
    raise RuntimeError(f"Newton => return new_q, new_v, new_a, new_between, lam; raise RuntimeError(f"Newton
Newton stops early | generalised_alpha | four_bar | too early
    < 1e-13 => < 1e-4
a wrong gamma of Newmark | generalised_alpha | pendulum | order
    GAMMA = 0.5 => GAMMA = 0.6
forces of the start of the step | generalised_alpha | andrews | First order
    problem.force(t + h, new_q, new_v) => problem.force(t, q, v)
impulses for multipliers | generalised_alpha | pendulum | impulses
    rows.append((q, v, lam)) => rows.append((q, v, lam * step))
velocities of the middle | rattle | pendulum | middle of the step
    q, v = step_on(problem, t, h, q, v) => before, (q, v) = q, step_on(problem, t, h, q, v)
    rows.append((q, v)) => rows.append((q, (q - before) / h))
velocities are not projected | rattle | pendulum | velocit
    return q, free + change => return q, free
the drive of the start of the step | rattle | driven_crank | another instant
    -problem.constraint(t + h, q => -problem.constraint(t, q
# found by trying what no hint had been written for
forces at the time of the start | runge_kutta | shaken_spring | time at the start
    problem.force(t, q => problem.force(problem.t_span[0], q
forces at the time since the start | runge_kutta | shaken_spring | not at 0
    force(t, q => force(t - problem.t_span[0], q
forces of the first positions | runge_kutta | shaken_spring | positions at the start
    force(t, q, v) => force(t, problem.q0, v)
gravity of one body has the other sign | runge_kutta | shaken_spring | force on q[3] (y) is of the other sign
    problem.force(t, q, v) / heavy => problem.force(t, q, v) * np.where(np.arange(n) == 3, -1.0, 1.0) / heavy
the second half-step's force is the first's | rattle | shaken_spring | First order
    problem.force(t, q, middle) => force
C_t of one step before | runge_kutta | driven_crank | of one step before
    projected(problem, t, q, v) => projected(problem, t, q, v, h)
    problem.constraint_rate(t, q) => problem.constraint_rate(t - h, q)
C_q of one step before | runge_kutta | driven_crank | of one step before
    projected(problem, t, q, v) => projected(problem, t, q, v, h)
    J = problem.jacobian(t, q) => J = problem.jacobian(t - h, q - h * v)
steps that have a longest | runge_kutta | pendulum | clock
    h = (end - t) / n => h = min((end - t) / n, 0.005)
a smallest step | runge_kutta | pendulum | a bound of its own | fine
    n = round((end - t) / step) => n = min(2, round((end - t) / step))
a projection that adds | runge_kutta | pendulum | a sign in a projection | fine
    return q, v - np => return q, v + np
a factor on the velocities | runge_kutta | pendulum | a factor on the velocities | fine
    return q, v - np => return q, (1.0 - 1e-6) * v - np
impulses along the rows of the end | rattle | pendulum | First order
    solved(M, to, J, 0 => solved(M, J, J, 0
single precision | runge_kutta | pendulum | single precision
    return q, v - np.linalg => return q, np.float32(v) - np.linalg
a little damping | generalised_alpha | shaken_spring | a damping | fine
    force(t + h, new_q, new_v) => force(t + h, new_q, new_v) - 1e-3 * new_v
multipliers of the middle | generalised_alpha | pendulum | another instant
    rows.append((q, v, lam)) => rows.append((q, v, 0.5 * (lam + rows[-1][2])))
# in integrators that were written for this
a tolerance of its own | dormand_prince | four_bar | it is not used
    / scale_v) / tolerance => / scale_v) / 1e-5
an estimate of one coordinate | dormand_prince | heavy_end | leaves out some coordinates
    np.abs(error_q).max() / scale_q => np.abs(error_q[0]) / scale_q
    np.abs(error_v).max() / scale_v) => 0.0)
a misprint in the tableau | dormand_prince | pendulum | the estimate of the error
    -25360 / 2187 => -25306 / 2187
states between steps by straight lines | dormand_prince | pendulum | between the steps
    h = 1e-3 * (times[-1] - times[0]) => h, told = 1e-3 * (times[-1] - times[0]), [(t, q, v)]
    for end in times[1:]: => for end in times[-1:]:
    if ratio <= 1.0: => if ratio <= 1.0 and not told.append((t + step, new_q, new_v)):
    return tuple(np.array(each) for => at, *s = (np.array(each) for
    zip(*rows, strict=True)) => zip(*told)); return tuple(np.array([np.interp(times, at, x) for x in y.T]).T for y in s)
states of single precision | dormand_prince | pendulum | single precision
    return q, v - => return np.float32(q), np.float32(v) -
    rows.append((q, v, => rows.append((q, np.float32(v),
a projection at the time before | dormand_prince | driven_crank | projection at its end
    projected(problem, t + h, qk, vk) => projected(problem, t, qk, vk)
damping in steps by tolerance | dormand_prince | four_bar | a damping
    problem.force(t, q, v) => problem.force(t, q, v) - 0.02 * v
C_t is left out of an update | half_explicit | driven_crank | C_t is left out
    J @ v + problem.constraint_rate(*end) => J @ v
M of the first position | half_explicit | heavy_top | mass matrix is that of the start
    problem.mass(*at[:2]) => problem.mass(problem.t_span[0], problem.q0)
only the diagonal of M in an update | half_explicit | heavy_top | diagonal
    M, to, Q = problem.mass(*at[:2]) => M, to, Q = np.diag(np.diag(problem.mass(*at[:2])))
the forces of the first stage | half_explicit | pendulum | First order
    (t + 0.5 * h, half_q, half_v), (t => (t, q, v), (t
one step too few | half_explicit | pendulum | its clock is not
    for k in range(n): => for k in range(n - 1):
the last iterate is not taken | half_explicit | pendulum | too early
    q = q + change => new = q + change
    < 1e-13 * max(1.0, np.abs(q).max()): => < 1e-5:
    raise FloatingPointError("no position on the constraints") => raise FloatingPointError("no")
    return q => return q\n        q = new
an iteration with a unit | half_explicit | pendulum | fails in mm and g
    < 1e-13 * max(1.0, np.abs(q).max()) => < 1e-13
velocities of the output time before | half_explicit | pendulum | output time before
    return tuple(np.array(each) for each in => q, v, lam = (np.array(each) for each in
    zip(*rows, strict=True)) => zip(*rows)); return q, np.vstack([v[:1], v[:-1]]), lam
forces of t = 0 | hht | shaken_spring | of t = 0
    problem.force(t, q, v)\n    ) => problem.force(0.0, q, v)\n    )
gyroscopic forces twice | hht | heavy_top | twice as large | fine
    problem.force(t, q, v)\n    ) => 2.0 * problem.force(t, q, v) + problem.force(t, q, 0.0 * v)\n    )
forces of the velocity before | hht | shaken_spring | First order
    equations(problem, new_t, new_q, new_v, => equations(problem, t, new_q, v,
velocities projected at the time before | hht | driven_crank | C_t of one step before
    rows.append(told(problem, end, => rows.append(told(problem, end - h,
multipliers of the weighted equations | hht | shaken_spring | 0.9 times those
    *state[:2], state[3])) => *state[:2], 0.9 * state[3]))
a start without acceleration | hht | driven_crank | First order
    (q, v, a, lam, a) => (q, v, 0.0 * a, lam, 0.0 * a)
a place that is fixed | hht | shaken_spring | distance from the origin | fine
    problem.force(t, q, v)\n    ) => problem.force(t, q, v) - 0.2 * q * (np.abs(q).max() > 3.0)\n    )
"""


def _faults():
    found = []
    for line in TABLE.strip().splitlines():
        if line.startswith("    "):
            found[-1].edits.append(tuple(text.replace("\\n", "\n") for text in line.strip().split(" => ")))
        elif not line.startswith("#"):
            name, example, problem, words, *fine = line.split(" | ")
            found.append(Planted(name, example, problem, words, FINE if fine else STEPS))
    return found


FAULTS = _faults()
