"""Files in MuJoCo and as models: the same poses, velocities and accelerations in random keyframes."""

from importlib import import_module
from importlib.util import find_spec

import numpy as np
import pytest

from twoloop.bodies import IgnoredWarning, from_mjcf
from twoloop.bodies.rotation import G, rotation_matrix

pytestmark = [
    pytest.mark.skipif(find_spec("mujoco") is None, reason="MuJoCo is not installed"),
    pytest.mark.filterwarnings("ignore::twoloop.bodies.IgnoredWarning"),
]
INERTIAL = '<inertial pos="0.2 0.1 0" mass="1.5" fullinertia="0.03 0.05 0.06 0.004 0.002 0.001"/>'
TIP = '<body name="tip" pos="0.3 0 0.1" euler="20 0 0"><joint name="last" axis="1 2 0"/><geom size="0.1 0.2"/></body>'
ARM = f"""<worldbody><site name="w" pos="0.5 0.3 1"/><body euler="10 20 30"><joint name="a" axis="0 1 0.3" ref="20"
    springref="35" {{}}/>{INERTIAL}<site name="s" pos="0.2 0.1 0.3" euler="20 30 40"/><body pos="0 0.1 1"><joint
    name="b" type="slide" axis="1 0 1"/>{INERTIAL}<site name="u" pos="0.1 0.2 0.3"/><body pos="0.3 0 0.1" euler="9 0 0">
    <joint name="c" axis="1 2 0"/><site name="v" pos="0.1 0.4 0.3"/>{INERTIAL}</body></body></body></worldbody>"""
CASES = {
    "several joints": f"""<worldbody><body name="hip" euler="0 30 0">
        <joint name="a" axis="1 0 0" armature="0.3" damping="0.2" ref="20"/>
        <joint name="b" axis="0 1 1" pos="0 0 0.1" stiffness="3 2 1" damping="1 2 3" springref="30"/>
        <joint axis="1 1 1" armature="2"/>{INERTIAL}{TIP}</body></worldbody>""",
    "slides": f"""<worldbody><body name="cart"><joint type="slide" axis="1 0 0" armature="0.7" springdamper="0.4 0.6"/>
        <joint type="slide" axis="1 0 1" damping="3"/><joint axis="0 1 0" springdamper="0.2 1"/>{INERTIAL}
        <body pos="0 0 1"><joint type="slide" axis="0 1 1" stiffness="5" armature="1"/>{INERTIAL}{TIP}</body></body>
        </worldbody>""",
    "balls": f"""<worldbody><body><joint type="ball" pos="0.1 0 0" armature="0.4" stiffness="2"/>{INERTIAL}{TIP}</body>
        <body pos="0 0 2"><joint name="f" type="free" armature="0.2"/>{INERTIAL}<body><joint name="b" type="ball"/>
        {INERTIAL}</body></body></worldbody><actuator><motor jointinparent="b" gear="1 2 3"/><motor joint="f"
        gear="3 1 2 4 6 5"/><motor joint="b" gear="3 2 1" forcerange="-0.2 0.2"/></actuator>""",
    "frames": f"""<default><default class="x"><joint axis="1 0 0" damping="0.3"/></default></default><worldbody>
        <frame pos="1 0 0" euler="0 40 0" childclass="x"><body name="arm"><frame pos="0 0.1 0" euler="0 0 50">
        <joint name="in" pos="0 0 0.2"/>{INERTIAL}</frame>{TIP}</body></frame>
        <replicate count="3" offset="0.5 0 0" euler="20 0 30" sep="-"><body name="leg" pos="0 1 0"><joint name="k"/>
        <geom type="box" size="0.1 0.2 0.3"/></body></replicate></worldbody><actuator>
        <position joint="k" kp="40" kv="3"/></actuator>""",
    "compiler": f"""<compiler balanceinertia="true" boundmass="0.5" boundinertia="0.01" settotalmass="7"
        inertiagrouprange="0 1" eulerseq="ZYx"/><worldbody><body euler="10 20 30"><joint/><geom group="2" size="1"/>
        <geom type="cylinder" size="0.3 0.001" mass="2"/><geom type="capsule" fromto="0 0 0 0.4 0 0.1" size="0.05"/>
        <body pos="0 1 0"><geom size="0.02" mass="0.1"/></body>{TIP}</body></worldbody>""",
    "meshes": """<asset><mesh name="m" vertex="0 0 0 1 0 0 0 2 0 0 0 3 1 1 1" scale="0.5 0.25 -0.125"/></asset>
        <worldbody>
        <body><joint axis="1 1 0"/><geom type="mesh" mesh="m" pos="0 0 1" euler="90 0 0"/><geom type="box" mesh="m"/>
        <body gravcomp="0.6"><joint/><geom type="capsule" mesh="m" mass="2"/></body></body></worldbody>""",
    "actuators": f"""<default><general gear="3"/><default class="p"><position kp="20"/></default></default><worldbody>
        <body><joint name="a" axis="0 1 0" ref="20"/>{INERTIAL}<body pos="0 0 1"><joint name="b" type="slide"/>
        {INERTIAL}{TIP}</body></body></worldbody><actuator><position class="p" joint="a" kv="2"/>
        <motor joint="last" gear="-2"/><velocity joint="b" kv="5"/>
        <general joint="b" gainprm="7" biastype="affine" biasprm="1 -2 -3" ctrlrange="0 0.1"/></actuator>""",
    "limited actuators": f"""<default><general gainprm="2" biasprm="0.1 -1 -0.2"/></default>
        {ARM.format('actuatorfrcrange="-1 1"')}<actuator><position joint="a" kp="50" kv="1"/><position joint="b" kp="30"
        dampratio="0.7" gear="2" forcerange="-0.3 0.2"/><damper joint="c" kv="5" ctrlrange="0 1"/><velocity joint="c"/>
        <general joint="c" gaintype="affine" gainprm="7 2 -3" biastype="affine" biasprm="1 2 3"/><cylinder joint="b"
        diameter="2" bias="1 2 3"/><position joint="c" kp="4" timeconst="0.1"/></actuator>""",
    "fixed tendons": f"""<default><tendon damping="0.7"/></default>{ARM.format("")}<tendon>
        <fixed name="t" stiffness="5" springlength="-0.1 0.3" range="-0.1 0.2" limited="false"><joint joint="a"
        coef="0.7"/><joint joint="b" coef="-1"/></fixed><fixed name="u" stiffness="3"><joint joint="c"
        coef="0.4"/><joint joint="a" coef="1"/></fixed></tendon><actuator><position tendon="t" kp="30" dampratio="0.7"
        inheritrange="0.5"/><motor tendon="u" gear="3"/></actuator>""",
    "paths": f"""{ARM.format("")}<tendon><spatial name="t" stiffness="3" damping="1"><site site="w"/><site site="s"/>
        <pulley divisor="2"/><site site="u"/><site site="v"/><site site="w"/></spatial></tendon><actuator>
        <position tendon="t" kp="5" gear="-2"/><motor site="s" gear="1 2 3 0.1 0.2 0.3"/></actuator>""",
    "medium": """<option density="1000" viscosity="0.3" wind="1 -2 0.5"/><worldbody><body><freejoint/>
        <geom type="capsule" size="0.1 0.3" euler="20 30 0"/><geom type="capsule" size="0.1 0.3" euler="20 30 0"
        pos="0.1 0.2 0.3"/></body><body pos="1 1 1"><joint/><inertial pos="0.1 0 0" mass="2" diaginertia="0.1 0.1 0.05"
        euler="20 30 40"/><body pos="0 0 1"><geom type="cylinder" fromto="0 0 0 0.1 0.2 0.3" size="0.1"/></body>
        </body></worldbody>""",
}


def accelerations(problem):
    """Solve M a + C_q^T lam = Q, C_q a = gamma at the start, after scaling by the largest entries."""
    system, t, q, v = problem.system, 0.0, problem.q0, problem.v0
    G_q, Q, gamma = system.jacobian(t, q), system.force(t, q, v), system.gamma(t, q, v)
    K = np.block([[system.mass(t, q), G_q.T], [G_q, np.zeros((len(gamma), len(gamma)))]])
    scale = 1.0 / np.sqrt(np.abs(K).max(axis=1))
    return (scale * np.linalg.solve(scale[:, None] * K * scale, scale * np.r_[Q, gamma]))[: len(q)]


@pytest.mark.parametrize("name", CASES)
def test_the_accelerations_are_those_of_mujoco(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its log
    mujoco = import_module("mujoco")
    text = f"<mujoco><default><geom contype='0' conaffinity='0'/></default>{CASES[name]}<!----></mujoco>"
    model = mujoco.MjModel.from_xml_string(text)
    data, generic = mujoco.MjData(model), np.random.default_rng(7)
    mujoco.mj_integratePos(model, data.qpos, generic.uniform(-1.0, 1.0, model.nv), 1.0)
    data.qvel[:], data.ctrl[:] = generic.uniform(-1.0, 1.0, model.nv), generic.uniform(-1.0, 1.0, model.nu)
    data.act[:] = generic.uniform(0.0, 1.0, model.na)
    mujoco.mj_forward(model, data)
    state = {"qpos": data.qpos, "qvel": data.qvel, "ctrl": data.ctrl, "act": data.act}
    given = " ".join(f'{key}="{" ".join(map(repr, each.tolist()))}"' for key, each in state.items() if each.size)
    path = tmp_path / "model.xml"
    path.write_text(text.replace("<!---->", f"<keyframe><key {given}/></keyframe>"))
    problem = from_mjcf(path, key=0).problem((0.0, 1.0))
    a, moving = accelerations(problem), np.flatnonzero(model.body_jntnum)
    bodies = [body for body in problem.model.bodies if body.inertia.any()]
    for body, number in zip(bodies, moving, strict=True):
        x, e = np.split(problem.q0[list(body.coordinates)], [3])
        J, rate = np.zeros((6, model.nv)), np.zeros((6, model.nv))
        mujoco.mj_jac(model, data, J[:3], J[3:], x, number)
        mujoco.mj_jacDot(model, data, rate[:3], rate[3:], x, number)
        speed, faster = (np.split(values[list(body.coordinates)], [3]) for values in (problem.v0, a))
        spins = [rotation_matrix(e) @ (2.0 * G(e) @ each) for each in (speed[1], faster[1])]
        np.testing.assert_allclose(rotation_matrix(e), data.xmat[number].reshape(3, 3), atol=1e-12)
        np.testing.assert_allclose(np.r_[speed[0], spins[0]], J @ data.qvel, atol=1e-12)
        np.testing.assert_allclose(np.r_[faster[0], spins[1]], J @ data.qacc + rate @ data.qvel, rtol=1e-9, atol=1e-9)


def test_what_is_ignored_stands_in_the_order_of_its_effect(tmp_path):
    path = tmp_path / "model.xml"
    path.write_text("""<mujoco><worldbody><geom size="1"/><body><joint name="j" range="0 90" frictionloss="1"/>
        <geom type="mesh" mesh="none"/><geom size="1"/></body></worldbody><equality><tendon name="e" tendon1="t"/>
        </equality><sensor><jointpos joint="j"/></sensor><actuator><muscle joint="j"/></actuator></mujoco>""")
    with pytest.warns(IgnoredWarning, match="ignored are the mass of a geom of body 'body 1'"):
        ignored = from_mjcf(path).ignored
    words = ("mass", "equality", "actuator", "frictionloss", "limits", "contacts", "sensor")
    assert [word in each for word, each in zip(words, ignored, strict=True)] == [True] * 7
