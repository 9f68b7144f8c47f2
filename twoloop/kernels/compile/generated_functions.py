"""Compile the LLVM code that twoloop generates for one mechanism, without numba; cache the machine code on disk.

Numba would add about a thousand lines of code to each function, and take ten milliseconds for each line of its source.
Generated code consists only of arithmetic on numbers in memory. Few of LLVM's optimisations are needed, because the
operations are already in a good order.
"""

from collections import defaultdict
from collections.abc import Callable
from functools import cache, cached_property
from typing import Any

from llvmlite import binding
from numba.core.registry import cpu_target

from twoloop.kernels.compile.caches import UNWRITABLE_CACHE_WARNING, BoundedCache, CodeFiles, sources_folder, warn_once

# True if this version of llvmlite can run selected optimisation passes of LLVM; False if it can only run all of them
HAS_SINGLE_PASSES = hasattr(binding.ModulePassManager, "add_reassociate_pass")


class GeneratedFunctions:
    """Machine code of generated functions, in memory as long as this object exists.

    content : object code of the functions with these `names`, as `object_code` returns it.
    addresses : address of each function in memory, by its name.
    """

    def __init__(self, names: list[str], content: bytes):
        self._engine = binding.create_mcjit_compiler(binding.parse_assembly(""), _new_target_machine())
        object_file = binding.ObjectFileRef.from_data(content)
        self._engine.add_object_file(object_file)
        self._engine.finalize_object()
        self.addresses: dict[str, int] = {name: int(self._engine.get_function_address(name)) for name in names}


class DeferredFunctions:
    """Functions that `generate` compiles only when one of their addresses is first read: many runs do not use them."""

    def __init__(self, generate: Callable[[], GeneratedFunctions]):
        self._generate = generate

    @cached_property
    def functions(self) -> GeneratedFunctions:
        """The functions, compiled at the first access; they stay in memory as long as this object exists."""
        return self._generate()

    @property
    def addresses(self) -> dict[str, int]:
        """Address of each function in memory, by its name."""
        return self.functions.addresses


_FUNCTIONS_IN_MEMORY: dict[str, BoundedCache] = defaultdict(BoundedCache)  # {kind: {key: GeneratedFunctions}}


def generated_functions(
    kind: str, stamp: str, key: str, write: Callable[[], tuple[list[str], str]], optimise: bool = True
) -> GeneratedFunctions:
    """Return the functions of one LLVM module from memory or from the disk; if they are not there, compile them.

    kind : name of the cache on disk, which keeps the MAX_ON_DISK modules compiled last.
    stamp : digest of the Python code that generates the functions; a file with another stamp is out of date.
    key : digest of the expressions that the functions compute.
    write : function that returns the names of the functions, and the text of the LLVM module to compile.
    optimise : True if LLVM has to optimise the code.
    """
    if (functions := _FUNCTIONS_IN_MEMORY[kind].get(key)) is not None:
        return functions  # type: ignore[no-any-return]
    files, disk_key = _code_files(kind, stamp), _disk_key(key)
    try:
        names_and_content = files.load(disk_key)
    except Exception:  # if another installation wrote an incompatible file, compile again and overwrite the file
        names_and_content = None
    if names_and_content is None:
        names, text = write()
        names_and_content = names, object_code(text, optimise)
        try:
            files.save(disk_key, names_and_content)
        except OSError:
            warn_once(UNWRITABLE_CACHE_WARNING)
    names, content = names_and_content
    _FUNCTIONS_IN_MEMORY[kind][key] = functions = GeneratedFunctions(names, content)
    return functions


def are_cached(kind: str, stamp: str, key: str) -> bool:
    """Return True if `generated_functions`, with these arguments, would find the functions in memory or on disk."""
    return key in _FUNCTIONS_IN_MEMORY[kind] or _code_files(kind, stamp).has_file(_disk_key(key))


def _code_files(kind: str, stamp: str) -> CodeFiles:
    return CodeFiles(sources_folder(), kind, (binding.llvm_version_info, stamp), True)


def _disk_key(key: str) -> Any:
    """Return the key of a file of machine code: a description of the processor, then `key`, which names the code."""
    return (*cpu_target.target_context.codegen().magic_tuple(), key)


def object_code(text: str, optimise: bool = True) -> bytes:
    """Compile the text of an LLVM module to object code for this processor; if `optimise`, optimise it first."""
    machine = _shared_target_machine()
    target = f'target triple = "{_target_triple()}"\ntarget datalayout = "{machine.target_data}"\n'
    module = binding.parse_assembly(target + text)
    if optimise:
        manager, builder = _two_pass_manager() if HAS_SINGLE_PASSES else _all_pass_manager()
        manager.run(module, builder)
    content: bytes = machine.emit_object(module)
    return content


@cache
def _shared_target_machine() -> Any:
    return _new_target_machine()


@cache
def _two_pass_manager() -> tuple[Any, Any]:
    """Return a manager that runs two of LLVM's optimisation passes, and its pass builder.

    These passes make the code of small mechanisms a tenth faster; all other passes together gain no further speed. The
    result is cached, because LLVM leaks 300 kB for each pass that is created.
    """
    manager = binding.create_new_module_pass_manager()
    manager.add_reassociate_pass()
    manager.add_instruction_combine_pass()
    return manager, _pass_builder()


def _all_pass_manager() -> tuple[Any, Any]:
    """Return a new manager that runs all passes of LLVM, and its pass builder; llvmlite 0.44 has no other manager."""
    builder = _pass_builder()
    return builder.getModulePassManager(), builder


def _pass_builder() -> Any:
    return binding.create_pass_builder(_shared_target_machine(), binding.create_pipeline_tuning_options(speed_level=1))


@cache
def _target_triple() -> str:
    return str(binding.get_process_triple())


def _new_target_machine() -> Any:
    """Return a new LLVM target machine for the processor for which numba compiles; each execution engine needs one."""
    options: dict[str, Any] = {"opt": 1}  # level 2 would compile a quarter longer, and not make generated code faster
    cpu_target.target_context.codegen()._customize_tm_options(options)
    return binding.Target.from_triple(_target_triple()).create_target_machine(**options)


def has_wide_vectors() -> bool:
    """Return True if the processor for which numba compiles has registers of eight doubles (AVX-512)."""
    _, _, features = cpu_target.target_context.codegen().magic_tuple()
    return "+avx512f" in features.split(",")
