"""MuJoCo's M, forces and accelerations of a file, its equalities exact, beside those of a model that twoloop read."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from references.driver import imported
from twoloop.checks.arguments import Array

LOOP_AT = (0.1, 0.2, 0.1)  # m, in the first body: where a loop is closed that the file cannot have


def constrained(M: Array, f: Array, J: Array, c: Array) -> Array:
    """Return the accelerations a with M a = f + J^T x, J a = c, where rows of J may follow from others."""
    if not len(J):
        return np.asarray(np.linalg.solve(M, f))
    size = np.linalg.norm(J, axis=1) + 1e-300
    U, s, V = np.linalg.svd(J / size[:, None])
    rank = int((s > 1e-9 * s[0]).sum())
    a, N = V[:rank].T @ ((U[:, :rank].T @ (c / size)) / s[:rank]), V[rank:].T
    return np.asarray(a + N @ np.linalg.solve(N.T @ M @ N, N.T @ (f - M @ a)))


class ExactEqualities:
    """MuJoCo's model of a file: the tree, and its equalities as exact rows, at random states."""

    def __init__(self, path: Path, rng: Any, loop: list[str]):
        self.mj = mj = imported("mujoco", extra="engines")
        mj.set_mju_user_warning(lambda text: None)  # by default MuJoCo writes them to a file in the working directory
        spec = mj.MjSpec.from_file(str(path))
        if loop:
            kinds = {"type": mj.mjtEq.mjEQ_CONNECT, "objtype": mj.mjtObj.mjOBJ_BODY}
            spec.add_equality(name="loop", **kinds, name1=loop[0], name2=loop[1], data=[*LOOP_AT, *[0.0] * 9])
        self.m, self.rng = spec.compile(), rng
        bits = mj.mjtDisableBit
        self.m.opt.disableflags |= int(bits.mjDSBL_CONTACT | bits.mjDSBL_LIMIT | bits.mjDSBL_FRICTIONLOSS)
        self.m.opt.jacobian = mj.mjtJacobian.mjJAC_DENSE
        self.d = mj.MjData(self.m)

    def draw(self) -> None:
        """Set a random state, at which the equalities hold."""
        mj, m, d = self.mj, self.m, self.d
        offset = self.rng.uniform(-1.0, 1.0, m.nv)
        for far in (0.8, 0.4, 0.2, 0.1, 0.05, 0.0):
            mj.mj_resetData(m, d)
            mj.mj_integratePos(m, d.qpos, offset, far)
            for _ in range(30):
                mj.mj_fwdPosition(m, d)
                rows = d.efc_type[: d.nefc] == mj.mjtConstraint.mjCNSTR_EQUALITY
                J, gap = d.efc_J.reshape(-1, m.nv)[: d.nefc][rows], d.efc_pos[: d.nefc][rows].copy()
                if np.abs(gap).max(initial=0.0) < 1e-13:
                    break
                mj.mj_integratePos(m, d.qpos, -np.linalg.pinv(J, 1e-6) @ gap, 1.0)
            if np.abs(gap).max(initial=0.0) < 1e-12:
                break
        v = self.rng.uniform(-1.0, 1.0, m.nv)
        d.qvel[:] = v - np.linalg.pinv(J, 1e-6) @ (J @ v) if len(J) else v
        d.ctrl[:], d.act[:] = self.rng.uniform(-1.0, 1.0, m.nu), self.rng.uniform(0.0, 1.0, m.na)
        mj.mj_forward(m, d)

    def point(self, body: int, at: Array, after: int = 99) -> tuple[Array, Array]:
        """Return the Jacobian (6, nv) of a point of a body that only its first joints move, and dJ/dt v.

        Not by mj_jacDot, which is wrong for a ball followed by a slide (4.0.0), while mj_rne is right.
        """
        mj, m, d, J, rate = self.mj, self.m, self.d, np.zeros((6, self.m.nv)), np.zeros(6)
        later = [k for k in range(m.nv) if m.dof_bodyid[k] == body and m.dof_jntid[k] >= m.body_jntadr[body] + after]
        v, d.qvel[later], d.qacc[:] = d.qvel.copy(), 0.0, 0.0
        mj.mj_comVel(m, d)
        mj.mj_rnePostConstraint(m, d)
        mj.mj_objectAcceleration(m, d, mj.mjtObj.mjOBJ_XBODY, body, rate, 0)
        mj.mj_jac(m, d, J[:3], J[3:], at, body)
        J[:, later] = 0.0
        (turning, slid), w, r = rate.reshape(2, 3), J[3:] @ d.qvel, at - d.xpos[body]
        falls = not m.opt.disableflags & int(mj.mjtDisableBit.mjDSBL_GRAVITY)
        slid = slid + falls * m.opt.gravity + np.cross(turning, r) + np.cross(w, np.cross(w, r))
        d.qvel[:] = v
        mj.mj_comVel(m, d)
        return J, np.r_[slid, turning]

    def rows(self) -> tuple[Array, Array]:
        """Return J and c of the equalities as exact rows J a = c, at a state where they hold."""
        mj, m, d, J, c = self.mj, self.m, self.d, [np.zeros((0, self.m.nv))], [np.zeros(0)]
        for kind, one, other, data in zip(m.eq_type, m.eq_obj1id, m.eq_obj2id, m.eq_data, strict=True):
            if m.opt.disableflags & int(mj.mjtDisableBit.mjDSBL_EQUALITY):
                continue
            if kind == mj.mjtEq.mjEQ_JOINT:
                i, k = (m.jnt_dofadr[joint] for joint in (one, other))
                x = d.qpos[m.jnt_qposadr[other]] - m.qpos0[m.jnt_qposadr[other]]
                law = np.polynomial.Polynomial(data[:5])
                J += [np.eye(m.nv)[[i]] - law.deriv()(x) * np.eye(m.nv)[[k]]]
                c += [np.array([law.deriv(2)(x) * d.qvel[k] ** 2])]
                continue
            at = d.xpos[one] + d.xmat[one].reshape(3, 3) @ data[:3] if kind == mj.mjtEq.mjEQ_CONNECT else d.xpos[other]
            (A, a), (B, b) = self.point(one, at), self.point(other, at)
            n = 3 if kind == mj.mjtEq.mjEQ_CONNECT else 6
            J, c = [*J, (A - B)[:n]], [*c, (b - a)[:n]]
        return np.vstack(J), np.concatenate(c)

    def differences(self, problem: Any, own_state: bool) -> dict[str, float]:
        """Return the relative differences of state, M, forces and accelerations of a problem at this state."""
        mj, m, d, system, n = self.mj, self.m, self.d, problem.system, self.m.nv
        q, v, apart = problem.q0.copy(), problem.v0, [0.0]
        seen: Counter[str] = Counter()  # massless bodies, one for each joint of a body but the last
        B, drift = np.zeros((len(q), n)), np.zeros(len(q))
        for body in problem.model.bodies:
            own, (name, after, _) = slice(7 * body.number, 7 * body.number + 7), body.name.partition(" after ")
            b = m.body(name).id
            seen[name] += 1
            x, e = q[own][:3], q[own][3:]
            if not after:
                fixed = np.flatnonzero(m.body_weldid == b)
                mass = m.body_mass[fixed]
                centre, turn = mass @ d.xipos[fixed] / max(mass.sum(), 1e-300), d.xquat[b]
                e_true = turn * (np.sign(turn @ e) or 1.0)
                if own_state:
                    apart += [*np.abs(e - e_true), *(np.abs(x - centre) if mass.sum() > 1e-11 else ())]
                else:
                    x[:] = centre if mass.sum() > 1e-11 else d.xanchor[m.body_jntadr[b]]
                    e[:] = e_true
            J, bias = self.point(b, x, seen[name] if after else 99)
            L = 0.5 * np.vstack([-e[1:], e[0] * np.eye(3) + np.cross(np.eye(3), -e[1:])])
            w = J[3:] @ d.qvel
            rate = L @ w
            turned = 0.5 * np.r_[-w @ rate[1:], rate[0] * w + np.cross(w, rate[1:])]
            B[own], drift[own] = np.vstack([J[:3], L @ J[3:]]), np.r_[bias[:3], L @ bias[3:] + turned]
        if own_state:
            apart += [*np.abs(v - B @ d.qvel)]
        v = B @ d.qvel
        M, theirs = system.mass(0.0, q), np.zeros((n, n))
        mj.mj_fullM(m, d, theirs)
        f, force = d.qfrc_passive + d.qfrc_actuator - d.qfrc_bias, system.force(0.0, q, v)
        a = drift + B @ constrained(theirs, f, *self.rows())
        a_own = constrained(M, force, system.jacobian(0.0, q), system.gamma(0.0, q, v))
        f_own = B.T @ (force - M @ drift)
        pairs = {"M": (B.T @ M @ B, theirs), "forces": (f_own, f), "accelerations": (a_own, a)}
        return {"state": max(apart)} | {
            what: float(np.abs(x - y).max(initial=0.0) / max(1.0, np.abs(y).max(initial=0.0)))
            for what, (x, y) in pairs.items()
        }
