"""What a system is given: which callbacks, entries and parameters, and what stands for those that are left out."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from twoloop.checks.arguments import Array, check_real, shaped, shown
from twoloop.kernels.compile.callbacks import KINDS, stand_in
from twoloop.kernels.compile.private import Dispatcher
from twoloop.problem.adapters import ConstantMatrix, check_arguments
from twoloop.problem.entries import VALUES_OF, Entries, check_entries
from twoloop.problem.jacobian import differenced_jacobian


def checked_parameters(parameters: Any) -> Array:
    """The parameters as a new vector, or what is wrong with them."""
    p = check_real("parameters", parameters)
    if p.ndim != 1 or not np.isfinite(p).all():
        raise ValueError(f"parameters must be a vector of finite numbers; given {shown(parameters)}")
    return p


def given_callbacks(callbacks: dict[str, Any], n_c: int, n_a: int) -> dict[str, Any]:
    """The callbacks that are given, in the order of KINDS, or what is wrong with their choice."""
    unknown = [kind for kind in callbacks if kind not in KINDS]
    if unknown:
        raise TypeError(f"a system has no argument {unknown[0]!r}; its callbacks are {', '.join(KINDS)}")
    sizes = {"n_c": n_c, "n_a": n_a}
    needed = [kind for kind, entry in KINDS.items() if not entry.optional or sizes.get(entry.needed_by, 0) > 0]
    missing = [kind for kind in needed if kind not in callbacks or (KINDS[kind].optional and callbacks[kind] is None)]
    if callbacks.get("mass_values") is not None:
        missing = [kind for kind in missing if kind != "mass"]
    if missing:
        rows = f" with n_a = {n_a}" if "nonholonomic" in missing else ""
        raise TypeError(f"a system{rows} needs {', '.join(missing)}: not given")
    given = {kind: callbacks[kind] for kind in KINDS if not _is_left_out(kind, callbacks)}
    for kind, entry in KINDS.items():
        if kind in given and sizes.get(entry.shape[0], 1) == 0:
            of = "nonholonomic rows" if entry.shape[0] == "n_a" else "constraints"
            raise ValueError(f"{kind} goes with {of}, {entry.shape[0]} > 0; given for {entry.shape[0]} = 0")
    known = {*given, *(("jacobian",) if "jacobian_values" in given else ())}
    missing = [kind for kind in ("constraint", "jacobian", "gamma") if "kinematics" in given and kind not in known]
    if missing:
        raise ValueError(f"kinematics goes with constraint, jacobian and gamma; {' and '.join(missing)} not given")
    if "force_by_q" not in given and ("force_by_v" in given or "reaction_by_q" in given):
        raise ValueError("force_by_v and reaction_by_q go with force_by_q, which is not given")
    return given


def _is_left_out(kind: str, callbacks: dict[str, Any]) -> bool:
    """Whether a kind is not among callbacks, or as None, or as what stands in its place in another system."""
    entry, given = KINDS[kind], callbacks.get(kind)
    if given is None:
        return kind not in callbacks or entry.optional or kind == "mass"  # in whose place are mass_values
    return entry.optional and entry.absent != "differences" and given is stand_in(kind)


def checked_entries(callbacks: dict[str, Any], n_q: int, n_c: int, mass: Any, jacobian: Any) -> dict[str, Entries]:
    """Where the entries of M and C_q are whose values callbacks give, or what is wrong with them."""
    made: dict[str, Entries] = {}
    for kind, entries, shape in (("mass", mass, (n_q, n_q)), ("jacobian", jacobian, (n_c, n_q))):
        values, name = VALUES_OF[kind], f"{kind}_entries"
        if (callbacks.get(values) is None) != (entries is None):
            given, other = (name, values) if entries is not None else (values, name)
            raise ValueError(f"{values} and {name} go together: {given} is given, and {other} is not")
        if entries is not None:
            made[kind] = check_entries(name, entries, shape, symmetric=kind == "mass")
    return made


class PlainFunctions(NamedTuple):
    """Plain functions by kind, where the entries stand that they give, and which of them take the parameters p."""

    functions: dict[str, Any]
    entries: dict[str, Entries]
    constant_mass: bool
    taking: frozenset[str]
    p: Array


def plain_functions(
    functions: dict[str, Any], sizes: tuple[int, int, int], entries: tuple[Any, Any], parameters: Any, name: str
) -> PlainFunctions:
    """What a system of plain functions is made of, checked; `entries` are those of M and C_q."""
    n_q, n_c, n_a = sizes
    if functions.get("kinematics") is not None:
        raise TypeError(
            "kinematics fills four arrays in place: compile it by @twoloop.callback('kinematics') and give it "
            "with compiled callbacks to ConstrainedSystem(...)"
        )
    functions = given_callbacks(functions, n_c, n_a)
    places = checked_entries(functions, n_q, n_c, *entries)
    of_values = places["mass"][0].shape if "mass" in places else ()
    shapes: dict[str, Any] = {"mass": (n_q, n_q), "mass_values": of_values}
    masses = [kind for kind in shapes if kind in functions]
    constant_mass = not any(callable(functions[kind]) for kind in masses)
    for kind in masses if constant_mass else ():
        matrix = check_real(kind, functions[kind])
        if matrix.shape != shapes[kind]:
            raise ValueError(f"{kind} must have shape {shapes[kind]}; given {shaped(matrix)}")
        functions[kind] = ConstantMatrix(matrix)
    for kind, function in functions.items():
        if not callable(function):
            raise TypeError(f"{kind} must be a function; given {function!r} of type {type(function).__name__}")
    known = parameters is not None
    taking = frozenset(kind for kind, function in functions.items() if check_arguments(kind, function, known))
    p = checked_parameters(() if parameters is None else parameters)
    if known and not taking:
        raise ValueError(
            f"parameters are given, but none of the functions of {name!r} takes them: let those that need them "
            "have p as their last argument, as in mass(t, q, p), or leave parameters out"
        )
    return PlainFunctions(functions, places, constant_mass, taking, p)


def in_place_of(kind: str, given: dict[str, Dispatcher]) -> Dispatcher:
    """The callback that stands in for one that is not given."""
    if KINDS[kind].absent != "differences" or "constraint" not in given:
        return stand_in(kind)
    return differenced_jacobian(given["constraint"])


def callbacks_in(names: Mapping[str, Any]) -> dict[str, Any]:
    """The callbacks of a module, each of which has the name of its kind, for a ConstrainedSystem."""
    return {kind: names[kind] for kind in KINDS if kind in names}
