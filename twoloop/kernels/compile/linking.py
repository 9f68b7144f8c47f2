"""Compile kernels together with their helpers, which get no machine code of their own.

Numba optimises each function together with all that it calls and emits its machine code. So a helper at depth five is
optimised six times, and its own machine code is never called. Here numba passes helpers on as LLVM's intermediate code,
and only the kernel at the top is optimised. Passes of numba's front end (half of the time) that find nothing to do are
left out. Loops are neither unrolled nor vectorised: those of a mechanism are short, and the tests of their length cost
more than they gain.

While a kernel is compiled, `kernel_rules` replaces some of numba's functions; compilations of other functions meanwhile
are not affected. In a kernel no index is negative, so negative indices do not count from the end: the code for this
would hide from LLVM that elements are adjacent. The other rules give the same machine code in less time: half of a
compilation is Python, in which numba computes the same results again and again.

Other modules import the private parts of numba that code generation uses from here.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import copy
from functools import cache
from types import FunctionType
from typing import Any
from weakref import WeakKeyDictionary

from llvmlite import binding
from numba import types
from numba.core import cgutils, event, ir
from numba.core.base import BaseContext
from numba.core.bytecode import FunctionIdentity
from numba.core.codegen import CPUCodeLibrary, JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.cpu import CPUContext
from numba.core.dispatcher import Dispatcher
from numba.core.inline_closurecall import InlineWorker
from numba.core.registry import cpu_target
from numba.core.targetconfig import ConfigStack
from numba.core.typed_passes import InlineOverloads, IRLegalization, NopythonRewrites
from numba.core.types.functions import BaseFunction, Function
from numba.core.untyped_passes import InlineClosureLikes
from numba.np import arrayobj

__all__ = ["Dispatcher", "add_signature", "cgutils", "forget_compiled", "jitable_templates", "options_of"]


def jitable_templates(function: Any) -> list[Any]:
    """Return numba's templates of a function made by `register_jitable`, which each caller compiles again.

    The list is empty for any other function.
    """
    context: Any = cpu_target.typing_context
    if not isinstance(function, FunctionType):
        return []
    context.refresh()  # include functions registered since numba last compiled
    try:
        templates = list(getattr(context.resolve_value_type(function), "templates", ()))
    except ValueError:  # numba does not know the function
        return []
    sources = [getattr(getattr(each, "_overload_func", None), "__closure__", None) for each in templates]
    own = [any(cell.cell_contents is function for cell in source or ()) for source in sources]
    return templates if all(own) else []  # else another implementation may replace the function


def add_signature(function: Dispatcher, signature: Any) -> None:
    """Let a function of one signature be called with another, whose arguments have the same layout in memory."""
    own: Any = function
    (compiled,) = own.overloads.values()
    own._insert([each._code for each in signature.args], compiled.entry_point, False)
    own.overloads[signature.args] = compiled._replace(signature=signature)
    described = copy(compiled.fndesc)  # compiled callers use this description
    described.argtypes = signature.args
    own.targetctx.insert_user_function(compiled.entry_point, described, [compiled.library])


def options_of(helper: Any) -> dict[str, Any]:
    """Return numba's options of a compiled helper, or of a function made by `register_jitable`."""
    return helper.targetoptions if isinstance(helper, Dispatcher) else jitable_templates(helper)[0]._jit_options


def forget_compiled(function: Any) -> None:
    """Make numba compile a function made by `register_jitable` again at its next call."""
    for template in jitable_templates(function):
        template._impl_cache.clear()


_index_from_either_end = arrayobj.fix_integer_index


def _resolve_index(context: Any, builder: Any, kind: Any, index: Any, size: Any) -> Any:
    if kind.signed and isinstance(context.active_code_library, _HelperLibrary | _KernelLibrary):
        return context.cast(builder, index, kind, types.intp)
    return _index_from_either_end(context, builder, kind, index, size)


_any_indexing: Any = arrayobj.basic_indexing


def _indexing(context: Any, builder: Any, kind: Any, array: Any, index_types: Any, indices: Any, **options: Any) -> Any:
    """Return the address of one element of a contiguous array, without the code that only slices need."""
    of_element = len(indices) == kind.ndim and all(isinstance(each, types.Integer) for each in index_types)
    if kind.layout != "C" or not of_element or options.get("boundscheck"):
        return _any_indexing(context, builder, kind, array, index_types, indices, **options)
    sizes = cgutils.unpack_tuple(builder, array.shape, kind.ndim)
    given = zip(index_types, indices, sizes, strict=True)
    places = [arrayobj.fix_integer_index(context, builder, *each) for each in given]
    return cgutils.get_item_pointer2(context, builder, array.data, sizes, None, "C", places), [], []


_plain_call_type: Any = BaseFunction.get_call_type
_call_types: dict[Any, tuple[Any, Any]] = {}
# options and their texts by id; the options are stored so that no other object gets their id
_options: dict[int, tuple[Any, str]] = {}


def _text_of(options: Any) -> str:
    if id(options) not in _options:
        _options[id(options)] = options, repr(options and options._values)
    return _options[id(options)][1]


def _call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
    """Return the signature of a call of one of numba's functions, cached for the same types and options.

    Without the cache numba tries all implementations of an operator at each call, a tenth of a compilation.
    """
    key = self, args, tuple(kws.items()), _text_of(ConfigStack.top_or_none())
    if key not in _call_types:
        signature = _plain_call_type(self, context, args, kws)
        _call_types[key] = signature, self._impl_keys[signature.args]
    signature, self._impl_keys[signature.args] = _call_types[key]
    return signature


_compute_size: Any = BaseContext.get_abi_sizeof
_sizes: dict[str, int] = {}


def _size_of(self: Any, kind: Any) -> Any:
    """Return the size of a type, cached, because numba has LLVM parse a module for each variable."""
    name = str(kind)
    if name not in _sizes:
        _sizes[name] = _compute_size(self, kind)
    return _sizes[name]


_inlined_passes: Any = InlineWorker.run_untyped_passes
_inlined: dict[Any, Any] = {}


def _inlined_code(self: Any, function: Any, enable_ssa: bool = False) -> Any:
    """Return the cached code of an inlined function, which numba would analyse again at each call."""
    if (function, enable_ssa) not in _inlined:
        _inlined[function, enable_ssa] = _inlined_passes(self, function, enable_ssa)
    self.flags.enable_ssa = enable_ssa
    code = copy(_inlined[function, enable_ssa])
    code.func_id = FunctionIdentity.from_function(function)  # variables get their names from it
    return code


_LEAF_TYPES = {ir.Loc, str, int, bool, type(None)}  # types within a statement that contain no variables


def _variables(self: Any, held: Any) -> list[Any]:
    """Return the variables of a statement; numba's version is slower because it calls a function for each part."""
    if isinstance(held, ir.Var):
        return [held]
    if isinstance(held, ir.Inst):
        return held.list_vars()  # type: ignore[no-any-return]
    found: list[Any] = []
    if isinstance(held, (dict, list, tuple)):
        for each in held.values() if isinstance(held, dict) else held:
            if type(each) is ir.Var:
                found.append(each)
            elif type(each) not in _LEAF_TYPES:
                found += _variables(self, each)
    return found


_load_registries: Any = CPUContext.load_additional_registries


def _load_registries_once(self: Any) -> None:
    """Install numba's implementations of Python's and NumPy's functions, which numba imports again for each function.

    All copies of a context share the registries; a new intrinsic is added to one of these.
    """
    if self._registries:
        for registry in list(self._registries):
            self.install_registry(registry)
    else:
        _load_registries(self)


_LOCKS = ("numba:llvm_lock", "numba:compiler_lock")


def _ignoring_locks(tell: Any) -> Any:
    """Report events, but not those of locks: there are thousands for each kernel, and numba sums the times of all."""
    return lambda kind, *args, **named: None if kind in _LOCKS else tell(kind, *args, **named)


# owner, name and replacement of each of numba's functions
_RULES: list[tuple[Any, str, Callable[..., Any]]] = [
    (Function, "get_call_type", _call_type),
    (arrayobj, "fix_integer_index", _resolve_index),
    (arrayobj, "basic_indexing", _indexing),
    (BaseContext, "get_abi_sizeof", _size_of),
    (InlineWorker, "run_untyped_passes", _inlined_code),
    (ir.Inst, "_rec_list_vars", _variables),
    (CPUContext, "load_additional_registries", _load_registries_once),
    (event, "start_event", _ignoring_locks(event.start_event)),
    (event, "end_event", _ignoring_locks(event.end_event)),
]
_NONE = object()
_depth = [0]  # number of nested compilations of kernels


@contextmanager
def kernel_rules() -> Iterator[None]:
    """Replace numba's functions by these rules while a kernel is compiled."""
    if _depth[0] == 0:
        before = [vars(owner).get(name, _NONE) for owner, name, _ in _RULES]
        for owner, name, rule in _RULES:
            setattr(owner, name, rule)
    _depth[0] += 1
    try:
        yield
    finally:
        _depth[0] -= 1
        if _depth[0] == 0:
            for (owner, name, _), numbas in zip(_RULES, before, strict=True):
                if numbas is _NONE:
                    delattr(owner, name)
                else:
                    setattr(owner, name, numbas)


class _WithoutEnvironment:
    """Code generator for code that is never loaded, so that its environment has no address."""

    def __init__(self, codegen: Any):
        self._codegen = codegen

    def __getattr__(self, name: str) -> Any:
        return getattr(self._codegen, name)

    def set_env(self, name: str, environment: Any) -> None:
        """Ignore the environment."""


class _HelperLibrary(CPUCodeLibrary):
    """Code of a helper, to be linked into its callers."""

    @property
    def codegen(self) -> Any:
        return _WithoutEnvironment(self._codegen)

    def get_pointer_to_function(self, name: str) -> int:
        return 0

    def _optimize_final_module(self) -> None:
        pass  # its callers optimise it

    def _get_module_for_linking(self) -> Any:
        """Return the code itself instead of a copy, because nothing else uses it."""
        if self._shared_module is None:
            self._ensure_finalized()
            for function in self._final_module.functions:
                if not function.is_declaration and function.linkage == binding.Linkage.external:
                    function.linkage = "linkonce_odr"
            self._shared_module = self._final_module
        return self._shared_module

    def _finalize_final_module(self) -> None:
        self._finalized = True


class _KernelLibrary(JITCodeLibrary):
    """Code of a kernel and of all that it calls."""

    vectorized = False

    def _optimize_final_module(self) -> None:
        options = binding.create_pipeline_tuning_options(speed_level=3 if self.vectorized else 2)
        options.loop_vectorization = options.slp_vectorization = options.loop_unrolling = self.vectorized
        builder = binding.create_pass_builder(self._codegen._tm, options)
        builder.getModulePassManager().run(self._final_module, builder)


class _VectorizedLibrary(_KernelLibrary):
    """Code of a kernel whose loops are worth vectorizing."""

    vectorized = True


# passes that find nothing to do in kernels: functions within functions; expressions of whole arrays, as none is
# allocated; overloads that replace calls before lowering; code that a compiled function cannot contain
_SKIPPED_PASSES = {InlineClosureLikes, NopythonRewrites, InlineOverloads, IRLegalization}


class _Compiler(Compiler):
    """Numba's compiler without the passes that kernels do not need."""

    def define_pipelines(self) -> list[Any]:
        """Return the passes."""
        pipelines: list[Any] = super().define_pipelines()
        for pipeline in pipelines:
            pipeline.passes = [each for each in pipeline.passes if each[0] not in _SKIPPED_PASSES]
        return pipelines


class HelperCompiler(_Compiler):
    """Compile a function that only compiled functions call; a call from Python would crash."""

    def __init__(self, typing_context: Any, target_context: Any, library: Any, *others: Any):
        super().__init__(typing_context, target_context, _HelperLibrary(target_context.codegen(), "helper"), *others)


class KernelCompiler(_Compiler):
    """Compile a function and optimise it together with its helpers, once."""

    library: type[_KernelLibrary] = _KernelLibrary

    def __init__(self, typing_context: Any, target_context: Any, library: Any, *others: Any):
        library = self.library(target_context.codegen(), "kernel")
        library.enable_object_caching()
        super().__init__(typing_context, target_context, library, *others)

    def compile_extra(self, function: Any) -> Any:
        """Compile a function and all that it calls."""
        with kernel_rules():
            return super().compile_extra(function)


class VectorizingCompiler(KernelCompiler):
    """Compile a kernel whose loops are long enough to be unrolled and vectorised."""

    library = _VectorizedLibrary


@cache
def entry_point(function: Dispatcher) -> Any:
    """Return the function that Python calls for a compiled function, without the check of argument types.

    That check costs as much as two steps of a small mechanism; the caller has to pass the right types.
    """
    compiled: Any = next(iter(function.overloads.values()))
    return compiled.entry_point


# addresses of compiled functions, each with one signature
_ADDRESSES: WeakKeyDictionary[Dispatcher, int] = WeakKeyDictionary()


def machine_code(function: Dispatcher, signature: Any) -> int:
    """Return the address of a compiled function; arguments and errors are passed by numba's calling convention."""
    if function not in _ADDRESSES:
        compiled: Any = function.overloads.get(signature.args) or function.get_compile_result(signature)
        _ADDRESSES[function] = int(compiled.library.get_pointer_to_function(compiled.fndesc.llvm_func_name))
    return _ADDRESSES[function]
