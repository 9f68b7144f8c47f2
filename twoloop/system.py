"""The problem: M(t, q) q'' + C_q^T lam = Q(t, q, v) with C(t, q) = 0, as compiled callbacks, sizes and parameters."""

from __future__ import annotations  # ArrayLike stays a word in help()

from collections.abc import Callable
from typing import Any

import numpy as np
from numba.core.dispatcher import Dispatcher
from numpy.typing import ArrayLike, NDArray

from twoloop.callbacks import (
    KINDS,
    PythonFunctions,
    check_arguments,
    compile_returning,
    no_gamma,
    no_rate,
    no_tangent,
    python_constraint,
    python_constraint_rate,
    python_force,
    python_force_by_q,
    python_force_by_v,
    python_gamma,
    python_jacobian,
    python_mass,
    python_reaction_by_q,
    store,
)
from twoloop.checks import check_real, check_size
from twoloop.kernels.common import (
    BANDWIDTH,
    CONSTANT_MASS,
    FORCE_BY_Q_GIVEN,
    FORCE_BY_V_GIVEN,
    GAMMA_GIVEN,
    N_FLAGS,
    REACTION_BY_Q_GIVEN,
    Functions,
)

Array = NDArray[np.float64]

_THROUGH_PYTHON = {
    "mass": python_mass,
    "force": python_force,
    "constraint": python_constraint,
    "jacobian": python_jacobian,
    "constraint_rate": python_constraint_rate,
    "gamma": python_gamma,
    "force_by_q": python_force_by_q,
    "force_by_v": python_force_by_v,
    "reaction_by_q": python_reaction_by_q,
}
_OPTIONAL = ("constraint_rate", "gamma", "force_by_q", "force_by_v", "reaction_by_q")


class ConstrainedSystem:
    """A constrained mechanical system, M(t, q) a + C_q^T lam = Q(t, q, v), C(t, q) = 0 (eq. (1) of the paper).

    Parameters
    ----------
    n_q, n_c : int
        Number of coordinates and of constraints, 1 <= n_c <= n_q.
    mass, force, constraint, jacobian : compiled callbacks
        M (n_q, n_q), symmetric and positive definite; Q (n_q,); C (n_c,); C_q (n_c, n_q). Each made by
        `twoloop.callback`. For plain Python functions use `from_python`.
    constraint_rate : compiled callback, optional
        C_t (n_c,). None: the constraints do not depend on time.
    gamma : compiled callback, optional
        Q_d (n_c,) of C_q a = Q_d, that is -((C_q v)_q v + 2 C_qt v + C_tt). None: by differences of C_q and C_t.
    force_by_q, force_by_v, reaction_by_q : compiled callbacks, optional
        Tangents for Newton's method as the outer loop, each (n_q, n_q): dQ/dq, dQ/dv, and d(C_q^T lam)/dq with lam
        held. With force_by_q the force is not differenced; it must not depend on v then unless force_by_v is given too.
        reaction_by_q None: by differences of C_q, none where C_q does not change. force_by_q None: all by differences.
        What the stiff part does not need is left out then (how M, and the directions that constraints allow, change
        with q): at a tolerance steps are the same, but fixed steps in which bodies turn far may fail to converge.
    parameters : array_like, optional
        The vector `p` that every callback gets.
    constant_mass : bool
        True: M depends neither on t nor on q, and is factored once.
    bandwidth : int, optional
        No entry (i, j) with |i - j| > bandwidth is other than zero in M, in the derivatives of the force by q and v,
        and in the second derivatives of each constraint by q; C_q itself may be full. With it the cost of a step of a
        large system grows in proportion to n_q. Needs a constant M. None: nothing is known.
    name : str
        Shown in messages.

    Raises
    ------
    TypeError, ValueError
        If a size or the bandwidth is not a sensible integer, a callback was not made by `twoloop.callback`, or
        force_by_v or reaction_by_q is given without force_by_q.
    """

    def __init__(
        self,
        *,
        n_q: int,
        n_c: int,
        mass: Dispatcher,
        force: Dispatcher,
        constraint: Dispatcher,
        jacobian: Dispatcher,
        constraint_rate: Dispatcher | None = None,
        gamma: Dispatcher | None = None,
        force_by_q: Dispatcher | None = None,
        force_by_v: Dispatcher | None = None,
        reaction_by_q: Dispatcher | None = None,
        parameters: ArrayLike = (),
        constant_mass: bool = False,
        bandwidth: int | None = None,
        name: str = "system",
    ):
        self.n_q = check_size("n_q", n_q, 1)
        self.n_c = check_size("n_c", n_c, 1)
        if self.n_c > self.n_q:
            raise ValueError(f"n_c must not exceed n_q = {self.n_q}; given {self.n_c}")
        self.name = name
        self.parameters = check_real("parameters", parameters)
        if self.parameters.ndim != 1 or not np.isfinite(self.parameters).all():
            raise ValueError(f"parameters must be a vector of finite numbers; given {parameters!r}")
        if not isinstance(constant_mass, (bool, np.bool_)):
            raise TypeError(f"constant_mass must be True or False; given {constant_mass!r}")
        self.constant_mass = bool(constant_mass)
        self.bandwidth = None if bandwidth is None else check_size("bandwidth", bandwidth, 0)
        if self.bandwidth is not None and not self.constant_mass:
            raise ValueError(
                f"bandwidth needs a constant mass matrix; given bandwidth={bandwidth} for a mass that may change"
            )
        callbacks = {
            "mass": mass,
            "force": force,
            "constraint": constraint,
            "jacobian": jacobian,
            "constraint_rate": no_rate if constraint_rate is None else constraint_rate,
            "gamma": no_gamma if gamma is None else gamma,
            "force_by_q": no_tangent if force_by_q is None else force_by_q,
            "force_by_v": no_tangent if force_by_v is None else force_by_v,
            "reaction_by_q": no_tangent if reaction_by_q is None else reaction_by_q,
        }
        if force_by_q is None and not (force_by_v is None and reaction_by_q is None):
            raise ValueError("force_by_v and reaction_by_q go with force_by_q, which is not given")
        for kind, function in callbacks.items():
            arguments, signature = KINDS[kind]
            if not isinstance(function, Dispatcher) or signature.args not in function.overloads:
                raise TypeError(
                    f"{kind} must be compiled by @twoloop.callback({kind!r}) with the arguments "
                    f"({', '.join(arguments)}); given {function!r}. Plain Python functions enter by "
                    "ConstrainedSystem.from_python"
                )
        flags = np.zeros(N_FLAGS, dtype=np.int64)
        flags[CONSTANT_MASS] = self.constant_mass
        flags[GAMMA_GIVEN] = gamma is not None
        flags[FORCE_BY_Q_GIVEN] = force_by_q is not None
        flags[FORCE_BY_V_GIVEN] = force_by_v is not None
        flags[REACTION_BY_Q_GIVEN] = reaction_by_q is not None
        flags[BANDWIDTH] = -1  # a run decides by the size
        self.functions = Functions(**callbacks, p=self.parameters, flags=flags)
        self._python: PythonFunctions | None = None
        self._returning: dict[str, Any] = {}
        self.checked = False  # by check_derivatives

    def __repr__(self) -> str:
        return f"ConstrainedSystem({self.name!r}, n_q={self.n_q}, n_c={self.n_c})"

    @classmethod
    def from_python(
        cls,
        *,
        n_q: int,
        n_c: int,
        mass: Callable[[float, Array], ArrayLike] | ArrayLike,
        force: Callable[[float, Array, Array], ArrayLike],
        constraint: Callable[[float, Array], ArrayLike],
        jacobian: Callable[[float, Array], ArrayLike],
        constraint_rate: Callable[[float, Array], ArrayLike] | None = None,
        gamma: Callable[[float, Array, Array], ArrayLike] | None = None,
        force_by_q: Callable[[float, Array, Array], ArrayLike] | None = None,
        force_by_v: Callable[[float, Array, Array], ArrayLike] | None = None,
        reaction_by_q: Callable[[float, Array, Array], ArrayLike] | None = None,
        compile: bool = False,
        bandwidth: int | None = None,
        name: str = "system",
    ) -> ConstrainedSystem:
        """Make a system of plain functions that take arrays and return arrays.

        Parameters
        ----------
        n_q, n_c : int
            Number of coordinates and of constraints.
        mass : callable or array_like (n_q, n_q)
            mass(t, q). An array is a constant mass matrix, factored once.
        force : callable
            force(t, q, v) -> (n_q,).
        constraint, jacobian : callable
            constraint(t, q) -> (n_c,), jacobian(t, q) -> (n_c, n_q).
        constraint_rate : callable, optional
            constraint_rate(t, q) -> (n_c,), the partial derivative C_t. None: no dependence on time.
        gamma : callable, optional
            gamma(t, q, v) -> (n_c,), the right side of C_q a = Q_d. None: by differences of C_q and C_t along the
            motion, over 2e-4 of the largest coordinate and 2e-8 to 2e-4 s (before t too): good to about 1e-11 unless
            coordinates of very different scale, or a driving motion of kilohertz, ask for the formula.
        force_by_q, force_by_v, reaction_by_q : callable, optional
            As for the class: force_by_q(t, q, v), force_by_v(t, q, v), reaction_by_q(t, q, lam) -> (n_q, n_q).
        compile : bool
            False: the functions are called as they are, with copies of q and v. True: numba compiles them, with
            the values of closures and globals as they are now.
        bandwidth : int, optional
            As for the class; `mass` must then be an array.
        name : str
            Shown in messages.

        Raises
        ------
        TypeError
            If an argument is not callable, or `compile=True` and numba cannot compile it (says why).
        ValueError
            If a size is out of range or a mass array has the wrong shape.
        """
        n_q, n_c = check_size("n_q", n_q, 1), check_size("n_c", n_c, 1)
        constant_mass = not callable(mass)
        if not callable(mass):
            matrix = check_real("mass", mass)
            if matrix.shape != (n_q, n_q):
                raise ValueError(f"mass must have shape {(n_q, n_q)}; given an array of shape {matrix.shape}")
            mass = _constant(matrix)
        given: dict[str, Any] = {
            "mass": mass,
            "force": force,
            "constraint": constraint,
            "jacobian": jacobian,
            "constraint_rate": constraint_rate,
            "gamma": gamma,
            "force_by_q": force_by_q,
            "force_by_v": force_by_v,
            "reaction_by_q": reaction_by_q,
        }
        for kind, function in given.items():
            if not callable(function) and not (function is None and kind in _OPTIONAL):
                raise TypeError(f"{kind} must be a function; given {function!r} of type {type(function).__name__}")
        functions = {kind: function for kind, function in given.items() if function is not None}
        for kind, function in functions.items():
            check_arguments(kind, function)
        sizes: dict[str, Any] = {
            "n_q": n_q,
            "n_c": n_c,
            "constant_mass": constant_mass,
            "bandwidth": bandwidth,
            "name": name,
        }
        if compile:
            compiled: dict[str, Any] = {kind: compile_returning(kind, each) for kind, each in functions.items()}
            system = cls(**sizes, **compiled)
            system._returning = functions
            return system
        python = PythonFunctions(name, functions)
        wrappers: dict[str, Any] = {kind: _THROUGH_PYTHON[kind] for kind in functions}
        system = cls(**sizes, **wrappers, parameters=[python.handle])
        system._python = python  # the registry holds it weakly
        return system

    @property
    def called_in_python(self) -> bool:
        """Whether the callbacks are plain Python functions."""
        return self._python is not None

    def mass(self, t: float, q: Array) -> Array:
        """M(t, q), (n_q, n_q)."""
        return self._call(self.functions.mass, (self.n_q, self.n_q), t, q)

    def force(self, t: float, q: Array, v: Array) -> Array:
        """Q(t, q, v), (n_q,)."""
        return self._call(self.functions.force, (self.n_q,), t, q, v)

    def constraint(self, t: float, q: Array) -> Array:
        """C(t, q), (n_c,)."""
        return self._call(self.functions.constraint, (self.n_c,), t, q)

    def jacobian(self, t: float, q: Array) -> Array:
        """C_q(t, q), (n_c, n_q)."""
        return self._call(self.functions.jacobian, (self.n_c, self.n_q), t, q)

    def constraint_rate(self, t: float, q: Array) -> Array:
        """C_t(t, q), (n_c,)."""
        return self._call(self.functions.constraint_rate, (self.n_c,), t, q)

    def gamma(self, t: float, q: Array, v: Array) -> Array:
        """Q_d(t, q, v), (n_c,).

        Raises
        ------
        ValueError
            If the system was given none: the integrator then differences C_q and C_t.
        """
        if self.functions.flags[GAMMA_GIVEN] == 0:
            raise ValueError(f"{self.name!r} was given no gamma")
        return self._call(self.functions.gamma, (self.n_c,), t, q, v)

    def force_by_q(self, t: float, q: Array, v: Array) -> Array:
        """dQ/dq, (n_q, n_q); zero where the system was given none, as for the two that follow."""
        return self._call(self.functions.force_by_q, (self.n_q, self.n_q), t, q, v)

    def force_by_v(self, t: float, q: Array, v: Array) -> Array:
        """dQ/dv, (n_q, n_q)."""
        return self._call(self.functions.force_by_v, (self.n_q, self.n_q), t, q, v)

    def reaction_by_q(self, t: float, q: Array, lam: Array) -> Array:
        """d(C_q^T lam)/dq with lam held, (n_q, n_q)."""
        return self._call(self.functions.reaction_by_q, (self.n_q, self.n_q), t, q, lam)

    def shape_of(self, kind: str) -> tuple[int, ...]:
        """Shape of the array that a kind of callback fills."""
        if kind in ("constraint", "constraint_rate", "gamma"):
            return (self.n_c,)
        others = {"force": (self.n_q,), "jacobian": (self.n_c, self.n_q)}
        return others.get(kind, (self.n_q, self.n_q))

    def check_returned(self, t: float, q: Array, v: Array) -> None:
        """Say what is wrong with the arrays that functions given with `compile=True` return at (t, q, v).

        Machine code can only say that a shape is wrong, not which.
        """
        for kind, function in self._returning.items():
            known = {"q": q, "v": v, "lam": np.ones(self.n_c)}
            arguments = [known[name] for name in KINDS[kind][0][1:-2]]
            copies = [np.array(argument) for argument in arguments]
            store(kind, self.name, t, function(t, *copies), np.zeros(self.shape_of(kind)))
            if any((copy != argument).any() for copy, argument in zip(copies, arguments, strict=True)):
                raise ValueError(
                    f"{kind} of {self.name!r} must not change the arrays that it is given; copy them first"
                )

    def velocity_constraint(self, t: float, q: Array, v: Array) -> Array:
        """C_q v + C_t, (n_c,): zero for consistent velocities (eq. (4))."""
        return self.jacobian(t, q) @ np.asarray(v, dtype=np.float64) + self.constraint_rate(t, q)

    def _call(self, function: Dispatcher, shape: tuple[int, ...], t: float, *arrays: Array) -> Array:
        out = np.zeros(shape)
        inputs = [np.array(array, dtype=np.float64, order="C") for array in arrays]
        function(float(t), *inputs, self.functions.p, out)
        return out


def _constant(matrix: Array) -> Callable[[float, Array], Array]:
    def mass(t, q):  # type: ignore[no-untyped-def]
        return matrix

    return mass
