"""Define `ConstrainedSystem`: M a + C_q^T lam + A^T mu = Q with C(t, q) = 0 and A v + b = 0, as compiled callbacks."""

from __future__ import annotations

import copy
import inspect
import math
import re
import textwrap
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from twoloop.checks.arguments import Array, check_flag, check_number, check_real, check_size, check_text, shaped, shown
from twoloop.checks.callbacks import check_callback
from twoloop.checks.sparse_rows import Rows, SparseRows
from twoloop.kernels.compile.callbacks import KINDS, STATE_SIZES
from twoloop.kernels.compile.linking import Dispatcher
from twoloop.kernels.data.common import PROGRAMS, Functions, Kit
from twoloop.kernels.data.indices import BANDWIDTH, CONSTANT_MASS, GIVEN, N_FLAGS
from twoloop.problem.callbacks import (
    VALUES_OF,
    PythonFunctions,
    checked_entries,
    checked_parameters,
    compile_returning,
    dense_callback,
    dense_matrix,
    given_callbacks,
    plain_functions,
    store,
    substitute,
    through_python,
)
from twoloop.problem.compiled_functions import FrozenValues, pickled, unpickled
from twoloop.problem.description import Description, Joint, check_joints

# pattern of the docstring line that is replaced by the callbacks; group 1: indentation, which Python before 3.13 keeps
PLACEHOLDER = re.compile(r"^( *)\{callbacks\}\n", re.MULTILINE)


def add_callbacks(cls: Any) -> Any:
    """Add a method for each kind of callback to a class, list the kinds in its signature and docstring; return it."""
    for kind in KINDS:
        setattr(cls, kind, _method(kind))
    plain = cls.from_python.__func__
    cls.__signature__, plain.__signature__ = _full_signature(cls), _full_signature(plain)
    cls.__doc__, plain.__doc__ = _with_entries(cls.__doc__, False), _with_entries(plain.__doc__, True)
    return cls


def _method(kind: str) -> Callable[..., Any]:
    """Return the method of a system that evaluates one kind of callback."""
    entry = KINDS[kind]
    parameters = [inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD) for name in ("t", *entry.state)]
    signature = inspect.Signature(parameters)

    def method(self: Any, *arguments: Any, **named: Any) -> Any:
        if named or len(arguments) != len(parameters):
            try:
                arguments = signature.bind(*arguments, **named).args
            except TypeError as error:
                raise TypeError(f"{kind}{signature}: {error}") from None
        return self.evaluate(kind, *arguments)

    self_parameter = inspect.Parameter("self", inspect.Parameter.POSITIONAL_ONLY)
    method.__signature__ = signature.replace(parameters=[self_parameter, *parameters])  # type: ignore[attr-defined]
    method.__name__, method.__qualname__ = kind, f"ConstrainedSystem.{kind}"
    method.__doc__ = f"{entry.meaning[0].upper()}{entry.meaning[1:]}, {entry.shapes_text}.\n\nSee `evaluate`."
    return method


def _with_entries(text: str | None, plain: bool) -> str | None:
    """Return a docstring, `text`, with PLACEHOLDER replaced by the callbacks; None if `text` is None (python -OO)."""
    return text and PLACEHOLDER.sub(lambda match: "".join(_entry(kind, plain, match[1]) for kind in KINDS), text)


def _entry(kind: str, plain: bool, indent: str) -> str:
    """Return the lines about a kind of callback for the section Parameters of a docstring."""
    entry = KINDS[kind]
    called = f"{kind}({', '.join(('t', *entry.state))}) -> {entry.shapes_text}: " if plain else ""
    text = f"{called}{entry.meaning}{'' if plain else ', ' + entry.shapes_text}. {entry.note}"
    if plain and kind == "mass":
        text += " Or an array: a constant matrix, factored once."
    head = f"{kind} : {'callable' if plain else 'compiled callback'}{', optional' if entry.optional else ''}"
    body = textwrap.fill(text, 120, initial_indent=indent + "    ", subsequent_indent=indent + "    ")
    return f"{indent}{head}\n{body}\n"


def _full_signature(function: Any) -> inspect.Signature:
    """Return the signature of a constructor, with a keyword argument for each kind of callback instead of `**`."""
    parameters = inspect.signature(function).parameters.values()
    keyword = inspect.Parameter.KEYWORD_ONLY
    defaults = {kind: None if entry.optional else inspect.Parameter.empty for kind, entry in KINDS.items()}
    callbacks = [inspect.Parameter(kind, keyword, default=default) for kind, default in defaults.items()]
    required = [p for p in parameters if p.default is p.empty and p.kind != p.VAR_KEYWORD]
    options = [p for p in parameters if p.default is not p.empty]
    return inspect.Signature([*required, *callbacks, *options])


@add_callbacks
class ConstrainedSystem:
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
        The vector `p` that every callback gets. It cannot be changed: `with_parameters` makes a system with another.
    constant_mass : bool
        True: M depends neither on t nor on q, and is factored once.
    mass_entries, jacobian_entries : (rows, columns), optional
        Indices of the entries whose values `mass_values` and `jacobian_values` return: two vectors of int each, for
        both triangles of M. Other entries are always zero. Values of an entry that is named twice are added.
    bandwidth : int, optional
        No entry (i, j) with |i - j| > bandwidth is other than zero in M, in the derivatives of the force by q and v,
        and in the second derivatives of each constraint by q; C_q itself may be full. With it the cost of a step of a
        large system grows in proportion to n_q. Needs a constant M. None: nothing is known.
    joints : sequence of Joint
        Named rows, whose forces and torques `Result.reactions` returns.
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
        self.description = Description()  # a Problem replaces it
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
        for kind, function in self.given.items():
            entry = KINDS[kind]
            if not isinstance(function, Dispatcher) or entry.signature.args not in function.overloads:
                raise TypeError(
                    f"{kind} must be compiled by @twoloop.callback({kind!r}) with the arguments "
                    f"({', '.join(entry.arguments)}); given {function!r}. Plain Python functions enter by "
                    "ConstrainedSystem.from_python"
                )
        enclosed = FrozenValues(self.given)
        self.enclosed = enclosed if enclosed.any else None
        missing = [kind for kind in self.entries if kind not in self.given]
        dense = {kind: dense_callback(kind, self.given[VALUES_OF[kind]], self.entries[kind]) for kind in missing}
        self.scattered = frozenset(dense)  # dense kinds computed from values of entries
        callbacks = self.given | dense
        self.given = {kind: callbacks[kind] for kind in KINDS if kind in callbacks}
        flags = np.zeros(N_FLAGS, dtype=np.int64)
        flags[CONSTANT_MASS] = self.constant_mass
        flags[[place for kind, place in GIVEN.items() if kind in self.given]] = 1
        flags[BANDWIDTH] = -1  # each run decides by the size whether to use the bandwidth
        all_callbacks = {kind: self.given.get(kind) or substitute(kind, self.given) for kind in KINDS}
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
        self.within_bounds: set[str] = set()  # kinds of callbacks that check_callback has checked
        self.checked = False  # whether check_derivatives has passed
        self.derived: dict[Any, Any] = {}  # cache of quantities that follow from the equations, see `remembered`
        self.shared: dict[Any, Any] = {}  # cache shared with systems with other parameters: checked options, and runs

    @property
    def n_mass_values(self) -> int:
        """Return the number of entries of M that `mass_values` returns."""
        return len(self.entries["mass"][0]) if "mass" in self.entries else 0

    @property
    def n_jacobian_values(self) -> int:
        """Return the number of entries of C_q that `jacobian_values` returns."""
        return len(self.entries["jacobian"][0]) if "jacobian" in self.entries else 0

    def __repr__(self) -> str:
        return f"ConstrainedSystem({self.name!r}, n_q={self.n_q}, n_c={self.n_c})"

    @property
    def parameters(self) -> Array:
        """Return the vector `p` that every callback gets, read-only: `with_parameters` makes a system with another."""
        # the first number is the handle of Python functions, not a parameter of the user
        p = self.functions.p[self.called_in_python :].copy()  # kernels require writable arrays
        p.setflags(write=False)
        return p.view()  # users cannot make this view writable again

    @parameters.setter
    def parameters(self, value: Any) -> None:
        raise AttributeError(
            f"parameters of {self.name!r} cannot be changed, as results refer to them: make another system by "
            "system.with_parameters(p), which shares the compiled callbacks"
        )

    def with_parameters(self, parameters: ArrayLike) -> ConstrainedSystem:
        """Return a system with the same compiled callbacks and other parameters.

        The new system keeps the names of the coordinates, joints without `point` and `equations`, and an energy that
        was generated with the equations. It drops another energy, a drawing and other joints, as these may enclose the
        old parameters: make a `Problem` of the new system to give them.

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
        system = copy.copy(self)
        if self.called_in_python:
            p = np.append(self.functions.p[:1], p)  # the handle of Python functions
        system.functions = self.functions._replace(p=p, flags=self.functions.flags.copy())
        system.within_bounds, system.checked, system.derived = set(), False, {}
        system.description = self.description.with_parameters(p)
        system.joints = tuple(joint for joint in self.joints if joint.point is None and joint.equations is None)
        return system

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
        """Make a system of plain Python functions, each of which takes arrays and returns an array.

        Parameters
        ----------
        n_q, n_c : int
            Number of coordinates and of constraints C.
        {callbacks}
        n_a : int
            Number of non-holonomic constraints.
        parameters : array_like, optional
            A vector `p` that the functions take as their last argument; those that do without may leave it out.
            `with_parameters` makes a system with another vector, without compiling anything again.
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
                kind: compile_returning(kind, function, kind in taking) for kind, function in functions.items()
            }
            system = cls(**sizes, **options, **compiled, parameters=plain.p)
            system._returning, system._taking = functions, taking
            return system
        missing = [kind for kind in entries if kind not in functions]
        shapes = {"mass": (n_q, n_q), "jacobian": (n_c, n_q)}
        for kind in missing:
            functions[kind] = partial(dense_matrix, functions[VALUES_OF[kind]], entries[kind], shapes[kind])
        taking |= {kind for kind in missing if VALUES_OF[kind] in taking}
        python = PythonFunctions(name, functions, taking)
        wrappers: dict[str, Any] = {kind: through_python(kind) for kind in functions}
        system = cls(**sizes, **options, **wrappers, parameters=np.append(python.handle, plain.p))
        system._python, system._taking = python, taking  # keeps the functions alive: the registry holds them weakly
        system.scattered = frozenset(missing)
        return system

    @property
    def python_functions(self) -> dict[str, Any]:
        """Return the plain Python functions by kind; empty if they are compiled."""
        return {} if self._python is None else self._python.functions

    def takes_parameters(self, kind: str) -> bool:
        """Return whether a plain function of a kind takes the parameters as its last argument."""
        return kind in self._taking

    @property
    def called_in_python(self) -> bool:
        """Return whether the callbacks are plain Python functions."""
        return self._python is not None

    @property
    def kit(self) -> Kit:
        """Return the callbacks as a `Kit`, in the form that kernels take."""
        return self.remembered(("kit", id(self.functions)), lambda: Kit(self.functions))

    def remembered(self, key: Any, make: Callable[[], Any]) -> Any:
        """Return `make()`, cached with this system; not cached for Python functions, which may change."""
        if self._python is not None:
            return make()
        if key not in self.derived:
            self.derived[key] = make()
        return self.derived[key]

    def remembered_at(self, key: Any, state: Any, make: Callable[[], Any]) -> Any:
        """Return `make()`, cached for the last `state` of each key; not cached for Python functions."""
        if self._python is not None:
            return make()
        cached = self.derived.get(key)
        if cached is None or cached[0] != state:
            cached = self.derived[key] = state, make()
        return cached[1]

    def remember_at(self, key: Any, state: Any, value: Any) -> None:
        """Store `value` for a key and state in the cache of `remembered_at`."""
        if self._python is None:
            self.derived[key] = state, value

    def arrays_of(self, kind: str) -> list[Array]:
        """Return arrays of zeros with the shapes of the outputs of a kind of callback."""
        return [np.zeros(shape) for shape in self._shapes[kind]]

    def evaluate(self, kind: str, t: float, *state: ArrayLike) -> Any:
        """Evaluate a callback at (t, q), (t, q, v) or (t, q, lam), as its kind requires.

        Raises
        ------
        TypeError, ValueError
            If an argument is wrong, if the callback goes out of the bounds of its arrays, or if it is not given and
            has no replacement, as gamma, which the integrator computes by differences.
        """
        if kind not in KINDS:
            raise ValueError(f"kind must be one of {', '.join(KINDS)}; given {shown(kind)}")
        entry = KINDS[kind]
        if entry.absent == "kernels" and kind not in self.given:
            raise ValueError(f"{self.name!r} was given no {kind}")
        t = check_number("t", t)
        if not math.isfinite(t):
            raise ValueError(f"t must be finite; given {t!r}")
        if len(state) != len(entry.state):
            expected = ", ".join(("t", *entry.state))
            raise TypeError(f"{kind} is evaluated at ({expected}); given {len(state)} arrays after t")
        arrays = []
        for name, value in zip(entry.state, state, strict=True):
            array = check_real(name, value)
            if array.shape != (n := getattr(self, STATE_SIZES[name]),):
                raise ValueError(
                    f"{name} must have shape ({n},), as {STATE_SIZES[name]} = {n} in {self.name!r}; "
                    f"given {shaped(array)}"
                )
            arrays.append(np.ascontiguousarray(array))
        check_callback(self, kind, t, arrays)
        out = self.arrays_of(kind)
        getattr(self.functions, kind)(t, *arrays, self.functions.p, *out)
        return out[0] if len(out) == 1 else tuple(out)

    def check_returned(self, t: float, q: Array, v: Array) -> None:
        """Check the arrays that functions given with `compile=True` return at (t, q, v).

        Machine code can only report that a shape is wrong, but not which shape it is.
        """
        for kind, function in self._returning.items():
            states = {"q": q, "v": v, "lam": np.ones(self.n_c)}
            arguments = [states[name].copy() for name in KINDS[kind].state]
            arguments += [self.parameters.copy()] if self.takes_parameters(kind) else []
            store(kind, self.name, t, function(t, *arguments), self.arrays_of(kind)[0])

    def velocity_constraint(self, t: float, q: Array, v: Array) -> Array:
        """Evaluate C_q v + C_t and A v + b, (n_c + n_a,): zero for consistent velocities (eq. (4))."""
        return self.sparse_rows(t, q) @ np.asarray(v, dtype=np.float64) + self.rates(t, q)

    def rows(self, t: float, q: ArrayLike) -> Array:
        """Evaluate C_q, then A, (n_c + n_a, n_q)."""
        return self.jacobian(t, q) if self.n_a == 0 else np.vstack([self.jacobian(t, q), self.nonholonomic(t, q)])

    def sparse_rows(self, t: float, q: ArrayLike) -> Rows:
        """Evaluate C_q as SparseRows if `jacobian_values` is given and n_a = 0, else C_q, then A, as an array."""
        if self.n_a > 0 or "jacobian" not in self.entries:
            return self.rows(t, q)
        values, shape = self.jacobian_values(t, q), (self.n_c, self.n_q)
        rows, columns = self.entries["jacobian"]
        pattern = self.remembered("sparse rows", lambda: SparseRows(rows, columns, values, shape))
        return pattern.with_values(pattern.added(values))  # type: ignore[no-any-return]

    def rates(self, t: float, q: ArrayLike) -> Array:
        """Evaluate C_t, then b, (n_c + n_a,)."""
        rate = self.constraint_rate(t, q)
        return rate if self.n_a == 0 else np.append(rate, self.nonholonomic_rate(t, q))

    def __copy__(self) -> ConstrainedSystem:
        system = object.__new__(type(self))
        vars(system).update(vars(self), within_bounds=set(self.within_bounds))
        return system

    def __deepcopy__(self, memo: dict[int, Any]) -> ConstrainedSystem:
        system = memo[id(self)] = copy.copy(self)
        p = self.functions.p.copy()
        if self._python is not None:  # copied functions need a registration of their own
            system._python = PythonFunctions(self.name, copy.deepcopy(self._python.functions, memo), self._taking)
            p[0] = system._python.handle
        system.functions = self.functions._replace(p=p, flags=self.functions.flags.copy())
        return system

    def __reduce__(self) -> tuple[Any, ...]:
        return unpickled, (type(self), *pickled(self))


def check_system(system: object) -> None:
    """Raise unless `system` is a ConstrainedSystem, and the values that its compiled functions froze are unchanged."""
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
