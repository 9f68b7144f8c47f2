"""The problem: M a + C_q^T lam + A^T mu = Q with C(t, q) = 0 and A v + b = 0, as compiled callbacks and sizes."""

from __future__ import annotations  # ArrayLike stays a word in help()

import copy
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from twoloop.checks.arguments import Array, check_flag, check_size, check_text, shaped
from twoloop.kernels.compile.callbacks import KINDS
from twoloop.kernels.compile.private import Dispatcher
from twoloop.kernels.data.common import PROGRAMS, Functions
from twoloop.kernels.data.flags import BANDWIDTH, CONSTANT_MASS, GIVEN, N_FLAGS
from twoloop.kernels.data.kit import Kit
from twoloop.problem.adapters import PythonFunctions, compile_returning, through_python
from twoloop.problem.description import Description
from twoloop.problem.enclosed import Enclosed
from twoloop.problem.entries import VALUES_OF, DenseFunction, dense_callback
from twoloop.problem.evaluated import EvaluatedEquations
from twoloop.problem.given import checked_entries, checked_parameters, given_callbacks, in_place_of, plain_functions
from twoloop.problem.joints import Joint, check_joints
from twoloop.problem.pickling import made_again, reduced
from twoloop.problem.system_methods import add_callbacks


@add_callbacks
class ConstrainedSystem(EvaluatedEquations):
    """A constrained mechanical system, M(t, q) a + C_q^T lam + A^T mu = Q(t, q, v).

    Constraints are C(t, q) = 0 (with eq. (1) of the paper) and, if there are any, A(t, q) v + b(t, q) = 0, which need
    not come from positions. Rows may depend on one another where they do not contradict; without any the system is one
    of ordinary differential equations.

    Each callback can be evaluated by the method of its name, which checks the arguments: `system.force(t, q, v)`.

    Parameters
    ----------
    n_q, n_c : int
        Number of coordinates and of constraints C.
    {callbacks}
    n_a : int
        Number of non-holonomic constraints.
    parameters : array_like, optional
        The vector `p` that every callback gets. It stays as it is: `with_parameters` makes a system of others.
    constant_mass : bool
        True: M depends neither on t nor on q, and is factored once.
    mass_entries, jacobian_entries : (rows, columns), optional
        Where the entries are that `mass_values` and `jacobian_values` give: two vectors of int each, of M for both
        triangles. All others are zero at every state. Values of an entry that is named twice are added.
    bandwidth : int, optional
        No entry (i, j) with |i - j| > bandwidth is other than zero in M, in the derivatives of the force by q and v,
        and in the second derivatives of each constraint by q; C_q itself may be full. With it the cost of a step of a
        large system grows in proportion to n_q. Needs a constant M. None: nothing is known.
    joints : sequence of Joint
        Named rows, whose forces and torques `Result.reactions` gives.
    name : str
        Shown in messages.

    Raises
    ------
    TypeError, ValueError
        If a size or the bandwidth is not a sensible integer, a callback was not made by `twoloop.callback`, one that a
        size asks for is missing, force_by_v or reaction_by_q is given without force_by_q, or a joint does not fit.

    Notes
    -----
    A system can be copied, and pickled for another process: callbacks and functions at the top level of a module
    travel by name. Plain functions without a name of their own, such as lambdas, cannot be pickled: a `TypeError`.

    Examples
    --------
    >>> import numpy as np
    >>> from twoloop import ConstrainedSystem
    >>> pendulum = ConstrainedSystem.from_python(
    ...     n_q=2,
    ...     n_c=1,
    ...     mass=np.eye(2),
    ...     force=lambda t, q, v: np.array([0.0, -9.81]),
    ...     constraint=lambda t, q: np.array([0.5 * (q @ q - 1.0)]),
    ...     name="pendulum",
    ... )
    >>> pendulum.jacobian(0.0, np.array([0.6, -0.8]))  # derived
    array([[ 0.6, -0.8]])
    """

    if TYPE_CHECKING:  # the methods of the callbacks, which follow from KINDS

        def __getattr__(self, kind: str) -> Callable[..., Array]: ...

    def __init__(
        self,
        *,
        n_q: int,
        n_c: int,
        n_a: int = 0,
        parameters: ArrayLike = (),
        constant_mass: bool = False,
        mass_entries: Any = None,
        jacobian_entries: Any = None,
        bandwidth: int | None = None,
        joints: Sequence[Joint] = (),
        name: str = "system",
        **callbacks: Dispatcher | None,
    ):
        self.n_q = check_size("n_q", n_q, 1)
        self.n_c, self.n_a = check_size("n_c", n_c, 0), check_size("n_a", n_a, 0)
        self.entries = checked_entries(callbacks, self.n_q, self.n_c, mass_entries, jacobian_entries)
        self.name = check_text("name", name)
        self.joints = check_joints(joints, self.n_q, self.n_c + self.n_a)
        self.description = Description()  # a Problem puts its own in its place
        p = checked_parameters(parameters)
        if not isinstance(constant_mass, (bool, np.bool_)):
            raise TypeError(f"constant_mass must be True or False; given {constant_mass!r}")
        self.constant_mass = bool(constant_mass)
        self.bandwidth = None if bandwidth is None else check_size("bandwidth", bandwidth, 0)
        if self.bandwidth is not None and not self.constant_mass:
            raise ValueError(
                f"bandwidth needs a constant mass matrix; given bandwidth={bandwidth} for a mass that may change"
            )
        self.given = given_callbacks(callbacks, self.n_c, self.n_a)
        self.scattered: frozenset[str] = frozenset()  # dense kinds made of their values
        for kind, function in self.given.items():
            entry = KINDS[kind]
            if not isinstance(function, Dispatcher) or entry.signature.args not in function.overloads:
                raise TypeError(
                    f"{kind} must be compiled by @twoloop.callback({kind!r}) with the arguments "
                    f"({', '.join(entry.arguments)}); given {function!r}. Plain Python functions enter by "
                    "ConstrainedSystem.from_python"
                )
        enclosed = Enclosed(self.given)
        self.enclosed = enclosed if enclosed.any else None
        self._scatter()
        flags = np.zeros(N_FLAGS, dtype=np.int64)
        flags[CONSTANT_MASS] = self.constant_mass
        flags[[place for kind, place in GIVEN.items() if kind in self.given]] = 1
        flags[BANDWIDTH] = -1  # a run decides by the size
        all_callbacks = {kind: self.given.get(kind) or in_place_of(kind, self.given) for kind in KINDS}
        none = (np.zeros(0, np.int64), np.zeros(0))
        programs = dict(zip(PROGRAMS, (*none, *none, *[np.zeros(0, np.int32)] * 2), strict=True))
        self.functions: Any = Functions(**all_callbacks, p=p, flags=flags, **programs)  # type: ignore[call-arg]
        self._python: PythonFunctions | None = None
        self._returning: dict[str, Any] = {}
        self._taking: frozenset[str] = frozenset()  # kinds of plain functions that take the parameters
        self._shapes = {
            kind: [tuple(getattr(self, size) for size in shape) for _, shape in entry.outputs]
            for kind, entry in KINDS.items()
        }
        self.within_bounds: set[str] = set()  # kinds that check_callback has looked at
        self.checked = False  # by check_derivatives
        self.made: dict[Any, Any] = {}  # of its equations: see `remembered`
        self.shared: dict[Any, Any] = {}  # with systems of other parameters: options that were checked, and runs

    @property
    def n_mass_values(self) -> int:
        """Number of entries of M that `mass_values` gives."""
        return len(self.entries["mass"][0]) if "mass" in self.entries else 0

    @property
    def n_jacobian_values(self) -> int:
        """Number of entries of C_q that `jacobian_values` gives."""
        return len(self.entries["jacobian"][0]) if "jacobian" in self.entries else 0

    def _scatter(self) -> None:
        """Make dense callbacks of those that give values, where there are none."""
        made = {kind: VALUES_OF[kind] for kind in self.entries if kind not in self.given}
        dense = {kind: dense_callback(kind, self.given[of], self.entries[kind]) for kind, of in made.items()}
        self.given = {kind: each for kind in KINDS if (each := dense.get(kind, self.given.get(kind))) is not None}
        self.scattered = frozenset(dense)

    def __repr__(self) -> str:
        return f"ConstrainedSystem({self.name!r}, n_q={self.n_q}, n_c={self.n_c})"

    @property
    def parameters(self) -> Array:
        """The vector `p` that every callback gets, read-only: `with_parameters` makes a system of others."""
        p = self.functions.p[self.called_in_python :].copy()  # kernels want an array that may be written
        p.setflags(write=False)
        return p.view()  # which cannot be made writable again

    @parameters.setter
    def parameters(self, value: Any) -> None:
        raise AttributeError(
            f"parameters of {self.name!r} cannot be changed, as results refer to them: make another system by "
            "system.with_parameters(p), which shares the compiled callbacks"
        )

    def with_parameters(self, parameters: ArrayLike) -> ConstrainedSystem:
        """Make a system of the same callbacks, of which nothing is compiled again, and other parameters.

        What is told of a system beside its equations may enclose the parameters, too. Kept are the names of the
        coordinates, joints without a `point` and `equations`, and the energy where it is generated with the equations;
        another energy and a drawing are given by a `Problem` of the new system.

        Parameters
        ----------
        parameters : array_like
            The vector `p`, of the same length.

        Returns
        -------
        ConstrainedSystem

        Raises
        ------
        TypeError, ValueError
            If the parameters are not as many finite numbers, or the system is made of functions that take none.
        """
        p, size = checked_parameters(parameters), self.functions.p.size - self.called_in_python
        if not self._taking and (self._python is not None or self._returning):
            raise TypeError(
                f"{self.name!r} has no parameters: it is made by from_python without them. Give it parameters=p, which "
                "its functions take as their last argument, or make another system of functions that enclose other "
                "numbers"
            )
        if p.size != size:
            raise ValueError(f"parameters of {self.name!r} must be {size} numbers, as they are; given {shaped(p)}")
        other = copy.copy(self)
        if self.called_in_python:
            p = np.append(self.functions.p[:1], p)  # the handle of Python functions
        other.functions = self.functions._replace(p=p, flags=self.functions.flags.copy())
        other.within_bounds, other.checked, other.made = set(), False, {}
        other.description = self.description.with_parameters(p)
        other.joints = tuple(joint for joint in self.joints if joint.point is None and joint.equations is None)
        return other

    @classmethod
    def from_python(
        cls,
        *,
        n_q: int,
        n_c: int,
        n_a: int = 0,
        parameters: ArrayLike | None = None,
        compile: bool = False,
        mass_entries: Any = None,
        jacobian_entries: Any = None,
        bandwidth: int | None = None,
        joints: Sequence[Joint] = (),
        name: str = "system",
        **functions: Any,
    ) -> ConstrainedSystem:
        """Make a system of plain Python functions, each of which takes arrays and returns one.

        Parameters
        ----------
        n_q, n_c : int
            Number of coordinates and of constraints C.
        {callbacks}
        n_a : int
            Number of non-holonomic constraints.
        parameters : array_like, optional
            A vector `p` that the functions take as their last argument; those that do without may leave it out.
            `with_parameters` makes a system of others, of which nothing is compiled again.
        compile : bool
            False: the functions are called as they are, with copies of q and v. True: numba compiles them, with
            the values of closures and globals as they are now: once these change, calls are refused. The functions
            must not write to their arguments.
        mass_entries, jacobian_entries : (rows, columns), optional
            As for the class.
        bandwidth : int, optional
            As for the class; `mass` must then be an array.
        joints : sequence of Joint
            As for the class.
        name : str
            Shown in messages.

        Raises
        ------
        TypeError
            If an argument is not callable, or `compile=True` and numba cannot compile it (says why).
        ValueError
            If a size is out of range or a mass array has the wrong shape.

        Notes
        -----
        `jacobian` and `gamma` that are not given are exact derivatives of what the other functions do with symbols.
        Where these branch on t, q or v, or call what is not known to do the same with symbols, differences stand for
        them: of C_q and C_t over 2e-4 of the largest coordinate and 2e-8 to 2e-4 s (before t too), good to about 1e-11
        unless coordinates of very different scale, or a driving motion of kilohertz, ask for the formula.
        """
        n_q, n_c, n_a = check_size("n_q", n_q, 1), check_size("n_c", n_c, 0), check_size("n_a", n_a, 0)
        plain = plain_functions(functions, (n_q, n_c, n_a), (mass_entries, jacobian_entries), parameters, name)
        functions, entries, taking = plain.functions, plain.entries, plain.taking
        sizes: dict[str, Any] = {"n_q": n_q, "n_c": n_c, "n_a": n_a}
        options: dict[str, Any] = {
            "constant_mass": plain.constant_mass,
            "mass_entries": mass_entries,
            "jacobian_entries": jacobian_entries,
            "bandwidth": bandwidth,
            "joints": joints,
            "name": name,
        }
        if check_flag("compile", compile):
            compiled: dict[str, Any] = {
                kind: compile_returning(kind, each, kind in taking) for kind, each in functions.items()
            }
            system = cls(**sizes, **options, **compiled, parameters=plain.p)
            system._returning, system._taking = functions, taking
            return system
        made = {kind: VALUES_OF[kind] for kind in entries if kind not in functions}
        sides = {"mass": (n_q, n_q), "jacobian": (n_c, n_q)}
        functions |= {kind: DenseFunction(functions[of], entries[kind], sides[kind]) for kind, of in made.items()}
        taking |= {kind for kind, of in made.items() if of in taking}
        python = PythonFunctions(name, functions, taking)
        wrappers: dict[str, Any] = {kind: through_python(kind) for kind in functions}
        system = cls(**sizes, **options, **wrappers, parameters=np.append(python.handle, plain.p))
        system._python, system._taking = python, taking  # the registry holds it weakly
        system.scattered = frozenset(made)
        return system

    @property
    def python_functions(self) -> dict[str, Any]:
        """The plain Python functions by kind, where it is made of these and they are not compiled."""
        return {} if self._python is None else self._python.functions

    def parameters_for(self, kind: str) -> tuple[Array, ...]:
        """What a plain function of a kind takes after the state: the parameters, or nothing."""
        return (self.parameters.copy(),) if self.takes_parameters(kind) else ()

    def takes_parameters(self, kind: str) -> bool:
        """Whether a plain function of a kind takes the parameters as its last argument."""
        return kind in self._taking

    @property
    def called_in_python(self) -> bool:
        """Whether the callbacks are plain Python functions."""
        return self._python is not None

    @property
    def kit(self) -> Kit:
        """The callbacks as kernels take them."""
        return self.remembered(("kit", id(self.functions)), lambda: Kit(self.functions))

    def __copy__(self) -> ConstrainedSystem:
        other = object.__new__(type(self))
        vars(other).update(vars(self), within_bounds=set(self.within_bounds))
        return other

    def __deepcopy__(self, memo: dict[int, Any]) -> ConstrainedSystem:
        other = memo[id(self)] = copy.copy(self)
        p = self.functions.p.copy()
        if self._python is not None:  # numbers of its own for functions of its own
            other._python = PythonFunctions(self.name, copy.deepcopy(self._python.functions, memo), self._taking)
            p[0] = other._python.handle
        other.functions = self.functions._replace(p=p, flags=self.functions.flags.copy())
        return other

    def __reduce__(self) -> tuple[Any, ...]:
        return made_again, (type(self), *reduced(self))


def check_system(system: object) -> None:
    """Raise unless a ConstrainedSystem is given, whose compiled functions enclose what they did when compiled."""
    if isinstance(system, ConstrainedSystem):
        change = None if system.enclosed is None else system.enclosed.change()
        if change is None:
            return
        raise ValueError(change.message(system.name))
    inner = getattr(system, "system", None)
    if isinstance(inner, ConstrainedSystem):
        raise TypeError(
            f"system must be a ConstrainedSystem; given a {type(system).__name__}: give its system, problem.system"
        )
    raise TypeError(
        f"system must be a ConstrainedSystem (for a ready mechanism: problem.system); given {system!r:.200}"
    )
