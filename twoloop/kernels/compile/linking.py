"""How the kernels are compiled: helpers not on their own, but within the kernels that call them.

Numba optimises each function together with all that it calls and makes machine code of it, so that a helper at depth
five is optimised six times, and its machine code is made without ever being called. Here helpers are handed on as
LLVM's intermediate code, and the kernel at the top is optimised once. Numba's front end, half of the time, leaves out
what finds nothing to do. Loops are neither unrolled nor vectorised: those
of a mechanism are short, and the code that tests whether they are costs more than it gains.
"""

from functools import cache
from typing import Any
from weakref import WeakKeyDictionary

from llvmlite import binding
from numba.core.codegen import CPUCodeLibrary, JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.dispatcher import Dispatcher
from numba.core.typed_passes import InlineOverloads, IRLegalization, NopythonRewrites
from numba.core.untyped_passes import InlineClosureLikes

from twoloop.kernels.compile.own_rules import of_kernels, own_rules


class _WithoutEnvironment:
    """The code generator for code that is not loaded: there is no place for the address of its environment."""

    def __init__(self, codegen: Any):
        self._codegen = codegen

    def __getattr__(self, name: str) -> Any:
        return getattr(self._codegen, name)

    def set_env(self, name: str, environment: Any) -> None:
        """Nothing to set."""


@of_kernels
class _Linked(CPUCodeLibrary):
    """The code of a helper, to be linked into its callers."""

    @property
    def codegen(self) -> Any:
        return _WithoutEnvironment(self._codegen)

    def get_pointer_to_function(self, name: str) -> int:
        return 0

    def _optimize_final_module(self) -> None:
        pass  # its callers do

    def _get_module_for_linking(self) -> Any:
        """The code as it is, which nothing else uses: numba links a copy."""
        if self._shared_module is None:
            self._ensure_finalized()
            for function in self._final_module.functions:
                if not function.is_declaration and function.linkage == binding.Linkage.external:
                    function.linkage = "linkonce_odr"
            self._shared_module = self._final_module
        return self._shared_module

    def _finalize_final_module(self) -> None:
        self._finalized = True


@of_kernels
class _Whole(JITCodeLibrary):
    """The code of a kernel and of all that it calls."""

    vectorized = False

    def _optimize_final_module(self) -> None:
        options = binding.create_pipeline_tuning_options(speed_level=3 if self.vectorized else 2)
        options.loop_vectorization = options.slp_vectorization = options.loop_unrolling = self.vectorized
        builder = binding.create_pass_builder(self._codegen._tm, options)
        builder.getModulePassManager().run(self._final_module, builder)


class _Vectorized(_Whole):
    """The same, of loops that are worth it."""

    vectorized = True


# passes over every function that find nothing to do in kernels: functions within functions; whole arrays in an
# expression, as none is allocated; overloads that are put in the place of calls before lowering; what cannot stand in
# a compiled function
_NEEDLESS = {InlineClosureLikes, NopythonRewrites, InlineOverloads, IRLegalization}


class _Compiler(Compiler):
    """Numba's compiler without what kernels do not need."""

    def define_pipelines(self) -> list[Any]:
        """The passes."""
        pipelines: list[Any] = super().define_pipelines()
        for pipeline in pipelines:
            pipeline.passes = [each for each in pipeline.passes if each[0] not in _NEEDLESS]
        return pipelines


class HelperCompiler(_Compiler):
    """Numba's compiler, but for a function that is called by compiled ones only; from Python the call would crash."""

    def __init__(self, typing_context: Any, target_context: Any, library: Any, *others: Any):
        super().__init__(typing_context, target_context, _Linked(target_context.codegen(), "helper"), *others)


class KernelCompiler(_Compiler):
    """Numba's compiler, but for a function that is optimised together with its helpers, once."""

    library: type[_Whole] = _Whole

    def __init__(self, typing_context: Any, target_context: Any, library: Any, *others: Any):
        library = self.library(target_context.codegen(), "kernel")
        library.enable_object_caching()
        super().__init__(typing_context, target_context, library, *others)

    def compile_extra(self, function: Any) -> Any:
        """Compile a function and all that it calls."""
        with own_rules():
            return super().compile_extra(function)


class VectorizingCompiler(KernelCompiler):
    """The same for loops long enough to be unrolled and vectorised."""

    library = _Vectorized


@cache
def direct(function: Dispatcher) -> Any:
    """What Python calls of a function with one signature, past the look at the types of its arguments: these must fit.

    That look costs as much as two steps of a small mechanism.
    """
    compiled: Any = next(iter(function.overloads.values()))
    return compiled.entry_point


_ADDRESSES: WeakKeyDictionary[Dispatcher, int] = WeakKeyDictionary()  # of functions, which have one signature each


def machine_code(function: Dispatcher, signature: Any) -> int:
    """The address of a compiled function; it takes arguments and reports errors as numba's functions do."""
    if function not in _ADDRESSES:
        compiled: Any = function.overloads.get(signature.args) or function.get_compile_result(signature)
        _ADDRESSES[function] = int(compiled.library.get_pointer_to_function(compiled.fndesc.llvm_func_name))
    return _ADDRESSES[function]
