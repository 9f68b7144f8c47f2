"""Define `Problem`: a mechanism with its start, energy and references."""

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from twoloop.checks.arguments import Array, check_call, check_span, check_text, check_vector, shown
from twoloop.problem.description import Description, Drawing, Joint, name_and_unit
from twoloop.problem.system import ConstrainedSystem, check_system

TAGS = (
    *("open chain", "closed chain", "rigid", "flexible", "planar", "spatial", "driven", "redundant"),
    *("singular", "non-holonomic", "stiff", "dissipative"),
)


@dataclass(frozen=True)
class Reference:
    """Reference state of a mechanism at one time, with its source and accuracy.

    Attributes
    ----------
    t : float
        Time, s.
    q, v : ndarray (n_q,)
        Coordinates and velocities; NaN where none is known.
    source : str
        Where the values come from, and how they were checked.
    period : float or None
        Period of the motion, s, where it is periodic.
    lam : ndarray (n_c + n_a,) or None
        Multipliers, where known.
    digits : mapping
        Number of correct decimals of "q", "v" and "lam" after division by max(1, largest value).
    verified : str
        Second method by which the values were checked, and how closely it agrees.

    Examples
    --------
    >>> from twoloop.mechanisms import four_bar
    >>> reference = four_bar().reference
    >>> reference.t, reference.q.shape
    (10.0, (9,))
    """

    t: float
    q: Array
    v: Array
    source: str
    period: float | None = None
    lam: Array | None = None
    digits: Mapping[str, float] = field(default_factory=dict)
    verified: str = ""


@dataclass(frozen=True)
class Condition:
    """Pass rule of a benchmark's authors, which decides whether a run is accurate enough.

    The error is the root mean square, over outputs and quantities, of |difference| / max(|reference|, threshold).

    Attributes
    ----------
    t_end : float
        Length of the run, s.
    n_outputs : int
        Number of evenly spaced output times.
    coordinates, velocities : tuple of int
        Indices of the coordinates and velocities that count.
    threshold : float
        Smallest magnitude by which a difference is divided.
    low, high : float
        Largest error allowed at low and at high precision.
    source : str

    Examples
    --------
    >>> from twoloop.mechanisms import andrews
    >>> andrews().condition is not None
    False
    """

    t_end: float
    n_outputs: int
    coordinates: tuple[int, ...]
    velocities: tuple[int, ...]
    threshold: float
    low: float
    high: float
    source: str

    def error(self, q: Array, v: Array, q_known: Array, v_known: Array) -> float:
        """Return the error of the states q, v (n_q, n_outputs) relative to reference states of the same shape."""
        positions, speeds = list(self.coordinates), list(self.velocities)
        states, expected = np.vstack([q[positions], v[speeds]]), np.vstack([q_known[positions], v_known[speeds]])
        relative = np.abs(states - expected) / np.maximum(np.abs(expected), self.threshold)
        return float(np.sqrt(np.mean(relative**2)))


@dataclass(frozen=True)
class Problem:
    """Mechanism with a consistent start, ready to run, and data to judge and draw its motion.

    Attributes
    ----------
    name : str
    system : ConstrainedSystem
        Copy of the argument, with names, energy and drawing in its description, from which results take them.
    q0, v0 : ndarray (n_q,)
        Consistent start.
    t_span : (float, float)
        Usual start and end, s.
    energy : callable
        energy(t, q, v) in J, for one state or, with q and v (n_q, n_t), for many.
    parameters : dict
        Geometry, masses and other numbers that define the case, by name.
    note : str
        Assumptions, shown with the problem.
    reference : Reference or None
        The most accurate state known.
    published : Reference or None
        Values that others printed, with the digits that they hold.
    motion : callable or None
        motion(t) -> q, v (n_q,), where a closed form is known.
    source : str
        Who posed the problem, and where.
    tags : tuple of str
        Kinds of the mechanism, from `TAGS`.
    purpose : str
        What the problem tests, in plain words.
    conserved : bool or None
        Whether the energy is an invariant. None: unknown, and nothing is judged by it; `studies.compare` then checks
        the energy of its reference.
    invariants : mapping
        Further invariants: name to invariant(t, q, v), as `energy`.
    condition : Condition or None
        The pass rule of the benchmark's authors, if they have one.
    coordinates : tuple of str
        Names of the coordinates with their units, such as "x of crank (m)"; results name their columns by them.
    drawing : Drawing or None
        What `Result.animate` draws.

    Raises
    ------
    TypeError, ValueError
        If an attribute is wrong, a tag is unknown, `coordinates` are not n_q different names, or the drawing does not
        fit the start.

    Examples
    --------
    >>> import numpy as np
    >>> from twoloop import ConstrainedSystem, Problem, solve_dae
    >>> system = ConstrainedSystem.from_python(
    ...     n_q=1, n_c=0, mass=np.eye(1), force=lambda t, q, v: -4.0 * q, name="spring"
    ... )
    >>> problem = Problem(
    ...     name="spring",
    ...     system=system,
    ...     q0=np.array([1.0]),
    ...     v0=np.array([0.0]),
    ...     t_span=(0.0, np.pi),
    ...     energy=lambda t, q, v: 0.5 * v[0] ** 2 + 2.0 * q[0] ** 2,
    ... )
    >>> result = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0)
    >>> round(float(result.q[0, -1]), 5)  # after one period
    1.0
    """

    name: str
    system: ConstrainedSystem
    q0: Array
    v0: Array
    t_span: tuple[float, float]
    energy: Callable[[Any, Array, Array], Any]
    parameters: dict[str, Any] = field(default_factory=dict)
    note: str = ""
    reference: Reference | None = None
    published: Reference | None = None
    motion: Callable[[float], tuple[Array, Array]] | None = None
    source: str = ""
    tags: tuple[str, ...] = ()
    purpose: str = ""
    conserved: bool | None = None
    invariants: Mapping[str, Callable[[Any, Array, Array], Any]] = field(default_factory=dict)
    condition: Condition | None = None
    coordinates: tuple[str, ...] = ()
    drawing: Drawing | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        check_text("name", self.name)
        check_system(self.system)
        n_q = self.system.n_q
        for name, start in (("q0", self.q0), ("v0", self.v0)):
            check_vector(name, start, n_q)
        check_span(self.t_span)
        if not callable(self.energy):
            raise TypeError(f"energy must be a function of t, q and v; given {shown(self.energy)}")
        check_call("energy", "energy", self.energy, ("t", "q", "v"))
        if self.drawing is not None and not isinstance(self.drawing, Drawing):
            raise TypeError(f"drawing must be a twoloop.Drawing; given {shown(self.drawing)}")
        unknown = [tag for tag in self.tags if tag not in TAGS]
        if unknown:
            raise ValueError(f"tags must be of {', '.join(TAGS)}; given {unknown[0]!r}")
        names = self.coordinates
        if names and not len(names) == len(set(names)) == n_q:
            raise ValueError(f"coordinates must be n_q = {n_q} different names, or none; given {names!r}")
        if self.drawing is not None:
            self.drawing.at(np.asarray(self.q0, dtype=float))
        system = copy.copy(self.system)
        system.description = Description(tuple(names), self.energy, self.conserved, self.drawing)
        object.__setattr__(self, "system", system)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the coordinates without their units."""
        return tuple(name_and_unit(name)[0] for name in self.coordinates)

    @property
    def units(self) -> tuple[str, ...]:
        """Return the units of the coordinates; "" for numbers without a unit."""
        return tuple(name_and_unit(name)[1] for name in self.coordinates)

    @property
    def joints(self) -> tuple[Joint, ...]:
        """Return the named joints of the system, whose forces and torques `Result.reactions` returns."""
        return self.system.joints
