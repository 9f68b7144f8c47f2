"""The modes of a system: sliding and sticking of joints with dry friction; or the single mode without friction."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from twoloop.checks.arguments import Array
from twoloop.impacts.laws import NEGLIGIBLE, responses
from twoloop.problem.system import ConstrainedSystem

if TYPE_CHECKING:
    from twoloop.bodies.model_problem import ModelProblem


Signs = list[int | None]  # for each joint the sliding direction, or one of the following
STICKS, IDLE = 0, None  # held by friction; held already by stops and other joints
INDEPENDENT = 1e-9  # relative: smallest compliance of a joint with the others held, compared with a free joint


class Modes:
    """Base class: a system without friction, which has a single mode."""

    def __init__(self, system: ConstrainedSystem):
        self.system, self.n = system, 0
        self.most = self.kinetic = np.zeros(0)
        self.frozen: dict[int, float] = {}  # constant friction of IDLE joints

    def along(self, q: Array, k: int | None = None) -> Array:
        """Return the gradients of the joint displacements: none."""
        return np.zeros((0, len(q)))

    def free(self, signs: Signs, t: float, q: Array) -> ConstrainedSystem:
        """Return the system."""
        return self.system

    def accelerations(self, signs: Signs, of: list[int], t: float, q: Array, v: Array, a: Array) -> Array:
        """Return the accelerations of joints at rest: none."""
        return np.zeros(0)

    def mode(self, signs: Signs, t: float, q: Array) -> tuple[ConstrainedSystem, dict[int, int]]:
        """Return the system; there are no rows of sticking joints."""
        return self.system, {}

    def turned(self, k: int, system: ConstrainedSystem, row: int, t: float, q: Array) -> float:
        """Return the sign of the row of a sticking joint relative to its sliding direction."""
        return float(np.sign(system.jacobian(t, q)[row] @ self.along(q, k)))


class FrictionModes(Modes):
    """A model with dry friction in joints, each of which slides, with a sign, or sticks: 0.

    Parameters
    ----------
    problem : ModelProblem

    Raises ValueError if a joint cannot slide independently of the others.
    """

    def __init__(self, problem: ModelProblem):
        assert problem.model is not None
        super().__init__(problem.system)
        self._problem, self._model, self._rubs = problem, problem.model, problem.model.dry
        self.n, self.most = len(self._rubs), np.array([rub.static for rub in self._rubs])
        self.kinetic = np.array([rub.kinetic for rub in self._rubs])
        self._pulls = [self._model.pull(rub, problem.parameters) for rub in self._rubs]
        self._lasting: dict[tuple[int | None, ...], ConstrainedSystem] = {}
        self._check_independent(problem.t_span[0], problem.q0)

    def along(self, q: Array, k: int | None = None) -> Array:
        """Return the gradients of the joint displacements, (n, n_q); or of one joint, (n_q,)."""
        if k is None:
            return np.array([self.along(q, each) for each in range(self.n)])
        return self._pulls[k].force(0.0, q, np.zeros_like(q))

    def _check_independent(self, t: float, q: Array) -> None:
        """Raise unless each joint can slide while the others stick; otherwise the frictions are not determined."""
        W = self.along(q)
        D = W @ responses(self.system, t, q, W)
        scale = (W**2).sum(axis=1) / float(np.abs(self.system.mass(t, q)).max())
        for k, rub in enumerate(self._rubs):
            before = D[:k, :k]
            left = D[k, k] - D[k, :k] @ np.linalg.lstsq(before, D[:k, k], rcond=NEGLIGIBLE)[0]
            if not left > INDEPENDENT * scale[k]:
                others = ", ".join(repr(each.name) for each in self._rubs[:k])
                raise ValueError(
                    f"the joint of {rub.name!r} cannot slide by itself: drives or other joints hold it"
                    f"{f', or its motion depends on {others}' if k else ''}, so that its friction is not determined "
                    "while it sticks; remove it and assign all of the friction to another joint"
                )

    def free(self, signs: Signs, t: float, q: Array) -> ConstrainedSystem:
        """Return the system with some joints sliding and the others without friction."""
        known = tuple(signs)
        if known not in self._lasting:
            self._lasting[known] = self._made(self._problem.name, signs, {}, t, q)[0]
        return self._lasting[known]

    def accelerations(self, signs: Signs, of: list[int], t: float, q: Array, v: Array, a: Array) -> Array:
        """Return the accelerations of joints at rest for given accelerations a of the coordinates."""
        if not of:
            return np.zeros(0)
        held, rows = self.mode(signs, t, q)
        R, gamma = held.jacobian(t, q), held.gamma(t, q, v)
        return np.array([self.turned(k, held, rows[k], t, q) * (R[rows[k]] @ a - gamma[rows[k]]) for k in of])

    def mode(self, signs: Signs, t: float, q: Array) -> tuple[ConstrainedSystem, dict[int, int]]:
        """Return the system with some joints sliding and the others held in place, and the rows of the latter."""
        if not {STICKS, IDLE} & set(signs):
            return self.free(signs, t, q), {}
        names = [rub.name for rub, sign in zip(self._rubs, signs, strict=True) if sign == STICKS]
        gauge, rows = self._made("gauge", signs, dict.fromkeys(names, np.nan), t, q)
        first, other = (gauge.constraint(t, q) for t in (0.0, 0.5 * np.pi)) if names else ((), ())
        held = {}
        for rub in (rub for rub in self._rubs if rub.name in names):
            (row,) = rows[rub.name]
            turns = self._model.dimension == 3 and rub.joint.kind == "revolute"  # its row is A cos t + B sin t
            held[rub.name] = float(np.arctan2(-first[row], other[row]) if turns else first[row])
        said = f", {', '.join(names)} sticks" if names else ""
        system, rows = self._made(self._problem.name + said, signs, held, t, q)
        return system, {k: rows[rub.name][0] for k, rub in enumerate(self._rubs) if rub.name in names}

    def _made(
        self, name: str, signs: Signs, held: dict[str, float], t: float, q: Array
    ) -> tuple[ConstrainedSystem, dict[str, tuple[int, ...]]]:
        forces = {rub.name: -(sign or 0) * rub.kinetic for rub, sign in zip(self._rubs, signs, strict=True)}
        forces |= {self._rubs[k].name: self.frozen[k] for k, sign in enumerate(signs) if sign is IDLE}
        return self._model.mode(name, self._problem.parameters, forces, held, t, q)
