"""Define structures of arrays and functions that compiled functions receive as one pointer, to a table of addresses.

Numba would pass a named tuple of forty arrays as about three hundred arguments, and write them to memory at every call
that LLVM does not inline. A structure of the type `Reference` also has named fields, but is a single argument.
"""

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.imputils import lower_getattr_generic, lower_setattr_generic
from numba.core.typing.templates import AbstractTemplate, AttributeTemplate, Signature, infer_getattr
from numba.extending import NativeValue, lower_builtin, models, register_model, unbox
from numba.np.arrayobj import make_array
from numba.np.numpy_support import as_dtype

from twoloop.kernels.compile.caches import BoundedCache
from twoloop.kernels.compile.linking import machine_code_address

NO_ELEMENTS: Mapping[str, Mapping[str, int]] = {}
_REFERENCES: dict[str, Any] = {}  # all `Reference` types, by name


def _reference_named(name: str) -> Any:
    """Return the existing `Reference` with this name; pickle calls this function, and so does not create a second."""
    return _REFERENCES[name]


class Reference(types.Type):
    """Type, for numba, of a structure of arrays and functions, which is passed as a pointer to a table.

    The table contains the address and shape of each array, and the address of each function. A function is compiled by
    numba, or generated as LLVM code (see generated_functions.py). A generated function receives arrays as addresses of
    their first elements, without shapes, and reports no errors.

    name : unique name of the type.
    arrays : type of each array, by name of its field; all arrays are contiguous, with one or two dimensions.
    elements : {field of an array: {name: index of an element}}; in compiled code, `structure.name` is this element.
    """

    def __init__(
        self, name: str, arrays: Mapping[str, types.Array], elements: Mapping[str, Mapping[str, int]] = NO_ELEMENTS
    ):
        super().__init__(name)
        _REFERENCES[name] = self
        self.arrays = dict(arrays)
        self.dtypes = {field: as_dtype(kind.dtype) for field, kind in self.arrays.items()}
        # for each name of an array element: the field of the array, and the index of the element in the array
        self.elements = {element: (array, i) for array, named in elements.items() for element, i in named.items()}
        self.functions: dict[str, Signature] = {}
        self.llvm_functions: set[str] = set()  # fields in `functions` whose functions are generated as LLVM code
        self.offsets: dict[str, int] = {}  # index of each field's address in the table; an array's sizes follow
        self.n_words = 0  # length of the table so far
        self._addresses: Any = BoundedCache()  # addresses of machine code, by the tuple of all functions of a structure
        for field, kind in self.arrays.items():
            self.offsets[field] = self.n_words
            self.n_words += 1 + kind.ndim

    def __reduce__(self) -> Any:
        return _reference_named, (self.name,)

    def __repr__(self) -> str:
        """Return the name and a digest of the fields: part of the key of cached machine code that uses this type."""
        fields: list[Any] = [(field, str(kind)) for field, kind in self.arrays.items()]
        fields += self.elements.items()
        fields += [
            (field, str(self.functions[field])) if field in self.llvm_functions else field for field in self.functions
        ]
        return f"{self.name}-{hashlib.sha256(repr(fields).encode()).hexdigest()[:16]}"

    def add_function(self, field: str, signature: Signature) -> None:
        """Add a field for a function compiled by numba; its arguments may also be structures of this type."""
        self.functions[field] = signature
        self.offsets[field] = self.n_words
        self.n_words += 1
        _define_call(self, field, signature)

    def add_llvm_functions(self, signatures: Mapping[str, Signature]) -> None:
        """Add fields for generated functions; callers must check that the address is not 0 (missing function)."""
        for field, signature in signatures.items():
            self.functions[field] = signature
            self.llvm_functions.add(field)
            self.offsets[field] = self.n_words
            self.n_words += 1
            _define_llvm_call(self, field, signature)

    def llvm_signature(self, field: str) -> tuple[str, list[str]]:
        """Return the LLVM types, as text, of the result of a generated function and of its arguments."""
        signature = self.functions[field]
        return str(_llvm_type(signature.return_type)), [str(_llvm_type(kind)) for kind in signature.args]

    def table(self, values: Any) -> Any:
        """Return the table (int64) of a structure: address and shape of each array, then the address of each function.

        `values`: object with an attribute for each field: an array, a function compiled by numba (None: missing), or
        the address of a generated function (0: missing). `values` must exist as long as the table is used.
        """
        words: list[int] = []
        for field, kind in self.arrays.items():
            array = getattr(values, field)
            if array.ndim != kind.ndim or array.dtype != self.dtypes[field] or not array.flags.c_contiguous:
                raise TypeError(f"{field} must be a {kind}; given {array.dtype} of shape {array.shape}")
            words.append(array.ctypes.data)
            words.extend(array.shape)
        functions = tuple([getattr(values, field) for field in self.functions])
        addresses = self._addresses.get(functions)
        if addresses is None:
            self._addresses[functions] = addresses = list(map(self._address, self.functions, functions))
        words.extend(addresses)
        return np.array(words, dtype=np.int64)

    def _address(self, field: str, function: Any) -> int:
        if field in self.llvm_functions:
            return int(function)
        return 0 if function is None else machine_code_address(function, self.functions[field])


register_model(Reference)(models.OpaqueModel)


@unbox(Reference)
def _unbox(typ: Any, obj: Any, c: Any) -> NativeValue:
    """Emit code that converts a structure, passed as a Python object, to a pointer to its table of addresses and sizes.

    The argument has an attribute `address`, or is the address itself: passing an integer saves 0.1 microseconds.
    """
    python_type = c.builder.load(
        c.builder.gep(c.builder.bitcast(obj, obj.type.as_pointer()), [ir.Constant(ir.IntType(32), 1)])
    )
    address = cgutils.alloca_once_value(c.builder, obj)
    is_number = c.builder.icmp_unsigned("==", python_type, c.pyapi.get_c_object("PyLong_Type"))
    with c.builder.if_else(is_number) as (number, other):
        with number:
            c.pyapi.incref(obj)
        with other:
            c.builder.store(c.pyapi.object_getattr_string(obj, "address"), address)
    address_object = c.builder.load(address)
    pointer = c.pyapi.long_as_voidptr(address_object)
    c.pyapi.decref(address_object)
    return NativeValue(pointer, is_error=c.pyapi.c_api_error())


def _load_word(context: Any, builder: Any, pointer: Any, offset: int, kind: Any) -> Any:
    """Emit code that loads entry `offset` (64 bits) of the table at `pointer`; tell LLVM that the entry is constant."""
    slot = builder.gep(builder.bitcast(pointer, ir.IntType(64).as_pointer()), [ir.Constant(ir.IntType(64), offset)])
    word = builder.load(builder.bitcast(slot, kind.as_pointer()))
    word.set_metadata("invariant.load", builder.module.add_metadata([]))
    return word


@infer_getattr
class _FieldTypes(AttributeTemplate):
    """Tell numba the type of an attribute of a structure: an array, an array element or a function."""

    key = Reference

    def generic_resolve(self, typ: Any, field: str) -> Any:  # type: ignore[override]
        if field in typ.elements:
            return typ.arrays[typ.elements[field][0]].dtype
        if field not in typ.functions:
            return typ.arrays.get(field)

        class FieldCall(AbstractTemplate):
            key = (typ.name, field)

            def generic(self, args: Any, kws: Any) -> Any:
                return typ.functions[field].replace(recvr=typ)

        return types.BoundFunction(FieldCall, typ)


def _element_address(context: Any, builder: Any, typ: Any, pointer: Any, field: str) -> Any:
    """Emit code for the address of the array element that compiled code accesses as the attribute `field`."""
    array, index = typ.elements[field]
    item_type = context.get_data_type(typ.arrays[array].dtype)
    data = _load_word(context, builder, pointer, typ.offsets[array], item_type.as_pointer())
    return builder.gep(data, [ir.Constant(ir.IntType(64), index)])


@lower_setattr_generic(Reference)
def _store_element(context: Any, builder: Any, sig: Any, args: Any, field: str) -> None:
    """Emit code that stores a number in the array element that compiled code accesses as the attribute `field`."""
    pointer, value = args
    builder.store(value, _element_address(context, builder, sig.args[0], pointer, field))


@lower_getattr_generic(Reference)
def _load_array(context: Any, builder: Any, typ: Any, pointer: Any, field: str) -> Any:
    """Emit code for reading an attribute of a structure: an array element, an array, or (for a call) a function."""
    if field in typ.elements:
        return builder.load(_element_address(context, builder, typ, pointer, field))
    if field in typ.functions:  # the pointer to the table is enough: a call loads the address of the function from it
        return pointer
    kind, offset = typ.arrays[field], typ.offsets[field]
    item_type = context.get_data_type(kind.dtype)
    word = ir.IntType(64)
    shape = [_load_word(context, builder, pointer, offset + 1 + axis, word) for axis in range(kind.ndim)]
    size = ir.Constant(word, context.get_abi_sizeof(item_type))
    strides = [size] if kind.ndim == 1 else [builder.mul(shape[1], size), size]
    fields = {
        "meminfo": None,
        "parent": None,
        "nitems": shape[0] if kind.ndim == 1 else builder.mul(*shape, flags=["nsw"]),
        "itemsize": size,
        "data": _load_word(context, builder, pointer, offset, item_type.as_pointer()),
        "shape": cgutils.pack_array(builder, shape),
        "strides": cgutils.pack_array(builder, strides),
    }
    model = context.data_model_manager[kind]
    array = ir.Constant(context.get_value_type(kind), ir.Undefined)
    for name, value in fields.items():  # LLVM keeps an array in registers if insert_value sets each of its fields
        index = model.get_field_position(name)
        element = ir.Constant(array.type.elements[index], None) if value is None else value
        array = builder.insert_value(array, element, index)
    return array


def _define_call(typ: Reference, field: str, signature: Signature) -> None:
    """Tell numba how to compile a call of the function in a `field` of a structure, if numba compiled the function."""
    offset = typ.offsets[field]

    @lower_builtin((typ.name, field), typ, *signature.args)
    def lower_call(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        convention = context.call_conv
        kind = convention.get_function_type(signature.return_type, signature.args).as_pointer()
        function = _load_word(context, builder, args[0], offset, kind)
        status, value = convention.call_function(builder, function, signature.return_type, signature.args, args[1:])
        with builder.if_then(status.is_error, likely=False):
            convention.return_status_propagate(builder, status)
        return value


_LLVM_TYPES = {  # LLVM's types of arguments and results, by numba's types
    types.float64: ir.DoubleType(),
    types.int64: ir.IntType(64),
    types.boolean: ir.IntType(1),
    types.none: ir.VoidType(),
}


def _llvm_type(kind: Any) -> Any:
    """Return LLVM's type of an argument or result of a generated function; for an array, the type of a pointer."""
    return _LLVM_TYPES[kind.dtype].as_pointer() if isinstance(kind, types.Array) else _LLVM_TYPES[kind]


def _define_llvm_call(typ: Reference, field: str, signature: Signature) -> None:
    """Tell numba how to compile a call of the function in a `field` of a structure, if it is a generated function."""
    offset = typ.offsets[field]

    @lower_builtin((typ.name, field), typ, *signature.args)
    def lower_call(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = ir.FunctionType(_llvm_type(signature.return_type), [_llvm_type(each) for each in signature.args])
        function = _load_word(context, builder, args[0], offset, kind.as_pointer())
        llvm_arguments = [
            make_array(kind)(context, builder, value).data if isinstance(kind, types.Array) else value
            for kind, value in zip(signature.args, args[1:], strict=True)
        ]
        value = builder.call(function, llvm_arguments)
        return context.get_dummy_value() if signature.return_type == types.none else value
