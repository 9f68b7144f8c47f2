"""The audit: a simulator's order, floor and step; an MJCF file in MuJoCo, compared before it moves; what is refused."""

import json
from importlib.util import find_spec

import numpy as np
import pytest

from tests.problems import quick
from twoloop import solve_dae
from twoloop.__main__ import main
from twoloop.audit import audit_mjcf, audit_simulator, mjcf, simulator
from twoloop.bodies import PlanarModel

FILE = """
<mujoco model="linkage">
  <option timestep="0.002"/>
  <default><geom type="capsule" size="0.02" contype="0" conaffinity="0"/><joint axis="0 1 0"/></default>
  <worldbody>
    <body name="crank"><joint name="pivot"/><geom fromto="0 0 0 0.1 0 0.3"/>
      <body name="rod" pos="0.1 0 0.3"><joint name="elbow"/><geom fromto="0 0 0 0.7 0 0.1"/></body>
    </body>
    <body name="rocker" pos="0.7 0 0"><joint name="base"/><geom fromto="0 0 0 0.1 0 0.4"/></body>
  </worldbody>
  <equality><connect body1="rod" body2="rocker" anchor="0.7 0 0.1"/></equality>
</mujoco>
"""


def file_with(folder, *changes):
    """The file, with each first text replaced by the second."""
    text = FILE
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / "linkage.xml"
    path.write_text(text)
    return path


def end(*lines):
    return "</mujoco>", "".join(lines) + "</mujoco>"


@pytest.fixture(scope="module")
def pendulum():
    model = PlanarModel(name="pendulum")
    model.rod("bar", (0.0, 0.0), (1.0, 0.0), mass=1.0)
    model.revolute("ground", "bar", at=(0.0, 0.0))
    return model.problem((0.0, 0.5))


def falling(bias=0.0, order=1):
    """A simulator with an error of an order and a bias, made of the motion itself."""

    def simulate(problem, times, step):
        run = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, rtol=1e-12, atol=1e-12, t_eval=times)
        return run.q.T + (bias + 5.0 * step**order) * (times - times[0])[:, None]

    return simulate


def test_order_floor_and_step(pendulum):
    audit = audit_simulator(falling(order=2), pendulum, step=5e-3, error=1e-4)
    assert audit.order == pytest.approx(2.0, abs=0.1) and audit.floor is None
    run = audit.reaching
    assert run.error <= 1e-4 < audit.runs[audit.runs.index(run) - 1].error
    assert run.gap == pytest.approx(run.error, rel=1.0)
    floored = audit_simulator(falling(bias=1e-2), pendulum, step=5e-3, error=1e-3)
    assert floored.floor == pytest.approx(5e-3, rel=0.5) and floored.reaching is None
    assert "floor 0.00" in str(floored) and "not reached" in str(floored)


def test_a_failure_is_a_row_and_a_wrong_simulator_an_error(pendulum):
    def failing(problem, times, step):
        raise RuntimeError("the loop broke")

    audit = audit_simulator(failing, pendulum, step=1e-2)
    assert audit.reaching is None and "the loop broke" in str(audit) and np.isnan(audit.runs[0].error)
    assert "not finite" in str(audit_simulator(lambda p, t, h: np.full((51, 3), np.nan), pendulum, step=1e-2))
    with pytest.raises(ValueError, match=r"of shape \(51, 3\); it returned \(3, 51\)"):
        audit_simulator(lambda p, t, h: np.zeros((3, 51)), pendulum, step=1e-2)
    with pytest.raises(ValueError, match=r"start where the problem does; its first row is off by 0\.5"):
        audit_simulator(lambda p, t, h: np.zeros((51, 3)), pendulum, step=1e-2)
    with pytest.raises(TypeError, match=r"model.problem\(...\)"):
        audit_simulator(failing, None, step=1e-2)


@pytest.mark.skipif(find_spec("mujoco") is None, reason="MuJoCo is not installed")
class TestInMuJoCo:
    def test_the_default_has_a_floor_and_the_advice_holds(self, tmp_path, capsys):
        path = file_with(tmp_path, end('<actuator><position joint="pivot" kp="100"/></actuator>'))
        out = [str(tmp_path / name) for name in ("audit.json", "audit.csv")]
        main(["audit", str(path), "--t-end", "0.5", "--error", "1e-3", "--out", *out])
        said = capsys.readouterr().out
        assert "Neither motion has: the forces of actuators." in said and 'integrator="RK4"' in said
        known = json.loads((tmp_path / "audit.json").read_text())
        first, *_, last = known["audits"]
        assert first["floor"] > 1e-2 and first["reaching"] is None and last["reaching"]["error"] < 1e-3
        assert (tmp_path / "audit.csv").read_text().count("RK4") == len(last["runs"])
        option, loop = (line.strip() for line in known["advice"].splitlines()[1:3])
        loop = loop.removeprefix("on every connect and weld: ")
        again = file_with(tmp_path, ('<option timestep="0.002"/>', option), ("<connect", f"<connect {loop}"))
        assert audit_mjcf(again, error=1e-3, t_end=0.5).audits[0].runs[0].error < 1e-3

    def test_a_wrong_reference_is_told(self, tmp_path, monkeypatch):
        def other(problem, error):
            (x, R), apart = true(problem, error)
            return (x + 0.02 * np.linspace(0.0, 1.0, len(x))[:, None, None], R), apart

        true = simulator.reference
        monkeypatch.setattr(simulator, "reference", other)
        made = audit_mjcf(file_with(tmp_path), error=1e-3, t_end=0.2)
        assert "Do not trust this audit" in str(made) and not made.advice

    def test_what_the_file_is_off_by_at_its_own_step(self, tmp_path):
        made = audit_mjcf(file_with(tmp_path), error=1e-2, t_end=0.2)
        run = next(run for run in made.audits[0].runs if run.step == pytest.approx(2e-3))
        assert f"As it is, at 2 ms: error {run.error:.2g}, gap" in str(made) and "Do not trust" not in str(made)
        long = audit_mjcf(file_with(tmp_path, ("0.002", "0.5")), error=1e-2, t_end=0.2)
        assert "its step is 500 ms, and 4 ms is a 50th of the time" in long.as_it_is
        lost = file_with(tmp_path, ("<connect", '<connect solref="-1e8 -1e3"'))
        assert "at 2 ms: failed: MuJoCo warns of BADQACC" in audit_mjcf(lost, error=1e-2, t_end=0.2).as_it_is

    CHANGES = {  # noqa: RUF012
        "medium": [
            ('timestep="0.002"', 'timestep="0.002" density="900" viscosity="0.1"'),
            end('<tendon><fixed stiffness="3"><joint joint="pivot" coef="2"/></fixed></tendon>'),
        ],
        "ref": [('name="elbow"', 'name="elbow" ref="20" springref="35" stiffness="3" damping="0.1"')],
        "gravity": [('timestep="0.002"', 'timestep="0.002" gravity="3 1 -4"')],
        "ignored": [('name="pivot"', 'name="pivot" range="-20 20" armature="0.2" frictionloss="0.3" stiffness="1"')],
        "flag": [
            ('timestep="0.002"/>', 'timestep="0.002"><flag spring="disable"/></option>'),
            ('name="elbow"', 'name="elbow" stiffness="3" damping="0.1"'),
        ],
        "free": [
            ("<worldbody>", '<worldbody><body pos="0 0 3"><freejoint/><geom type="box" size=".3 .2 .1" mass="3"/>'),
            ("</worldbody>", "</body></worldbody>"),
        ],
        "chain": [('<joint name="pivot"/>', '<joint name="pivot" armature="0.3"/><joint axis="1 0 0" damping="0.2"/>')],
        "polynomial": [('name="elbow"', 'name="elbow" stiffness="3 1 2" damping="0.1"')],
    }

    @pytest.mark.parametrize("name", quick(CHANGES, 3))
    def test_both_models_are_one(self, tmp_path, name):
        """RK4 with stiff loops goes to the motion of the model that was read, or the two are not the same."""
        made = audit_mjcf(file_with(tmp_path, *self.CHANGES[name]), error=1e-2, t_end=0.1)
        assert made.audits[-1].runs[-1].error < 1e-4

    @pytest.mark.parametrize(
        ("changes", "words"),
        [
            ([("<connect", '<connect active="false"')], "no loop"),
            ([('timestep="0.002"/>', 'timestep="0.002"><flag equality="disable"/></option>')], "no loop"),
            ([('timestep="0.002"/>', 'timestep="0.002"><flag constraint="disable"/></option>')], "no loop"),
            ([("</worldbody>", '<composite type="cable"/></worldbody>')], "<composite> is not read"),
            ([('timestep="0.002"', 'timestep="0.002" gravity="0 0 0"')], "nothing moves"),
            ([('name="pivot"/>', 'name="pivot" axis="0 1"/>')], "axis of joint 'pivot' must be 3"),
        ],
    )
    def test_what_cannot_be_audited_is_refused(self, tmp_path, changes, words):
        with pytest.raises(ValueError, match=words):
            audit_mjcf(file_with(tmp_path, *changes))

    def test_a_model_that_is_another_one_is_refused(self, tmp_path, monkeypatch):
        def other(path):
            model = from_mjcf(path)
            model.bodies[1].inertia[0] *= 1.01
            return model

        from_mjcf = mjcf.from_mjcf
        monkeypatch.setattr(mjcf, "from_mjcf", other)
        with pytest.raises(ValueError, match=r"masses and inertias differ by .* of 'crank'"):
            audit_mjcf(file_with(tmp_path))

    def test_the_command_ends_with_one_line_and_a_status(self, tmp_path, capsys, monkeypatch):
        monkeypatch.setattr(simulator, "FINEST", 0.5)
        path = file_with(tmp_path)
        with pytest.raises(SystemExit, match=r"--out takes a file that ends in .json or .csv; given"):
            main(["audit", str(path), "--out", str(tmp_path / "audit.txt")])
        with pytest.raises(SystemExit) as ended:
            main(["audit", str(path), "--t-end", "0.5", "--error", "1e-9"])
        assert ended.value.code == 1 and "Nothing tried reaches an error of 1e-09" in capsys.readouterr().out
