"""The scripts of examples/, and the pages that explain them: they run, and their results have an independent check."""

import runpy
import shutil
import sys
import warnings
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.special import ellipj, ellipk

from tests.testing.planted import FAULTS
from twoloop import ConstraintWarning, solve_dae

mpl = pytest.importorskip("matplotlib")  # not among the oldest versions
ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"
PAGES = {  # the page that explains a script, and prints all of it
    "linkage": "docs/start.md",
    "run_linkage": "docs/start.md",
    "spatial_mechanism": "docs/spatial_mechanism.md",
    "from_mujoco": "docs/from_a_file.md",
    "gripper": "docs/from_a_file.md",
    "ten_thousand_runs": "docs/many_runs.md",
    "sampled_controller": "docs/controller.md",
    "fit_parameters": "docs/fit_parameters.md",
    "own_integrator": "docs/check_simulator.md",
}


def code(page):
    """The Python code of a page, block by block."""
    return [part.split("```")[0] for part in (ROOT / page).read_text(encoding="utf-8").split("```python\n")[1:]]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Run a script, or a page, once in a folder of its own; return what it defines, and the folder.

    A page that prints a script goes on from what the script defines, with the code that is not of the script.
    """
    mpl.use("Agg")
    defined = {}

    def once(name):
        if name not in defined:
            folder = tmp_path_factory.mktemp(Path(name).stem)
            shutil.copytree(EXAMPLES, folder / "examples")
            with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
                warnings.simplefilter("ignore", ConstraintWarning)  # planar loops in space have dependent rows
                patch.chdir(folder)
                patch.syspath_prepend(str(EXAMPLES))
                if name.endswith(".md"):
                    scripts = [script for script, page in PAGES.items() if page == name]
                    names = {key: value for script in scripts for key, value in once(script).items()}
                    printed = "\n".join((EXAMPLES / f"{script}.py").read_text(encoding="utf-8") for script in scripts)
                    for block in code(name):
                        if block.strip() not in printed:
                            exec(block, names)
                else:
                    names = runpy.run_path(str(EXAMPLES / f"{name}.py"))
                sys.modules.pop("linkage", None)
            defined[name] = names | {"_folder": folder}
        return defined[name]

    return once


def newton_euler(bodies, pins, times, torque=lambda angles, rates: 0.0):
    """Integrate planar bodies with pins without twoloop: accelerations and pin forces from one linear system.

    `bodies` has (mass, inertia, x, y, angle) of each, `pins` (first body or None, second body, point at the start).
    `torque` is a function of all angles and rates that returns the torque on each body.
    Returns q of shape (n_times, 3 n_bodies) and the forces of the pins on their second bodies.
    """
    bodies = np.asarray(bodies, dtype=float)
    n, m = 3 * len(bodies), 2 * len(pins)
    mass = np.repeat(bodies[:, 0], 3)
    mass[2::3] = bodies[:, 1]
    weight = np.where(np.arange(n) % 3 == 1, -9.81 * mass, 0.0)
    q0 = bodies[:, 2:].ravel()

    def solved(q, v):
        J, gamma = np.zeros((m, n)), np.zeros(m)
        for k, (first, second, point) in enumerate(pins):
            for body, sign in ((first, 1.0), (second, -1.0)):
                if body is None:
                    continue
                turned = q[3 * body + 2] - q0[3 * body + 2]
                c, s = np.cos(turned), np.sin(turned)
                x, y = np.array([[c, -s], [s, c]]) @ (np.asarray(point) - q0[3 * body : 3 * body + 2])
                J[2 * k : 2 * k + 2, 3 * body : 3 * body + 3] = sign * np.array([[1.0, 0.0, -y], [0.0, 1.0, x]])
                gamma[2 * k : 2 * k + 2] += sign * np.array([x, y]) * v[3 * body + 2] ** 2
        force = weight.copy()
        force[2::3] += torque(q[2::3], v[2::3])
        matrix = np.block([[np.diag(mass), J.T], [J, np.zeros((m, m))]])
        return np.split(np.linalg.solve(matrix, np.concatenate([force, gamma])), [n])

    def rate(t, y):
        return np.concatenate([y[n:], solved(*np.split(y, 2))[0]])

    start = np.concatenate([q0, np.zeros(n)])
    y = solve_ivp(rate, (times[0], times[-1]), start, "DOP853", times, rtol=1e-11, atol=1e-11).y.T
    return y[:, :n], np.array([solved(*np.split(row, 2))[1].reshape(-1, 2) for row in y])


def rod(start, end, mass):
    """Newton and Euler's numbers of a uniform rod."""
    (x0, y0), (x1, y1) = start, end
    return mass, mass * np.hypot(x1 - x0, y1 - y0) ** 2 / 12.0, (x0 + x1) / 2.0, (y0 + y1) / 2.0, 0.0


# --- scripts
def test_every_script_has_a_page_and_a_readable_length():
    assert {path.stem for path in EXAMPLES.glob("*.py")} == set(PAGES)
    for path in EXAMPLES.glob("*.py"):
        assert 12 <= len(path.read_text(encoding="utf-8").splitlines()) <= 62, path.name


@pytest.mark.parametrize("name", PAGES)
def test_the_page_prints_the_whole_script(name):
    def lines(text):
        return [line for line in text.splitlines() if line.strip()]

    script = lines((EXAMPLES / f"{name}.py").read_text(encoding="utf-8"))
    script = script[1:]  # its docstring
    page = lines("\n".join(code(PAGES[name])))
    assert any(page[k : k + len(script)] == script for k in range(len(page))), f"{name}.py is not in {PAGES[name]}"


def test_the_linkage_moves_as_newton_and_euler_say(run):
    names = run("run_linkage")
    O, A, B, D = (run("linkage")[name] for name in "OABD")
    rods = [rod(a, b, np.hypot(*np.subtract(b, a))) for a, b in ((O, A), (A, B), (B, D))]
    result, begun = names["result"], names["result"].t < 1.0
    q, forces = newton_euler(rods, [(None, 0, O), (0, 1, A), (1, 2, B), (None, 2, D)], result.t[begun])
    assert result.success and np.abs((result.q.T - result.q[:, 0])[begun] - (q - q[0])).max() < 1e-6
    assert np.hypot(*names["pin"].force)[begun] == pytest.approx(np.hypot(*forces[:, 1].T), abs=1e-4)
    assert names["error"] < 1e-7 and names["violation"] < 1e-13 and np.ptp(names["energies"]) < 1e-6
    assert "linkage" in (names["_folder"] / "linkage.html").read_text(encoding="utf-8")
    assert (names["_folder"] / "linkage.png").stat().st_size > 5000


def test_the_spatial_mechanism_has_the_geometry_and_the_power_of_its_drive(run):
    names = run("spatial_mechanism")
    P0, S0, D = (np.array(names[name]) for name in "PSD")
    length, rate, m, radius = np.linalg.norm(S0 - P0), names["RATE"], 0.8, 0.02

    def rocker(turn):
        P = 0.3 * np.array([np.cos(turn), np.sin(turn), 0.0])

        def apart(angle):
            return np.linalg.norm(D + 0.7 * np.array([np.sin(angle), 0.0, np.cos(angle)]) - P) - length

        return brentq(apart, -1.2, 0.2, xtol=1e-14)

    turns = rate * names["times"]
    angles = np.array([rocker(turn) for turn in turns])
    assert names["angle"] == pytest.approx(np.degrees(angles), abs=1e-6)

    def energy(turn, h=1e-4):
        """Of the mechanism at the rate of the drive, by differences of its geometry; the coupler does not spin."""
        ends = []
        for at in (turn - h, turn, turn + h):
            angle = rocker(at)
            P = 0.3 * np.array([np.cos(at), np.sin(at), 0.0])
            ends.append((P, D + 0.7 * np.array([np.sin(angle), 0.0, np.cos(angle)])))
        dP, dS = (rate * (b - a) / (2.0 * h) for a, b in zip(ends[0], ends[2], strict=True))
        P, S = ends[1]
        across = m * (3.0 * radius**2 + length**2) / 12.0
        swinging = (m * (3.0 * radius**2 + 0.7**2) / 12.0 + m * 0.35**2) * (dS @ dS) / 0.7**2
        coupler = m * (0.25 * (dP + dS) @ (dP + dS)) + across * ((dS - dP) @ (dS - dP)) / length**2
        return 0.5 * (swinging + coupler) + 9.81 * m * (0.5 * (P[2] + S[2]) + 0.5 * (D[2] + S[2]))

    for k in range(5, turns.size - 5, 20):
        power = rate * (energy(turns[k] + 1e-3) - energy(turns[k] - 1e-3)) / 2e-3
        assert rate * names["torque"][k] == pytest.approx(power, abs=2e-4)


def test_the_gripper_follows_its_command(run):
    """Each finger has 20 g and 0.4 kg of armature, one servo and two dampers."""
    names = run("gripper")

    def slope(t, y):
        command = names["opening"]["grip"](t)
        return [y[1], (400.0 * (command - y[0]) - 30.2 * y[1]) / 0.84]

    y = solve_ivp(slope, (0.0, 2.0), [0.0, 0.0], rtol=1e-11, atol=1e-13).y[0, -1]
    np.testing.assert_allclose(names["fingers"], [y, y], atol=1e-8)


def test_the_file_from_mujoco_moves_as_newton_and_euler_say(run):
    names = run("from_mujoco")
    O, A, B, D = (0.0, 0.0), (0.1, 0.3), (0.8, 0.4), (0.7, 0.0)  # x and z of the file
    radius, bars = 0.02, []
    for start, end in ((O, A), (A, B), (B, D)):
        length = np.hypot(*np.subtract(end, start))
        ball, tube = 4.0 / 3.0 * radius**3, radius**2 * length  # a capsule is two halves of a ball, and a tube
        share = ball / (ball + tube)
        halves = share * (0.4 * radius**2 + length**2 / 4.0 + 0.375 * length * radius)
        inertia = halves + (1.0 - share) * (radius**2 / 4.0 + length**2 / 12.0)
        bars.append((1.0, inertia, *(np.add(start, end) / 2.0), 0.0))

    def knee(angles, rates):
        turning = 0.5 * (angles[2] - angles[1]) + 0.01 * (rates[2] - rates[1])
        return np.array([0.0, turning, -turning])

    q, _ = newton_euler(bars, [(None, 0, O), (0, 1, A), (1, 2, B), (None, 2, D)], names["result"].t, knee)
    centre = names["result"].q[list(names["rod"].coordinates[:3])]
    assert np.abs(centre[[0, 2]] - q[:, 3:5].T).max() < 1e-6 and np.abs(centre[1]).max() < 1e-12
    assert names["gap"] < 1e-12 and names["model"].ignored == ()
    assert names["problem"].freedom.degrees == 1 and len(names["problem"].freedom.redundant[0]) == 4
    assert "<connect" in (names["_folder"] / "again.xml").read_text(encoding="utf-8")


def test_ten_thousand_runs_end_as_single_ones_of_newton_and_euler(run):
    names = run("ten_thousand_runs")
    runs, lengths = names["runs"], names["lengths"]
    assert runs.success.all() and runs.q.shape == (10_000, 9, 101)
    for k in (1, 9999):
        l1, l2, l3, ground = lengths[k]
        a = names["q0"][k, [2, 5, 8]]
        A = l1 * np.array([np.cos(a[0]), np.sin(a[0])])
        B = A + l2 * np.array([np.cos(a[1]), np.sin(a[1])])
        D = B + l3 * np.array([np.cos(a[2]), np.sin(a[2])])
        assert np.abs(D - [ground, 0.0]).max() < 1e-9
        density = names["problem"].parameters["density"]
        bars = [
            rod(start, end, density * l) for start, end, l in (((0.0, 0.0), A, l1), (A, B, l2), (B, (ground, 0.0), l3))
        ]
        pins = [(None, 0, (0.0, 0.0)), (0, 1, A), (1, 2, B), (None, 2, (ground, 0.0))]
        q, _ = newton_euler(bars, pins, np.array([0.0, 2.0]))
        assert runs.q[k, 8, -1] - a[2] == pytest.approx(q[-1, 8], abs=1e-6)
    assert np.ptp(runs.q[:, 8, 0]) < 1e-12 and (names["high"] - names["low"])[-1] > 1e-3


def test_the_sampled_controller_moves_the_arm_as_the_classical_formula_does(run):
    names = run("sampled_controller")
    y, h, integral, torques = np.array([-0.5 * np.pi, 0.0]), names["PERIOD"], 0.0, []
    for _ in names["torques"]:
        error = names["TARGET"] - y[0]
        integral += h * error
        held = names["STIFFNESS"] * error - names["DAMPING"] * y[1] + names["RESET"] * integral
        torques.append(held)
        slopes = [np.zeros(2)]
        for share in (0.0, 0.5, 0.5, 1.0):
            angle, rate = y + share * h * slopes[-1]
            slopes.append(np.array([rate, 3.0 * (held - 0.5 * 9.81 * np.cos(angle))]))
        y = y + h / 6.0 * (slopes[1] + 2.0 * slopes[2] + 2.0 * slopes[3] + slopes[4])
    assert names["torques"] == pytest.approx(torques, abs=1e-6)
    assert names["sample"].q[names["angle"]] == pytest.approx(y[0], abs=1e-8)
    assert names["sample"].q[names["angle"]] == pytest.approx(names["TARGET"], abs=0.03)


def test_the_fit_finds_the_masses_that_it_was_given(run):
    names = run("fit_parameters")
    assert names["fit"].success
    assert (np.abs(names["fit"].x - names["true_masses"]) < 4.0 * names["deviation"]).all()
    assert (names["deviation"] < 0.01).all()  # so that the line above can fail


@pytest.mark.slow
def test_the_slider_moves_as_that_of_sympys_joints_does(run):
    """docs/your_mechanism.md says that `from_method` takes a System; this one has the numbers of the fit."""
    sp = pytest.importorskip("sympy")
    from sympy.physics import mechanics as me

    from twoloop.symbolic import from_method

    names = run("fit_parameters")
    r, l, g = (sp.Symbol(name) for name in "rlg")
    first, second = (np.array(names[name]) for name in "AB")
    values = {r: np.hypot(*first), l: np.hypot(*(second - first)), g: 9.81}
    bars = [me.RigidBody(name, mass=m) for name, m in (("crank", 1.0), ("rod", 2.0))]
    for bar, mass, length in zip(bars, (1.0, 2.0), (r, l), strict=True):
        bar.central_inertia = me.inertia(bar.frame, 0, 0, mass * length**2 / 12)
    ground, piston = me.RigidBody("ground"), me.RigidBody("piston", mass=1.5)
    crank, rod_ = bars
    linkage = me.System.from_newtonian(ground)
    linkage.add_joints(
        me.PinJoint("O", ground, crank, child_point=-r / 2 * crank.x, joint_axis=ground.z),
        me.PinJoint("A", crank, rod_, parent_point=r / 2 * crank.x, child_point=-l / 2 * rod_.x, joint_axis=crank.z),
        me.PrismaticJoint("guide", ground, piston, joint_axis=ground.x),
    )
    linkage.apply_uniform_gravity(-g * ground.y)
    gap = rod_.masscenter.locatenew("end", l / 2 * rod_.x).pos_from(piston.masscenter)
    linkage.add_holonomic_constraints(gap.dot(ground.x), gap.dot(ground.y))
    angle, elbow, guide = linkage.q
    turned = np.arctan2(*first[::-1]), np.arctan2(*(second - first)[::-1])
    start = {angle: turned[0], elbow: turned[1] - turned[0], guide: second[0]}
    problem = from_method(linkage, parameters=values, name="joints").problem(
        start, {angle: 8.0}, (0.0, 2.0), keep=[angle]
    )
    result = solve_dae(problem.system, (0.0, 2.0), problem.q0, problem.v0, t_eval=names["instants"])
    assert result.q[2] == pytest.approx(names["slider"](names["true_masses"]), abs=1e-6)


@pytest.mark.parametrize(("tol", "step"), [(1e-8, 1e-4), (1e-12, 1.5e-8)])
def test_so_are_the_derivatives_right_with_each_of_its_two_remedies(run, tol, step):
    names = run("fit_parameters")
    slider, masses = names["slider"], names["true_masses"]
    for k in range(2):
        change = np.where(np.arange(2) == k, masses, 0.0)
        smooth = (slider(masses + 1e-3 * change, 1e-13) - slider(masses - 1e-3 * change, 1e-13)) / 2e-3
        by_steps = (slider(masses + step * change, tol) - slider(masses, tol)) / step
        assert np.linalg.norm(by_steps - smooth) < 0.02 * np.linalg.norm(smooth)


@pytest.mark.slow
def test_the_check_of_the_own_integrator_is_as_printed(run):
    names, text = run("own_integrator"), (ROOT / PAGES["own_integrator"]).read_text(encoding="utf-8")
    report = names["report"]
    assert not report.passed and names["repeated"].passed
    assert {failure.problem for failure in report.failures} == {"driven_crank"}
    assert all(failure.hint in text and f"    {failure.property}: " in text for failure in report.failures)
    assert f"Of {len(FAULTS)} faults planted" in text


# --- pages
@pytest.mark.parametrize("page", sorted(set(PAGES.values())))
def test_the_rest_of_the_code_of_a_page_runs(run, page):
    run(page)


def test_the_four_bar_of_the_urdf_file_is_closed(run):
    names = run("docs/from_a_file.md")
    problem, bodies = names["four_bar"], {body.name: body for body in names["robot"].bodies}
    assert problem.freedom.degrees == 1
    crank, rod_, rocker = (problem.q0[[*bodies[name].coordinates][:3:2]] for name in ("crank", "rod", "rocker"))
    elbow, knee = 2.0 * crank, 2.0 * rocker - [3.0, 0.0]
    assert np.hypot(*(rod_ - elbow)) == pytest.approx(1.0, abs=1e-12) and rod_ == pytest.approx((elbow + knee) / 2.0)
    assert [np.hypot(*crank), np.hypot(*(rocker - [3.0, 0.0]))] == pytest.approx([0.5, 0.75], abs=1e-12)


def test_start_here_draws_the_bars_of_its_sketch(run):
    names, points = run("run_linkage"), run("linkage")
    drawing, corners = names["problem"].drawing, [np.array(points[name]) for name in "OABD"]
    ends = drawing.at(names["result"].q)[np.array(drawing.bars)]
    bars = sorted(np.linalg.norm(b - a, axis=0).mean() for a, b in ends)
    assert bars == pytest.approx(sorted(np.linalg.norm(b - a) for a, b in pairwise(corners)))


def test_the_sweep_of_many_runs_has_a_row_for_each(run):
    names = run("docs/many_runs.md")
    assert len(names["rows"]) == 20 and set(names["rows"]["status"]) == {"REACHED_END"}
    alone = (
        names["again"].q[8, -1],
        names["runs"].q[0, 8, -1],
    )  # by the Integrator at looser tolerances, and in the ensemble
    assert names["again"].success and alone[0] == pytest.approx(alone[1], abs=1e-4)


def pendulum(t):
    """Positions of a pendulum of 1 m that starts level at x = 1, by Jacobi's elliptic functions."""
    k = np.sin(0.25 * np.pi)
    sn = ellipj(ellipk(k**2) - np.sqrt(9.81) * t, k**2)[0]
    angle = 2.0 * np.arcsin(k * sn)  # from the vertical
    return np.array([np.sin(angle), -np.cos(angle)])


@pytest.mark.parametrize(
    ("page", "package", "name"), [("scipy", "scipy", "q_scipy"), ("sundials", "sksundae", "q_ida")]
)
def test_the_pendulum_in_both_packages(run, page, package, name):
    pytest.importorskip(package)
    names = run(f"docs/coming_from_{page}.md")  # docs/coming_from_scipy.md, docs/coming_from_sundials.md
    other, ours, right = names[name], names["q_twoloop"], pendulum(10.0)
    assert np.abs(other - right).max() < 1e-3 and np.abs(ours - right).max() < 1e-6
    assert abs(np.hypot(*ours) - 1.0) < 1e-14 < 1e-9 < abs(np.hypot(*other) - 1.0)  # what the page says of the joint


def test_the_linkage_in_exudyn(run):
    pytest.importorskip("exudyn")
    names = run("docs/coming_from_exudyn.md")
    O, A, B, D = (names[name] for name in "OABD")
    rods = [rod(a, b, np.hypot(*np.subtract(b, a))) for a, b in ((O, A), (A, B), (B, D))]
    q, _ = newton_euler(rods, [(None, 0, O), (0, 1, A), (1, 2, B), (None, 2, D)], np.array([0.0, 2.0]))
    errors = [np.abs(names[name] - q[-1, 3:5]).max() for name in ("q_twoloop", "q_exudyn")]
    assert errors[0] < 1e-6 and errors[1] < 1e-3


def test_the_linkage_in_mujoco(run):
    pytest.importorskip("mujoco")
    names = run("docs/coming_from_mujoco.md")
    rigid = run("from_mujoco")
    right = rigid["result"].q[list(rigid["rod"].coordinates[:3]), -1]
    errors = [np.abs(names[name] - right).max() for name in ("x_twoloop", "x_stiff", "x_mujoco")]
    assert errors[0] < 1e-6 and errors[1] < 1e-5 and 1e-4 < errors[2] < 0.01
