"""Define what all kernels share: types, compiling decorators, the kit of functions, the workspace, and tolerances.

A kernel is a compiled function of this package. Each kind of callback has a fixed signature, and writes its results
into an argument. So kernels are compiled once, and receive the functions of any mechanism and any method as arguments.
Arguments have the same names in all kernels: `f` is the `Kit` (functions and constant data of a system and a method),
`w` the workspace `Work` (arrays that kernels write), `t` the time (s), `h` a step size (s).
"""

import hashlib
import inspect
import re
from collections import namedtuple
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba import njit, types
from numba.extending import typeof_impl

from twoloop.kernels.compile.caches import compile_cached
from twoloop.kernels.compile.callbacks import KINDS, MATRIX, VECTOR, f8
from twoloop.kernels.compile.generated_functions import DeferredFunctions, GeneratedFunctions
from twoloop.kernels.compile.linking import Dispatcher, HelperCompiler, KernelCompiler, VectorizingCompiler
from twoloop.kernels.compile.reference import Reference
from twoloop.kernels.data.indices import ATOL, COUNTERS, ESTIMATE, FLAGS, GAP, GIVEN, NOT_FINITE, NOTES, RTOL

i8 = types.int64
INTEGERS = types.int64[::1]
INTEGERS_32 = types.int32[::1]  # for programs (lists of operations) so long that 64-bit integers overfill the cache

# programs (recorded lists of operations) in `Functions`. jacobian_... and gamma_... replace callbacks that the user did
# not give, see evaluation/operations.py. ldl_program and newton_program factor the matrices of large systems, see
# linalg/symbolic_factorization.py and sparse_lu.py. The array of a missing program has size 0
PROGRAMS = "jacobian_program", "jacobian_numbers", "gamma_program", "gamma_numbers", "ldl_program", "newton_program"
# what kernels know of a mechanism: callbacks (KINDS), parameters `p`, flags (see indices.py) and programs
Functions: Any = namedtuple("Functions", [*KINDS, "p", "flags", *PROGRAMS])  # type: ignore[misc]


class Work(NamedTuple):
    """Workspace: the arrays that kernels write, allocated once per run.

    G = [C_q; A] contains the Jacobian C_q of the constraints on positions (n_c rows) and the rows A of non-holonomic
    constraints A v + b = 0 (n_a rows). Of n_q coordinates, r positions and r_v velocities are dependent: r and r_v are
    the numbers of independent rows of C_q and of G. n_dof = n_q - r_v. Subscripts: d dependent, i independent columns.
    Fields that end in _v belong to velocities; if n_a = 0, they are the same arrays as the fields without _v.
    """

    M: Any  # (n_q, n_q) mass matrix
    L: Any  # (n_q, n_q) inverse of the mass matrix if it is constant, else its factors: dense (ldl_factor) or banded
    G: Any  # (n_c + n_a + 1, n_q) constraint Jacobian [C_q; A] at the position evaluated last, then a row of zeros
    entries: Any  # view of the constraint Jacobian G as a vector, row by row
    augmented: Any  # view, as one vector, of the constraint Jacobian G followed by the mass matrix M
    S: Any  # (r_v, r_v) Schur complement G M^-1 G^T (G: independent rows of the constraint Jacobian), then its factors
    W: Any  # (r_v, n_q) G M^-1 (G: independent rows of the constraint Jacobian; M: mass matrix)
    A: Any  # (n_dof, n_dof) T^T M T (T: null space of G), then its factors; empty unless the null-space form is used
    MT: Any  # (n_q, n_dof) mass matrix times T, whose columns are the null space of the constraint Jacobian
    # null space of G: row j contains the dependent velocities (in order of elimination) if independent velocity j is 1
    # and the others are 0. Last row: dependent velocities due to drives (C_t and b) if all independent ones are 0
    D: Any  # (n_dof + 1, r_v) dependent velocities per unit of each independent one; last row: those due to drives
    Gx: Any  # (n_c + n_a, n_q) constraint Jacobian at a displaced position; scratch for full pivoting
    G_of_S: Any  # (n_c + n_a, n_q) if M is constant: the G in S = G M^-1 G^T and W = G M^-1; NaN: S and W are invalid
    pattern: Any  # (n_c + n_a, n_q) 1 for entries of the constraint Jacobian that have been nonzero in the run, else 0
    mass_pattern: Any  # (n_q, n_q) 1 for entries of M that have been nonzero, else 0; only in the form AUGMENTED
    row_entries: Any  # row_entries[row_entries[i] : row_entries[i + 1]]: columns of row i of G where `pattern` is 1
    Gamma_tried: Any  # (2, n_c + n_a) Gamma by differences. Row 0: doubled time step; row 1: time step tried before
    rates: Any  # (13, n_c + n_a) constraint rates C_t and b at 13 times within a step, see discontinuities.py
    changes: Any  # (N_CHANGES, n_q + n_c + n_a) samples of forces and constraint rates, see discontinuities.py
    Q: Any  # (n_q) generalized forces
    x: Any  # (n_q) scratch, for example a displaced position
    y: Any  # (n_q) scratch, for example a correction of positions
    C: Any  # (n_c) violations C(t, q) of the constraints; also scratch
    Rate: Any  # (n_c + n_a) constraint rates: C_t = dC/dt at constant q, and b in A v + b = 0
    Gamma: Any  # (n_c + n_a) right-hand side of G a = Gamma for the accelerations a
    g: Any  # (n_c + n_a) scratch, with one entry for each row of G
    z: Any  # (r_v) scratch, with one entry for each independent row of G
    lam: Any  # (n_c + n_a) multipliers of evaluations whose caller does not need them
    minimum: Any  # scratch for the multipliers of least norm, see saddle_point.py
    rows: Any  # (r) indices of the independent rows of C_q
    dependent: Any  # (r) indices of the dependent coordinates
    independent: Any  # (n_q - r) indices of the independent coordinates
    index: Any  # list of operations that factors C_qd, the dependent columns of C_q, see markowitz_lu.py
    values: Any  # factors of C_qd, the dependent columns of C_q (independent rows only)
    rows_v: Any  # (r_v) indices of the independent rows of G
    dependent_v: Any  # (r_v) indices of the dependent velocities
    independent_v: Any  # (n_dof) indices of the independent velocities
    index_v: Any  # list of operations that factors G_d, the dependent columns of G (independent rows only)
    values_v: Any  # factors of G_d, the dependent columns of the constraint Jacobian G
    index_a: Any  # list of operations that factors the augmented matrix [M G^T; G 0]; index_a[SIZE] = 0: no list yet
    values_a: Any  # factors of the augmented matrix; empty in other forms than AUGMENTED
    right: Any  # (2 (n_q + r_v)) right-hand side for the augmented matrix; the second half is scratch (r_v: rank of G)
    order: Any  # (n_q) scratch: order of the columns in full pivoting
    row_order: Any  # (n_c + n_a) scratch: order of the rows in full pivoting
    counters: Any  # (N_COUNTERS) numbers of steps, iterations, evaluations etc. in the run, see indices.py
    lapack: Any  # addresses of the LAPACK routines in band.ROUTINES; zeros if no matrix is banded
    predicted: Any  # (r) dependent positions predicted by the integration formula, before they are projected
    notes: Any  # (N_NOTES) values that one kernel stores for another, see indices.py
    nodes: Any  # results of all operations of a traced program, see evaluation/operations.py
    matrices: Any  # matrices of Newton's method in implicit steps, see steps/stages.py and steps/newton_systems.py
    # the next fields, up to `solutions`, belong to the fixed-order form; they are empty in other forms
    mass_values: Any  # nonzero entries of M, in the order of linalg/symbolic_factorization.py
    jacobian_values: Any  # nonzero entries of C_q, in the order of linalg/symbolic_factorization.py
    is_independent: Any  # (n_c) 1 for independent rows of C_q, 0 for redundant rows
    factors: Any  # factors of the augmented matrix; f.ldl_program contains the index of each entry
    pivot_sizes: Any  # (n_q + n_c) squared norms of rows of C_q, to which pivots are compared, see linalg/sparse_ldl.py
    unknowns: Any  # (n_q + n_c) right-hand side when a solver is called, solution when it returns
    solutions: Any  # 3 (n_q + n_c) scratch numbers; then n_c factors s, one per row g of C_q: s g^T g is added to M

    sizes: Any = None  # the numbers that determine the sizes of all arrays, see `Sizes` in layout.py
    address: Any = 0  # address of the field `table` in memory; kernels receive this address as their argument `w`
    table: Any = None  # addresses and shapes of all arrays of the workspace


_INTEGER_FIELDS = {
    *("rows", "dependent", "independent", "index", "rows_v", "dependent_v", "independent_v", "index_v"),
    *("index_a", "row_entries", "order", "row_order", "counters", "lapack"),
}
_MATRIX_FIELDS = {
    *("M", "L", "G", "S", "W", "A", "MT", "D", "Gx", "G_of_S", "pattern", "mass_pattern", "Gamma_tried", "rates"),
    "changes",
}
WORK = Reference(
    "Work",
    {n: MATRIX if n in _MATRIX_FIELDS else INTEGERS if n in _INTEGER_FIELDS else VECTOR for n in Work._fields[:-3]},
    {"notes": NOTES, "counters": COUNTERS},
)


@typeof_impl.register(Work)
def _type_of_work(value: Any, context: Any) -> Any:
    return WORK


class Attempt(NamedTuple):
    """Result of an attempted step: its code, its error and the factor for the next step size.

    code : DONE, or the reason why the step failed.
    error : error estimate in tolerances; if it exceeds 1, the step is rejected. If a step is longer than the method
        allows, it is not computed: then `error` is the ratio of its size to the largest allowed size.
    factor : ratio of the next step size to the size of this step; 0: step-size control computes the ratio from `error`.
        If both factor and error exceed 1, the step size was a guess: the step must be repeated with a larger size.
    """

    code: int
    error: float
    factor: float


class Step(NamedTuple):
    """Compiled functions of a method: `attempt` computes a step, `commit` saves or discards the step's data.

    `many` takes several steps in one call, and accepts or rejects each step itself. It is None if a method lacks it.
    """

    attempt: Any = None
    commit: Any = None
    many: Any = None


KIT = Reference(
    "Kit",
    {
        **{"p": VECTOR, "flags": INTEGERS, "numbers": VECTOR, "own_numbers": VECTOR},
        **dict(zip(PROGRAMS, (INTEGERS, VECTOR, INTEGERS, VECTOR, INTEGERS_32, INTEGERS_32), strict=True)),
    },
    {"flags": FLAGS},
)
for _name, _kind in KINDS.items():
    KIT.add_function(_name, _kind.signature)
# signature of inner loops: (kit, workspace, task, t, q, v, tolerance, a, lam) -> code, see inner_loop.py
INNER = i8(KIT, WORK, i8, f8, VECTOR, VECTOR, f8, VECTOR, VECTOR)
for _name in ("inner", "general"):
    KIT.add_function(_name, INNER)
# signature of `Step.attempt`: (kit, work, options, memory, t, h, tolerances, state, new_state) -> Attempt
ATTEMPT = types.NamedTuple((i8, f8, f8), Attempt)(KIT, WORK, VECTOR, VECTOR, f8, f8, VECTOR, VECTOR, VECTOR)
for _name in ("attempt", "attempt_first", "attempt_second"):
    KIT.add_function(_name, ATTEMPT)
# signature of `Step.commit`: (kit, work, options, memory, tolerances, accepted) -> None
COMMIT = types.void(KIT, WORK, VECTOR, VECTOR, VECTOR, types.boolean)
for _name in ("commit", "commit_first", "commit_second"):
    KIT.add_function(_name, COMMIT)
# signature of `Step.many`: (kit, work, options, memory, tolerances, control, clock, goal, state, new_state, times,
# states, steps) -> number of steps
MANY = i8(KIT, WORK, *[VECTOR] * 5, f8, *[VECTOR] * 3, MATRIX, MATRIX)
KIT.add_function("attempt_many", MANY)

# signatures of the functions generated for a mechanism, see generate/elimination.py and collocation_code.py. Those with
# a boolean result return False, and write no results, if the code is not valid at this state, as pivots are too small
OWN_FUNCTIONS = {
    # functions of a state: arguments (t, q, v, f.numbers), then the arrays of results that the comments name
    "own_accelerate": types.boolean(f8, VECTOR, VECTOR, VECTOR, VECTOR),  # store accelerations; False: code not valid
    "own_correct_positions": types.boolean(f8, VECTOR, VECTOR, VECTOR, VECTOR, VECTOR),  # store change of q and new q
    "own_project": types.boolean(f8, *[VECTOR] * 8),  # store accelerations, change of q, new q, new v, multipliers
    "own_redundant": types.boolean(f8, VECTOR, VECTOR, VECTOR, VECTOR),  # return True if redundant rows are satisfied
    # functions of collocation steps; `memory` is described in data/collocation.py, `numbers` is f.own_numbers
    "attempt_nodes": f8(*[VECTOR] * 4),  # (memory, state, tolerances, numbers): solve for stages; return a code
    "audit_nodes": f8(*[VECTOR] * 3),  # (memory, state, numbers): return the largest defect between nodes; -1: failure
    "retry_nodes": types.none(*[VECTOR] * 2),  # (memory, state): store a rejected step's polynomial for a shorter step
    "end_nodes": types.none(*[VECTOR] * 3),  # (memory, state, new_state): compute the state at the end of the step
    "correct_ends": types.none(*[VECTOR] * 2),  # (memory, numbers): move the ends of 8 steps at once towards C = 0
    "project_ends": types.none(*[VECTOR] * 2),  # (memory, numbers): project the ends of 8 steps, and store a, lam
}
KIT.add_llvm_functions(OWN_FUNCTIONS)


_FOLDER = Path(__file__).parents[1]  # folder of the kernels


def _source_path(module: str) -> Path:
    return _FOLDER / f"{module.replace('.', '/')}.py"


@cache
def _source_text(module: str) -> str:
    path = _source_path(module)
    return path.read_text() if path.exists() else ""


def _imported_modules(text: str) -> set[str]:
    """Return the names of the modules below twoloop.kernels that a source text imports, such as "steps.stages"."""
    names = set()
    for folder, several, single in re.findall(
        r"^from twoloop\.kernels([\w.]*) import (?:\(([^)]*)\)|(.+))$", text, re.MULTILINE
    ):
        if _source_path(folder[1:]).exists():
            names.add(folder[1:])
        else:
            modules = (name.split(" as ")[0].strip() for name in (several or single).split(","))
            names |= {f"{folder}.{module}"[1:] for module in modules if module}
    return names


@cache
def source_digest(module: str) -> str:
    """Return a hash of all sources on which a module's machine code depends, for the key of this code on disk.

    These are the source of `module` (a name below twoloop.kernels, such as "steps.stages"), the sources of all modules
    that it imports, directly or not, and the signatures of callbacks.
    """
    modules: set[str] = set()
    pending = {module}
    while pending:
        modules |= pending
        pending = {name for each in pending for name in _imported_modules(_source_text(each)) if name not in modules}
    digest = hashlib.sha256(repr((KIT.functions, GIVEN)).encode())
    for each in sorted(modules):
        digest.update(_source_text(each).encode())
    return digest.hexdigest()


def _module_name(function: Callable[..., Any]) -> str:
    path = Path(inspect.getfile(function)).with_suffix("")
    return ".".join(path.relative_to(_FOLDER).parts) if path.is_relative_to(_FOLDER) else path.stem


_ANNOUNCEMENT = "twoloop: compiling the integrator, about a minute; later processes read it from the disk"


def kernel(signature: Any, vectorized: bool = False) -> Callable[[Callable[..., Any]], Dispatcher]:
    """Return a decorator that compiles a kernel, or reads its saved machine code if its sources have not changed."""

    def compile_now(function: Callable[..., Any]) -> Dispatcher:
        return compile_cached(
            function,
            signature,
            (source_digest(_module_name(function)), ""),
            announcement=_ANNOUNCEMENT,
            pipeline_class=VectorizingCompiler if vectorized else KernelCompiler,
            **OPTIONS,
        )

    return compile_now


# options of numba for all kernels. "fastmath" omits the flags "nnan" and "ninf", because code must handle NaN and
# infinity. `_nrt` = False excludes numba's runtime: then kernels cannot allocate arrays, and do not count references to
# arrays, which would take a third of the time of an evaluation of a four-bar linkage
OPTIONS: dict[str, Any] = {
    "error_model": "numpy",
    "fastmath": {"contract", "reassoc", "nsz", "arcp"},
    "nogil": True,
    "_nrt": False,
}


def _helper_decorator(**options: Any) -> Callable[[Callable[..., Any]], Dispatcher]:
    """Return a decorator that compiles helpers: functions that only other compiled functions call."""
    wrappers = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return njit(**{**OPTIONS, **wrappers, "pipeline_class": HelperCompiler, **options})


# numba passes the flags of a helper on to all helpers that it calls. Calls from a helper with forceinline=True would
# thus be inlined, too, if the decorators of the called helpers did not set forceinline
exact = _helper_decorator(fastmath=False, forceinline=False)  # keeps the order of floating-point operations
compiled = _helper_decorator(forceinline=False)  # compiled as a function, which LLVM inlines only if it is short
inlined = _helper_decorator(inline="always")  # inlined by numba; only a helper of this kind can return views of arrays
merged = _helper_decorator(forceinline=True)  # for short or frequent helpers: LLVM copies their code into the callers


NO_NUMBERS = np.zeros(0)  # value of Kit.numbers if no generated function reads data


class Kit:
    """Functions and data of a system and a method, passed to kernels as one reference.

    `functions`: callbacks and data of the system. `own`: functions generated for the mechanism, if any. `inner`: the
    inner loop, which may call `own`. `general`: the inner loop for any mechanism, for what generated code cannot do.
    `step`: functions of the method, or None if no kernel calls them. `first`, `second`: functions of two methods
    between which the run may switch. Generated functions of a state read `numbers`, those of a step `own_numbers`.
    """

    def __init__(
        self,
        functions: Any,
        inner: Any = None,
        step: Step | None = None,
        first: Step | None = None,
        second: Step | None = None,
        general: Any = None,
        own: tuple[GeneratedFunctions | DeferredFunctions, ...] = (),
        numbers: Any = None,
        own_numbers: Any = None,
    ):
        self.__dict__.update(functions._asdict())
        self.functions, self.inner, self.general, self.own = functions, inner, general, own
        self.numbers = NO_NUMBERS if numbers is None else numbers
        self.own_numbers = NO_NUMBERS if own_numbers is None else own_numbers
        self.attempt, self.commit, self.attempt_many = step or Step()
        self.attempt_first, self.commit_first, _ = first or Step()
        self.attempt_second, self.commit_second, _ = second or Step()
        self.__dict__.update(dict.fromkeys(OWN_FUNCTIONS, 0))
        for each in own:
            self.__dict__.update(each.addresses)
        self.table = KIT.table(self)
        self.address = self.table.ctypes.data

    def __getattr__(self, name: str) -> Any:
        return getattr(self.functions, name)


@typeof_impl.register(Kit)
def _type_of_kit(value: Any, context: Any) -> Any:
    return KIT


# indices of callbacks in Functions; w.fault_kind contains the index of the callback that has returned NaN or infinity
MASS, FORCE, CONSTRAINT, JACOBIAN, RATE, GAMMA = (
    Functions._fields.index(kind) for kind in ("mass", "force", "constraint", "jacobian", "constraint_rate", "gamma")
)
NONHOLONOMIC, NONHOLONOMIC_RATE, NONHOLONOMIC_GAMMA = (
    Functions._fields.index(f"nonholonomic{part}") for part in ("", "_rate", "_gamma")
)


@compiled
def finite_vector(x):
    """Return True if all entries of a vector are finite."""
    all_finite = True
    for j in range(x.size):
        all_finite = all_finite and np.isfinite(x[j])
    return all_finite


@compiled
def finite(A):
    """Return True if all entries of a matrix are finite."""
    all_finite = True
    for i in range(A.shape[0]):
        all_finite = all_finite and finite_vector(A[i])
    return all_finite


@compiled
def not_finite(w, kind, t, q):
    """Record t and `kind`, the callback that returned NaN or infinity (-1 if q is not finite); return NOT_FINITE."""
    w.fault_kind = kind if finite_vector(q) else -1.0
    w.fault_time = t
    return NOT_FINITE


@compiled
def faulty_callback(w):
    """Return the index in Functions of a callback with a NaN or infinite result in w; -1: no such result is in w."""
    n_c = w.C.size
    if not finite_vector(w.Rate[:n_c]):
        return RATE
    if not finite_vector(w.Gamma[:n_c]):
        return GAMMA
    if not finite(w.G[n_c:]):
        return NONHOLONOMIC
    if not finite_vector(w.Rate[n_c:]):
        return NONHOLONOMIC_RATE
    if not finite_vector(w.Gamma[n_c:]):
        return NONHOLONOMIC_GAMMA
    return FORCE if not finite_vector(w.Q) else -1


GAP_SLACK = 1e-9  # a step may exceed tolerances[GAP] by this fraction, which counts as a rounding error


@merged
def allowed_error(tolerances, m, x, x1):
    """Return atol + rtol max(|x|, |x1|) for coordinate m (or its velocity), which a step changes from x to x1."""
    return tolerances[ATOL + m] + tolerances[RTOL] * max(abs(x), abs(x1))


TINY = 1e-300  # smallest result of `smallest_size`, which avoids divisions by zero if an absolute tolerance is zero


@merged
def smallest_size(rtol, atol):
    """Return the lower limit of typical sizes of q and v: the smallest atol / rtol of all coordinates, at most 1."""
    size = 1.0
    if rtol > 0.0:
        for each in atol:
            size = min(size, each / rtol)
    return max(size, TINY)


@merged
def limited_size(largest, least):
    """Return the norm `largest`, clipped to [`least`, 1]; 1 if both arguments are 0. `least`: see `smallest_size`."""
    size = min(max(least, largest), 1.0)
    return size if size > TINY else 1.0


@merged
def typical_size(tolerances, x):
    """Return the typical size of x (q or v): max|x_k|, limited by `limited_size`.

    Smaller components count as this size. If it were 1 for a mechanism of 1e-9 m, finite differences would displace q
    by 1e-7 m, and a correction of 1e-14 m would count as rounding. As x may be rounding errors, such as velocities at
    rest, the size is at least `smallest_size`: below it, absolute tolerances exceed relative ones.
    """
    largest = 0.0
    for each in x:
        largest = max(largest, abs(each))
    return limited_size(largest, smallest_size(tolerances[RTOL], tolerances[ATOL:]))


@merged
def max_change_by_rounding(limit, change, change_q, change_v, size_q, size_v):
    """Return the limit up to which the relative change in an iteration, `change`, may be due to rounding.

    `change` is the larger one of change_q / size_q and change_v / size_v. It may be due to rounding if
    change_q / max(size_q, 1) and change_v / max(size_v, 1) are at most the argument `limit`.
    """
    rounded = max(change_q / max(size_q, 1.0), change_v / max(size_v, 1.0))
    return limit * (change / rounded) if rounded > 0.0 else limit


@merged
def is_beyond_gap(tolerances, h):
    """Return True if a step of size h is longer than tolerances[GAP], the longest allowed time between evaluations."""
    return h > tolerances[GAP] * (1.0 + GAP_SLACK)


@merged
def gap_ratio(tolerances, h):
    """Return h / (longest allowed time between evaluations) if a step of size h is rejected as too long, else 0."""
    if tolerances[ESTIMATE] == 1.0 and is_beyond_gap(tolerances, h):
        return h / tolerances[GAP]
    return 0.0
