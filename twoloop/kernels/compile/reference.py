"""Structures that kernels get by reference: one pointer to a table of addresses and lengths.

Numba passes a named tuple by value, member by member: a workspace of forty arrays is some three hundred arguments, and
each call that LLVM does not inline stores them all. A `Reference` has the same attributes and is one argument.
"""

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core.imputils import lower_getattr_generic
from numba.core.typing.templates import AbstractTemplate, AttributeTemplate, Signature, infer_getattr
from numba.extending import NativeValue, lower_builtin, models, register_model, unbox
from numba.np.arrayobj import make_array, populate_array
from numba.np.numpy_support import as_dtype

from twoloop.kernels.compile.linking import machine_code

_KNOWN: dict[str, Any] = {}


def _known(name: str) -> Any:
    """What numba reads back where it has pickled a reference, whose functions may take that reference."""
    return _KNOWN[name]


class Reference(types.Type):
    """A pointer to a table: of each array its address and its shape, of each function its address.

    Parameters
    ----------
    name : str
        Tells references apart.
    arrays : dict
        Types of the fields that are arrays, one- or two-dimensional, without gaps.
    """

    def __init__(self, name: str, arrays: Mapping[str, types.Array]):
        super().__init__(name)
        _KNOWN[name] = self
        self.arrays = dict(arrays)
        self.dtypes = {field: as_dtype(kind.dtype) for field, kind in self.arrays.items()}
        self.functions: dict[str, Signature] = {}
        self.places: dict[str, int] = {}
        self.n_words = 0
        for field, kind in self.arrays.items():
            self.places[field] = self.n_words
            self.n_words += 1 + kind.ndim

    def __reduce__(self) -> Any:
        return _known, (self.name,)

    def __repr__(self) -> str:
        """The name, and what tells layouts apart: machine code on disk is kept by it."""
        fields = [(field, str(kind)) for field, kind in self.arrays.items()] + list(self.functions)
        return f"{self.name}-{hashlib.sha256(repr(fields).encode()).hexdigest()[:16]}"

    def add_function(self, field: str, signature: Signature) -> None:
        """Add a function, whose signature may name this very type."""
        self.functions[field] = signature
        self.places[field] = self.n_words
        self.n_words += 1
        _define_call(self, field, signature)

    def table(self, values: Any) -> Any:
        """The table, int64, for an object with arrays and functions of these names, which has to outlive it.

        Raises
        ------
        TypeError
            If an array is of another type than was declared.
        """
        words: list[int] = []
        for field, kind in self.arrays.items():
            array = getattr(values, field)
            if array.ndim != kind.ndim or array.dtype != self.dtypes[field] or not array.flags.c_contiguous:
                raise TypeError(f"{field} must be a {kind}; given {array.dtype} of shape {array.shape}")
            words.append(array.ctypes.data)
            words.extend(array.shape)
        for field, signature in self.functions.items():
            function = getattr(values, field)
            words.append(0 if function is None else machine_code(function, signature))
        return np.array(words, dtype=np.int64)


register_model(Reference)(models.OpaqueModel)


@unbox(Reference)
def _unbox(typ: Any, obj: Any, c: Any) -> NativeValue:
    """Python objects that stand for a reference have the address of their table in `address`."""
    address = c.pyapi.object_getattr_string(obj, "address")
    pointer = c.pyapi.long_as_voidptr(address)
    c.pyapi.decref(address)
    return NativeValue(pointer, is_error=c.pyapi.c_api_error())


def _load(context: Any, builder: Any, pointer: Any, place: int, kind: Any) -> Any:
    """The word of a table; it never changes, which lets LLVM load it once."""
    slot = builder.gep(builder.bitcast(pointer, ir.IntType(64).as_pointer()), [ir.Constant(ir.IntType(64), place)])
    word = builder.load(builder.bitcast(slot, kind.as_pointer()))
    word.set_metadata("invariant.load", builder.module.add_metadata([]))
    return word


@infer_getattr
class _Fields(AttributeTemplate):
    key = Reference

    def generic_resolve(self, typ: Any, field: str) -> Any:  # type: ignore[override]
        if field not in typ.functions:
            return typ.arrays.get(field)

        class Call(AbstractTemplate):
            key = (typ.name, field)

            def generic(self, args: Any, kws: Any) -> Any:
                return typ.functions[field].replace(recvr=typ)

        return types.BoundFunction(Call, typ)


@lower_getattr_generic(Reference)
def _array(context: Any, builder: Any, typ: Any, pointer: Any, field: str) -> Any:
    if field in typ.functions:  # a call gets the reference itself
        return pointer
    kind, place = typ.arrays[field], typ.places[field]
    item = context.get_data_type(kind.dtype)
    word = ir.IntType(64)
    shape = [_load(context, builder, pointer, place + 1 + axis, word) for axis in range(kind.ndim)]
    size = ir.Constant(word, context.get_abi_sizeof(item))
    strides = [size] if kind.ndim == 1 else [builder.mul(shape[1], size), size]
    array = make_array(kind)(context, builder)
    populate_array(
        array,
        data=_load(context, builder, pointer, place, item.as_pointer()),
        shape=shape,
        strides=strides,
        itemsize=size,
        meminfo=None,
    )
    return array._getvalue()


def _define_call(typ: Reference, field: str, signature: Signature) -> None:
    place = typ.places[field]

    @lower_builtin((typ.name, field), typ, *signature.args)
    def call(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        convention = context.call_conv
        kind = convention.get_function_type(signature.return_type, signature.args).as_pointer()
        function = _load(context, builder, args[0], place, kind)
        status, value = convention.call_function(builder, function, signature.return_type, signature.args, args[1:])
        with builder.if_then(status.is_error, likely=False):
            convention.return_status_propagate(builder, status)
        return value
