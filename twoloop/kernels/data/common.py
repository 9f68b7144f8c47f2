"""Define what all kernels share: types, compiling decorators, the workspace, the table of callbacks, tolerances.

Each kind of callback has a fixed signature, and writes its results into an argument. So the integrator is compiled
once, and receives the functions of any mechanism and any method as arguments. Arguments have the same names in all
kernels: `f` is the `Kit` (the functions and constant data of a system and a method), `w` the workspace `Work` (the
arrays that kernels write), `t` the time and `h` a step size in s.
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
INTEGERS_32 = types.int32[::1]  # for long programs, which fit in the processor's cache as 32-bit integers

# names of the programs in `Functions`: programs that replace missing callbacks (evaluation/operations.py), and programs
# for sparse factors of large systems (linalg/symbolic_factorization.py, sparse_lu.py). A missing program has size 0
PROGRAMS = "jacobian_program", "jacobian_numbers", "gamma_program", "gamma_numbers", "ldl_program", "newton_program"
# the callbacks of a mechanism, its parameters, its flags and its programs
Functions: Any = namedtuple("Functions", [*KINDS, "p", "flags", *PROGRAMS])  # type: ignore[misc]


class Work(NamedTuple):
    """Arrays that an evaluation writes; allocated once per run.

    Sizes: n_q coordinates; n_c rows of C_q and n_a rows of A; r independent rows in C_q, r_v in C_q and A together;
    n_dof = n_q - r_v. Fields that end in _v belong to velocities; without rows of A, they are the arrays for positions.
    """

    M: Any  # (n_q, n_q) mass matrix
    L: Any  # (n_q, n_q) inverse of M if M is constant, else the factors of M, dense (see ldl_factor) or banded
    G: Any  # (n_c + n_a + 1, n_q) C_q and A at the last position, and a row of zeros
    entries: Any  # view of `G` as a vector
    augmented: Any  # view of the memory of `G` and, after it, of `M`
    S: Any  # (r_v, r_v) G M^-1 G^T for the independent rows of G, which is overwritten by its factors
    W: Any  # (r_v, n_q) G M^-1 for the independent rows of G
    A: Any  # (n_dof, n_dof) T^T M T (T: null space of G), overwritten by its factors; empty where S is used
    MT: Any  # (n_q, n_dof) M T
    D: Any  # (n_dof + 1, r_v) -(G_d^-1 G_i)^T; last row: dependent velocities for v_i = 0; columns in elimination order
    Gx: Any  # (n_c + n_a, n_q) C_q and A at a displaced position (for Gamma by differences); scratch for full pivoting
    G_of_S: Any  # (n_c + n_a, n_q) the G that was used to compute S and W, for constant M; NaN: none yet
    pattern: Any  # (n_c + n_a, n_q) 1 for entries of G that have been nonzero, else 0
    mass_pattern: Any  # (n_q, n_q) 1 for entries of M that have been nonzero, else 0; empty without the augmented form
    row_entries: Any  # (n_c + n_a + 1) where each row's list begins, then the lists: columns of nonzero entries of G
    Gamma_tried: Any  # (2, n_c + n_a) Gamma by differences: with twice the time step, and with the previous time step
    rates: Any  # (13, n_c + n_a) C_t and b at times within a step, see discontinuities.py
    changes: Any  # (N_CHANGES, n_q + n_c + n_a) samples of forces, C_t and b at later times, see discontinuities.py
    Q: Any  # (n_q) force
    x: Any  # (n_q) scratch
    y: Any  # (n_q) scratch
    C: Any  # (n_c) C(t, q); also scratch for corrections
    Rate: Any  # (n_c + n_a) C_t and b
    Gamma: Any  # (n_c + n_a) right-hand side of G a = Gamma
    g: Any  # (n_c + n_a) scratch
    z: Any  # (r_v) scratch
    lam: Any  # (n_c + n_a) scratch for multipliers that the caller does not need
    minimum: Any  # scratch for the multipliers of least norm, see saddle_point.py
    rows: Any  # (r) indices of the independent rows of C_q
    dependent: Any  # (r) indices of the dependent coordinates
    independent: Any  # (n_q - r) indices of the independent coordinates
    index: Any  # program that factors C_qd, see markowitz_lu.py
    values: Any  # the factors of C_qd
    rows_v: Any  # (r_v) indices of the independent rows of G
    dependent_v: Any  # (r_v) indices of the dependent velocities
    independent_v: Any  # (n_dof) indices of the independent velocities
    index_v: Any  # program that factors G_d
    values_v: Any  # the factors of G_d
    index_a: Any  # program that factors the augmented matrix; index_a[SIZE] is 0 until the program is written
    values_a: Any  # the factors of the augmented matrix; empty in other forms
    right: Any  # (2 (n_q + r_v)) right-hand side for the augmented matrix, and scratch
    order: Any  # (n_q) scratch: order of the columns in full pivoting
    row_order: Any  # (n_c + n_a) scratch: order of the rows in full pivoting
    counters: Any  # (N_COUNTERS) numbers of steps, iterations and evaluations in the run, see indices.py
    lapack: Any  # addresses of band.ROUTINES; 0 where linear algebra is dense
    predicted: Any  # (r) dependent positions predicted by the integration formula, before they are projected
    notes: Any  # (N_NOTES) values that one kernel stores for another, see indices.py
    nodes: Any  # results of the operations of a traced program
    matrices: Any  # matrices of Newton's method, see steps/stages.py and steps/newton_systems.py
    # the fields from here to `solutions` belong to the fixed-order form, and are empty in other forms; N is n_q + n_c
    mass_values: Any  # entries of M, see linalg/symbolic_factorization.py
    jacobian_values: Any  # entries of G
    is_independent: Any  # (n_c) 1 for independent rows, else 0
    factors: Any  # entries of the factors, at the indices that the program gives
    pivot_sizes: Any  # (N) squared norms of the rows, for a comparison with pivots, see linalg/sparse_ldl.py
    unknowns: Any  # (N) right-hand side on entry to a solver, solution on return
    solutions: Any  # (3 N) scratch, then (n_c) factors s of rows g that are added to M as s g g^T, see sparse_ldl.py

    sizes: Any = None  # sizes of the arrays, see `Sizes` in layout.py
    address: Any = 0  # address of `table`
    table: Any = None  # addresses and shapes of the arrays above, for kernels


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
    error : error in units of the tolerances: the step is accepted if it is at most 1. If a step is longer than the
        method allows, the step is not computed, and `error` is the ratio of its size to the allowed size.
    factor : ratio of the next step size to the size of this step; 0: the controller computes the ratio from the error.
        If both factor and error exceed 1, the step size was a guess: the step has to be repeated with a larger size.
    """

    code: int
    error: float
    factor: float


class Step(NamedTuple):
    """Compiled functions of a method: `attempt` computes a step, `commit` accepts or discards the step in `memory`.

    `many` computes several steps in one call, and is None if the method has no such function.
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
# signature of an inner loop: (kit, work, task, t, q, v, tolerance, a, lam) -> code, see inner_loop.py
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

# functions generated for a mechanism, see generate/elimination.py and collocation_code.py. Functions with a boolean
# result return False, and write no results, if a condition of the generated code is not satisfied
OWN_FUNCTIONS = {
    # functions of a state, with arguments (t, q, v, numbers) and then arrays for the results. own_accelerate
    # stores a; own_correct_positions stores the correction and the corrected q; own_project stores a, the correction of
    # q, the corrected q and v, and lam; own_redundant stores nothing, but checks that redundant rows are satisfied
    "own_accelerate": types.boolean(f8, VECTOR, VECTOR, VECTOR, VECTOR),
    "own_correct_positions": types.boolean(f8, VECTOR, VECTOR, VECTOR, VECTOR, VECTOR),
    "own_project": types.boolean(f8, *[VECTOR] * 8),
    "own_redundant": types.boolean(f8, VECTOR, VECTOR, VECTOR, VECTOR),
    # functions of collocation; their first argument is the memory described in data/collocation.py. attempt_nodes
    # (memory, state, tolerances, numbers) returns how the iteration ended, audit_nodes (memory, state, numbers) the
    # defect between nodes. The others return nothing: retry_nodes (memory, state), end_nodes (memory, state,
    # new_state), correct_ends and project_ends (memory, numbers)
    "attempt_nodes": f8(*[VECTOR] * 4),
    "audit_nodes": f8(*[VECTOR] * 3),
    "retry_nodes": types.none(*[VECTOR] * 2),
    "end_nodes": types.none(*[VECTOR] * 3),
    "correct_ends": types.none(*[VECTOR] * 2),
    "project_ends": types.none(*[VECTOR] * 2),
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
    """Return the names of the modules of the kernels that a source text imports, such as "steps.stages"."""
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
    """Return a digest of the callback signatures and of the sources of a module and of all modules that it imports.

    `module`: name below twoloop.kernels, such as "steps.stages".
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
    """Return the name of the module that defines a kernel, such as "steps.stages"."""
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


# options of numba for all kernels. "fastmath" lacks "nnan" and "ninf", so that NaN and infinity are respected.
# `_nrt` = False excludes numba's runtime: code that allocates arrays does not compile, and arrays have no reference
# counts, which would take a third of the time of an evaluation of the four-bar
OPTIONS: dict[str, Any] = {
    "error_model": "numpy",
    "fastmath": {"contract", "reassoc", "nsz", "arcp"},
    "nogil": True,
    "_nrt": False,
}


def _helper_decorator(**options: Any) -> Callable[[Callable[..., Any]], Dispatcher]:
    """Return a decorator that compiles helpers: functions that kernels call, but not Python."""
    wrappers = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return njit(**{**OPTIONS, **wrappers, "pipeline_class": HelperCompiler, **options})


# forceinline is always set explicitly, because a callee inherits the flags of its caller: otherwise, all helpers that a
# merged helper calls would be merged, too
exact = _helper_decorator(fastmath=False, forceinline=False)  # keeps the order of floating-point operations
compiled = _helper_decorator(forceinline=False)  # compiled as one function, which LLVM inlines only if it is short
inlined = _helper_decorator(inline="always")  # inlined by numba; only a helper of this kind can return views of arrays
# inlined by LLVM: each call becomes a copy of the code. For short helpers, and for helpers used in every evaluation
merged = _helper_decorator(forceinline=True)


NO_NUMBERS = np.zeros(0)  # data for generated functions that read no data


class Kit:
    """Functions and data of a system and a method, passed to kernels as one reference.

    `functions` are the callbacks, `inner` is the inner loop, and `step` has the functions of the method, or None if no
    kernel calls them. Kernels call inner loop and step by their addresses, without compiling them again. `first` and
    `second` are the methods of a pair of methods. `own` contains the functions generated for the mechanism; an inner
    loop that calls them leaves tasks without such a function to `general`, the inner loop of any mechanism. `numbers`
    are the data of the generated functions, and `own_numbers` the data of the collocation functions.
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


# indices of callbacks in Functions, which are the values of FAULT_KIND in Work.notes
MASS, FORCE, CONSTRAINT, JACOBIAN, RATE, GAMMA = (
    Functions._fields.index(kind) for kind in ("mass", "force", "constraint", "jacobian", "constraint_rate", "gamma")
)
NONHOLONOMIC, NONHOLONOMIC_RATE, NONHOLONOMIC_GAMMA = (
    Functions._fields.index(f"nonholonomic{part}") for part in ("", "_rate", "_gamma")
)


@compiled
def finite_vector(x):
    """Return whether all entries of a vector are finite."""
    all_finite = True
    for j in range(x.size):
        all_finite = all_finite and np.isfinite(x[j])
    return all_finite


@compiled
def finite(A):
    """Return whether all entries of a matrix are finite."""
    all_finite = True
    for i in range(A.shape[0]):
        all_finite = all_finite and finite_vector(A[i])
    return all_finite


@compiled
def not_finite(w, kind, t, q):
    """Store in w the time t and the kind of the callback whose value is not finite (-1: q itself); return a code."""
    w.fault_kind = kind if finite_vector(q) else -1.0
    w.fault_time = t
    return NOT_FINITE


@compiled
def faulty_callback(w):
    """Return the index in Functions of the callback that makes accelerations not finite; -1: unknown."""
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


GAP_SLACK = 1e-9  # a step size may exceed GAP by this fraction of GAP, which counts as a rounding error


@merged
def allowed_error(tolerances, m, x, x1):
    """Return the allowed error of coordinate m, or of its velocity, in a step that changes its value from x to x1."""
    return tolerances[ATOL + m] + tolerances[RTOL] * max(abs(x), abs(x1))


@merged
def is_beyond_gap(tolerances, h):
    """Return whether a step of size h is longer than tolerances[GAP]."""
    return h > tolerances[GAP] * (1.0 + GAP_SLACK)


@merged
def gap_ratio(tolerances, h):
    """Return h / tolerances[GAP] if a step of size h is too long; 0 if it is not, or if the step size is fixed."""
    if tolerances[ESTIMATE] == 1.0 and is_beyond_gap(tolerances, h):
        return h / tolerances[GAP]
    return 0.0
