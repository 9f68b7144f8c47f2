"""Compile each kernel together with its helpers; no machine code is emitted for helpers alone.

A kernel is a compiled function with its own machine code, which Python can call; only compiled functions call helpers.
By default, numba optimises each function together with all functions that it calls, and emits machine code for each. So
a helper at depth five would be optimised six times, and the machine code for the helper alone would never be called.
Here, helpers remain LLVM's intermediate code, and only kernels are optimised. Passes of numba's front end that find
nothing to do in kernels, but take half of its time, are skipped. Loops are neither unrolled nor vectorised, unless a
kernel requests it: most loops in kernels are short, so that tests of their length would cost more than is gained.

While a kernel is compiled, `kernel_rules` replaces some functions of numba. One replacement leaves out the code for
negative indices, which kernels do not use: this code would hide from LLVM that elements are adjacent. Functions of
the user keep this code. The other replacements make compilation faster: they cache results that numba would compute
again and again, or do the same work with less code.

Modules that need private parts of numba to generate code import these parts from this module.
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

__all__ = ["Dispatcher", "add_signature", "cgutils", "discard_compiled_code", "jitable_templates", "options_of"]


def jitable_templates(function: Any) -> list[Any]:
    """Return numba's templates (typing rules) of a function decorated by `register_jitable`; [] for other values."""
    context: Any = cpu_target.typing_context
    if not isinstance(function, FunctionType):
        return []
    context.refresh()  # include functions registered since numba last compiled
    try:
        templates = list(getattr(context.resolve_value_type(function), "templates", ()))
    except ValueError:  # numba cannot compile calls of this function
        return []
    closures = [getattr(getattr(each, "_overload_func", None), "__closure__", None) for each in templates]
    is_own = [any(cell.cell_contents is function for cell in source or ()) for source in closures]
    return templates if all(is_own) else []  # []: an `overload` replaces `function` in compiled code


def add_signature(function: Dispatcher, signature: Any) -> None:
    """Let numba call a compiled function also with the argument types of `signature`, without compiling it again.

    In memory, the types must be like the compiled ones: for example, writable arrays are like read-only arrays.
    """
    dispatcher: Any = function
    (compiled,) = dispatcher.overloads.values()
    dispatcher._insert([each._code for each in signature.args], compiled.entry_point, False)
    dispatcher.overloads[signature.args] = compiled._replace(signature=signature)
    description = copy(compiled.fndesc)  # from this, numba reads the argument types to compile calls of the function
    description.argtypes = signature.args
    dispatcher.targetctx.insert_user_function(compiled.entry_point, description, [compiled.library])


def options_of(helper: Any) -> dict[str, Any]:
    """Return the options with which numba compiles a helper (decorated by `njit` or `register_jitable`)."""
    return helper.targetoptions if isinstance(helper, Dispatcher) else jitable_templates(helper)[0]._jit_options


def discard_compiled_code(function: Any) -> None:
    """Discard numba's code of a function decorated by `register_jitable`, for example because its globals changed."""
    for template in jitable_templates(function):
        template._impl_cache.clear()


_numba_fix_index = arrayobj.fix_integer_index


def _emit_index(context: Any, builder: Any, kind: Any, index: Any, size: Any) -> Any:
    """Emit code that computes an array index; in kernels and helpers, without the code for negative indices."""
    if kind.signed and isinstance(context.active_code_library, _HelperLibrary | _KernelLibrary):
        return context.cast(builder, index, kind, types.intp)
    return _numba_fix_index(context, builder, kind, index, size)


_numba_basic_indexing: Any = arrayobj.basic_indexing


def _emit_element_address(
    context: Any, builder: Any, kind: Any, array: Any, index_types: Any, indices: Any, **options: Any
) -> Any:
    """Emit code for the address of an element of a contiguous array; for slices or other arrays, use numba's code."""
    is_element = len(indices) == kind.ndim and all(isinstance(each, types.Integer) for each in index_types)
    if kind.layout != "C" or not is_element or options.get("boundscheck"):
        return _numba_basic_indexing(context, builder, kind, array, index_types, indices, **options)
    sizes = cgutils.unpack_tuple(builder, array.shape, kind.ndim)
    index_arguments = zip(index_types, indices, sizes, strict=True)
    final_indices = [arrayobj.fix_integer_index(context, builder, *each) for each in index_arguments]
    return cgutils.get_item_pointer2(context, builder, array.data, sizes, None, "C", final_indices), [], []


_numba_call_type: Any = BaseFunction.get_call_type
_call_signatures: dict[Any, tuple[Any, Any]] = {}
# keys: id of an object with options of numba; values: (object, its text); the object is kept so that its id is unique
_option_texts: dict[int, tuple[Any, str]] = {}


def _options_text(options: Any) -> str:
    """Return numba's options of a compilation as text, from a cache; `_cached_call_type` uses the text in its keys."""
    if id(options) not in _option_texts:
        _option_texts[id(options)] = options, repr(options and options._values)
    return _option_texts[id(options)][1]


def _cached_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
    """Return numba's signature of a call; the cache of signatures saves a tenth of the time of compilation."""
    key = self, args, tuple(kws.items()), _options_text(ConfigStack.top_or_none())
    if key not in _call_signatures:
        signature = _numba_call_type(self, context, args, kws)
        _call_signatures[key] = signature, self._impl_keys[signature.args]
    signature, self._impl_keys[signature.args] = _call_signatures[key]
    return signature


_numba_type_size: Any = BaseContext.get_abi_sizeof
_type_sizes: dict[str, int] = {}


def _cached_type_size(self: Any, kind: Any) -> Any:
    """Return the size (bytes) of an LLVM type, from a cache: numba would let LLVM parse a module for each variable."""
    name = str(kind)
    if name not in _type_sizes:
        _type_sizes[name] = _numba_type_size(self, kind)
    return _type_sizes[name]


_numba_inlined_passes: Any = InlineWorker.run_untyped_passes
_inlined_code: dict[Any, Any] = {}


def _cached_inlined_code(self: Any, function: Any, enable_ssa: bool = False) -> Any:
    """Return numba's intermediate code of an inlined function from a cache; numba would analyse each call anew."""
    if (function, enable_ssa) not in _inlined_code:
        _inlined_code[function, enable_ssa] = _numba_inlined_passes(self, function, enable_ssa)
    self.flags.enable_ssa = enable_ssa
    code = copy(_inlined_code[function, enable_ssa])
    code.func_id = FunctionIdentity.from_function(function)  # so that variables of each copy have their own names
    return code


_LEAF_TYPES = {ir.Loc, str, int, bool, type(None)}  # types of those parts of a statement that contain no variables


def _variables_of_statement(self: Any, part: Any) -> list[Any]:
    """Return the variables in a statement, or part of it, of numba's intermediate code, as numba does, but faster."""
    if isinstance(part, ir.Var):
        return [part]
    if isinstance(part, ir.Inst):
        return part.list_vars()  # type: ignore[no-any-return]
    variables: list[Any] = []
    if isinstance(part, (dict, list, tuple)):
        for each in part.values() if isinstance(part, dict) else part:
            if type(each) is ir.Var:
                variables.append(each)
            elif type(each) not in _LEAF_TYPES:
                variables += _variables_of_statement(self, each)
    return variables


_numba_load_registries: Any = CPUContext.load_additional_registries


def _load_registries_once(self: Any) -> None:
    """Install numba's implementations of Python and NumPy functions in a context; import them only once."""
    if self._registries:
        for registry in list(self._registries):
            self.install_registry(registry)
    else:
        _numba_load_registries(self)


_LOCK_EVENTS = ("numba:llvm_lock", "numba:compiler_lock")  # kinds of events by which numba reports that it takes a lock


def _skip_lock_events(report: Any) -> Any:
    """Return a function that passes events to `report`, except those of locks: each kernel causes thousands of them."""
    return lambda kind, *args, **named: None if kind in _LOCK_EVENTS else report(kind, *args, **named)


# functions of numba that `kernel_rules` replaces: class or module, name of its attribute, replacement
_RULES: list[tuple[Any, str, Callable[..., Any]]] = [
    (Function, "get_call_type", _cached_call_type),
    (arrayobj, "fix_integer_index", _emit_index),
    (arrayobj, "basic_indexing", _emit_element_address),
    (BaseContext, "get_abi_sizeof", _cached_type_size),
    (InlineWorker, "run_untyped_passes", _cached_inlined_code),
    (ir.Inst, "_rec_list_vars", _variables_of_statement),
    (CPUContext, "load_additional_registries", _load_registries_once),
    (event, "start_event", _skip_lock_events(event.start_event)),
    (event, "end_event", _skip_lock_events(event.end_event)),
]
_MISSING_ATTRIBUTE = object()  # original value of an inherited attribute, whose replacement will simply be deleted
_depth = [0]  # number of active contexts `kernel_rules`; only the outermost one replaces and restores functions


@contextmanager
def kernel_rules() -> Iterator[None]:
    """Return a context in which numba uses the replacements in `_RULES`; kernels are compiled in it."""
    if _depth[0] == 0:
        originals = [vars(owner).get(name, _MISSING_ATTRIBUTE) for owner, name, _ in _RULES]
        for owner, name, rule in _RULES:
            setattr(owner, name, rule)
    _depth[0] += 1
    try:
        yield
    finally:
        _depth[0] -= 1
        if _depth[0] == 0:
            for (owner, name, _), original in zip(_RULES, originals, strict=True):
                if original is _MISSING_ATTRIBUTE:
                    delattr(owner, name)
                else:
                    setattr(owner, name, original)


class _CodegenWithoutEnvironment:
    """Numba's code generator for helpers, which are not loaded, and need no environment (Python data of a function)."""

    def __init__(self, codegen: Any):
        self._codegen = codegen

    def __getattr__(self, name: str) -> Any:
        return getattr(self._codegen, name)

    def set_env(self, name: str, environment: Any) -> None:
        """Do nothing: only functions that Python calls need this environment (their Python data)."""


class _HelperLibrary(CPUCodeLibrary):
    """LLVM's intermediate code of a helper (called by compiled functions only), to be linked into its callers."""

    @property
    def codegen(self) -> Any:
        return _CodegenWithoutEnvironment(self._codegen)

    def get_pointer_to_function(self, name: str) -> int:
        return 0  # no address, because Python never calls a helper

    def _optimize_final_module(self) -> None:
        pass  # the code of a helper is optimised as part of its callers

    def _get_module_for_linking(self) -> Any:
        """Return the module to link into callers; numba would return a copy, but nothing else uses this module."""
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
    """Machine code of a kernel and of all functions that it calls."""

    vectorized = False

    def _optimize_final_module(self) -> None:
        options = binding.create_pipeline_tuning_options(speed_level=3 if self.vectorized else 2)
        options.loop_vectorization = options.slp_vectorization = options.loop_unrolling = self.vectorized
        builder = binding.create_pass_builder(self._codegen._tm, options)
        builder.getModulePassManager().run(self._final_module, builder)


class _VectorizedLibrary(_KernelLibrary):
    vectorized = True


# passes of numba that are skipped: they treat nested functions, expressions of whole arrays, inlined overloads, and
# code that is not allowed in compiled functions, none of which kernels contain
_SKIPPED_PASSES = {InlineClosureLikes, NopythonRewrites, InlineOverloads, IRLegalization}


class _Compiler(Compiler):
    """Numba's compiler without the passes in _SKIPPED_PASSES."""

    def define_pipelines(self) -> list[Any]:
        pipelines: list[Any] = super().define_pipelines()
        for pipeline in pipelines:
            pipeline.passes = [each for each in pipeline.passes if each[0] not in _SKIPPED_PASSES]
        return pipelines


class HelperCompiler(_Compiler):
    """Compile a helper, which only compiled functions may call; a call from Python would crash the process."""

    def __init__(self, typing_context: Any, target_context: Any, library: Any, *others: Any):
        super().__init__(typing_context, target_context, _HelperLibrary(target_context.codegen(), "helper"), *others)


class KernelCompiler(_Compiler):
    """Compile a kernel; optimise it once, together with all helpers that it calls."""

    library: type[_KernelLibrary] = _KernelLibrary

    def __init__(self, typing_context: Any, target_context: Any, library: Any, *others: Any):
        library = self.library(target_context.codegen(), "kernel")
        library.enable_object_caching()
        super().__init__(typing_context, target_context, library, *others)

    def compile_extra(self, function: Any) -> Any:
        with kernel_rules():
            return super().compile_extra(function)


class VectorizingCompiler(KernelCompiler):
    """Compile a kernel with long loops, which are unrolled and vectorised."""

    library = _VectorizedLibrary


@cache
def entry_point(function: Dispatcher) -> Any:
    """Return the function by which Python calls the machine code of a compiled function without checks of types.

    These checks would take as long as two steps of a small mechanism. Arguments of wrong types crash the process.
    """
    compiled: Any = next(iter(function.overloads.values()))
    return compiled.entry_point


# addresses of machine code; a compiled function has only one, because it is compiled for one signature only
_ADDRESSES: WeakKeyDictionary[Dispatcher, int] = WeakKeyDictionary()


def machine_code_address(function: Dispatcher, signature: Any) -> int:
    """Return the address of a compiled function's machine code, for calls by numba's internal calling convention."""
    if function not in _ADDRESSES:
        compiled: Any = function.overloads.get(signature.args) or function.get_compile_result(signature)
        _ADDRESSES[function] = int(compiled.library.get_pointer_to_function(compiled.fndesc.llvm_func_name))
    return _ADDRESSES[function]
