"""Write LLVM modules as text: functions, basic blocks and instructions.

llvmlite would build modules from objects, which takes ten times as long as writing text, and longer than the
compilation by LLVM. A type is represented by its text. Pointer types name the type of the target, such as double*,
because all versions of LLVM accept this.
"""

import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from twoloop.kernels.data.common import OPTIONS

FAST_MATH_FLAGS = " ".join(sorted(OPTIONS["fastmath"]))  # flags of floating-point instructions, the same as in kernels
DOUBLE, INTEGER, WORD, BIT, VOID = "double", "i64", "i32", "i1", "void"
DOUBLES_PER_CACHE_LINE = 8  # size of a cache line of the processor, in doubles
# if `Module.splits_blocks`, a block is split after this number of instructions: longer blocks double the compile time
MAX_BLOCK_LENGTH = 400


def _operator(name: str, is_reflected: bool = False) -> "Callable[[Value, Value | float], Value]":
    """Return a method of Value that appends the instruction `name`; `is_reflected`: `self` is the second operand."""
    is_comparison, of_doubles = name.startswith("fcmp"), f"f{name} {FAST_MATH_FLAGS}"

    def append(value: "Value", other: "Value | float") -> "Value":
        operand = other if isinstance(other, Value) else constant(value.type, other)
        a, b = (operand, value) if is_reflected else (value, operand)
        builder = value.builder or operand.builder
        if is_comparison:
            return builder.compare(name, a, b)
        return builder.operation(of_doubles if DOUBLE in value.type else name, a, b)

    return append


class Value:
    """Value of an LLVM function (a number, a vector or a pointer): its type and its text.

    Operators append an instruction to the function, and return its result. One operand may be a literal number.
    builder : builder of the function. A literal may have none: then the other operand of an operation must have one.
    """

    __slots__ = ("builder", "text", "type")
    __array_ufunc__ = None  # with this, operators of NumPy numbers call the operators of this class

    def __init__(self, kind: str, text: str, builder: "Builder | None" = None):
        self.type, self.text = kind, text
        self.builder: Any = builder

    def __str__(self) -> str:
        """Return the type and the text, as the arguments of a call are written."""
        return f"{self.type} {self.text}"

    def __neg__(self) -> "Value":
        return self.builder.negate(FAST_MATH_FLAGS, self)

    def __abs__(self) -> "Value":
        width = width_of(self.type)
        return self.builder.call(f"llvm.fabs.{'f64' if width == 1 else f'v{width}f64'}", self.type, [self])

    __add__, __sub__, __mul__, __truediv__ = (_operator(name) for name in ("add", "sub", "mul", "div"))
    __radd__, __rsub__, __rmul__, __rtruediv__ = (_operator(name, True) for name in ("add", "sub", "mul", "div"))
    __and__, __or__, __xor__ = (_operator(name) for name in ("and", "or", "xor"))
    __gt__, __lt__, __ge__, __le__ = (_operator(f"fcmp {name}") for name in ("ogt", "olt", "oge", "ole"))


class Phi(Value):
    """Phi node: a value that depends on the block from which the program has jumped to the block of the node."""

    __slots__ = ("incoming",)

    def __init__(self, kind: str, text: str, builder: "Builder"):
        super().__init__(kind, text, builder)
        self.incoming: list[tuple[Value, Block]] = []

    def add_incoming(self, value: Value, block: "Block") -> None:
        """Add the value that the phi node takes if the program has jumped from `block` to the block of the node."""
        self.incoming.append((value, block))

    def line(self) -> str:
        """Return the text of the instruction that defines the phi node."""
        pairs = ", ".join(f"[{value.text}, %{block.name}]" for value, block in self.incoming)
        return f"{self.text} = phi {self.type} {pairs}"


class Block:
    """Basic block: a sequence of instructions."""

    def __init__(self, name: str):
        self.name = name
        self.lines: list[str | Phi] = []

    def text(self) -> str:
        """Return the text of the block."""
        lines = (line if isinstance(line, str) else line.line() for line in self.lines)
        return "\n ".join([f"{self.name}:", *lines])


def vector_of(kind: str, width: int) -> str:
    """Return the text of the type of a vector with `width` elements of type `kind`; if `width` is 1, return `kind`."""
    return kind if width == 1 else f"<{width} x {kind}>"


def width_of(kind: str) -> int:
    """Return the number of elements of a type, which is 1 unless the type is a vector."""
    return int(kind[1:].split()[0]) if kind.startswith("<") else 1


def element_of(kind: str) -> str:
    """Return the type of the elements of a vector type; return any other type unchanged."""
    return kind[1:-1].split(" x ")[1] if kind.startswith("<") else kind


def constant(kind: str, number: float, builder: "Builder | None" = None) -> Value:
    """Return the literal `number` of type `kind`; if `kind` is a vector type, all elements are `number`."""
    element, width = element_of(kind), width_of(kind)
    bits = struct.unpack("<Q", struct.pack("<d", number))[0]
    text = f"0x{bits:016X}" if element == DOUBLE else str(number)
    return Value(kind, text if width == 1 else f"<{', '.join([f'{element} {text}'] * width)}>", builder)


def constants(numbers: Iterable[float]) -> Value:
    """Return a literal vector whose elements are `numbers`."""
    texts = [str(constant(DOUBLE, float(number))) for number in numbers]
    return Value(vector_of(DOUBLE, len(texts)), f"<{', '.join(texts)}>")


def integer(number: int) -> Value:
    """Return a literal integer of 64 bits."""
    return Value(INTEGER, str(number))


def undefined(kind: str) -> Value:
    """Return an undefined value of type `kind`, for example a vector before its elements are inserted."""
    return Value(kind, "undef")


class Module:
    """LLVM module: functions, and declarations of the other functions that they call.

    `splits_blocks`: True if long blocks are split, because the compile time of a block grows faster than its length.
    """

    def __init__(self, splits_blocks: bool = False) -> None:
        self.splits_blocks = splits_blocks
        self.block_addresses: list[str] = []  # LLVM does not merge a block in this list with the block before it
        self._tables: list[str] = []
        self._numbers: list[float] = []  # numbers that `Builder.load_constant` loads
        self._declared: dict[str, str] = {}
        self._functions: list[Builder] = []

    def function(self, name: str, result: str, arguments: Sequence[str], internal: bool = False) -> "Builder":
        """Add a function and return its Builder; `internal`: only functions of the module call it."""
        builder = Builder(self, name, result, arguments, internal)
        self._functions.append(builder)
        return builder

    def defines(self, name: str) -> bool:
        """Return True if the module contains a function of this name, not only its declaration."""
        return any(function.name == name for function in self._functions)

    def add_table(self, indices: Sequence[int]) -> Value:
        """Add an array of constant integers to the module, and return a pointer to the array."""
        kind, name = f"[{len(indices)} x {WORD}]", f"@table{len(self._tables)}"
        entries = ", ".join([f"{WORD} {index}" for index in indices])
        self._tables.append(f"{name} = internal constant {kind} [{entries}]")
        return Value(f"{WORD}*", f"getelementptr inbounds ({kind}, {kind}* {name}, {INTEGER} 0, {INTEGER} 0)")

    def add_number(self, number: float) -> int:
        """Add a number to the array for `Builder.load_constant`; return the index of the number."""
        self._numbers.append(number)
        return len(self._numbers) - 1

    def add_declaration(self, name: str, result: str, arguments: Iterable[str]) -> None:
        """Add the declaration of a function that may be outside the module, such as one of libm."""
        self._declared[name] = f"declare {result} @{name}({', '.join(arguments)})"

    def __str__(self) -> str:
        defined = {function.name for function in self._functions}
        declared = [text for name, text in self._declared.items() if name not in defined]
        numbers = [constant(DOUBLE, number) for number in self._numbers]
        tables = list(self._tables)
        if numbers:
            kind = f"[{len(numbers)} x {DOUBLE}]"
            tables.append(f"@numbers = internal constant {kind} [{', '.join(map(str, numbers))}]")
            index = f"getelementptr inbounds ({kind}, {kind}* @numbers, {INTEGER} 0, {INTEGER} 0)"
            tables.append(f"@far = internal global {DOUBLE}* {index}")
        parts = [*declared, *tables, *(function.text() for function in self._functions), "!0 = !{}"]
        if self.block_addresses:
            kind = f"[{len(self.block_addresses)} x i8*]"
            parts.append(f"@kept_apart = internal constant {kind} [{', '.join(self.block_addresses)}]")
        return "\n".join(parts)


class Builder:
    """Builder of an LLVM function: its methods append instructions to the current block, and return their results."""

    def __init__(self, module: Module, name: str, result: str, arguments: Sequence[str], internal: bool = False):
        self.module, self.name, self.result, self.internal = module, name, result, internal
        self.arguments = [Value(kind, f"%a{k}", self) for k, kind in enumerate(arguments)]
        self._n_values = self._n_allocated = 0
        self._far_pointer: Value | None = None
        self.part = 0  # index of the current part of the function: number of calls of `_split_block` so far
        self._blocks: list[Block] = []
        self._n_blocks = 0
        self.position_at_end(self.append_block())

    def text(self) -> str:
        """Return the text of the function's definition in LLVM."""
        arguments = ", ".join(map(str, self.arguments))
        body = "\n".join(block.text() for block in self._blocks)
        linkage = "internal " if self.internal else ""
        # if the stack is not aligned, a vector on it lies in two cache lines, and takes twice as long to load and store
        attributes = "noinline alignstack(64)" if f"<{DOUBLES_PER_CACHE_LINE} x" in body else "noinline"
        return f"define {linkage}{self.result} @{self.name}({arguments}) {attributes} {{\n{body}\n}}"

    def append_block(self) -> Block:
        """Return a new block; `position_at_end` adds it to the function."""
        self._n_blocks += 1
        return Block(f"b{self._n_blocks - 1}")

    def position_at_end(self, block: Block) -> None:
        """Append a block to the function, and make it the current block: the next instructions go there."""
        self.block = block
        self._blocks.append(block)

    def _append_line(self, text: str) -> None:
        self.block.lines.append(text)

    def _append_value(self, kind: str, text: str) -> Value:
        if self.module.splits_blocks and len(self.block.lines) >= MAX_BLOCK_LENGTH:
            self._split_block()
        # LLVM reads numbered values in a third less time than named values
        value = Value(kind, f"%{self._n_values}", self)
        self._n_values += 1
        self.block.lines.append(f"{value.text} = {text}")
        return value

    def _split_block(self) -> None:
        """Continue in a new block; store the block's address, so that LLVM does not merge it with the current block."""
        block = self.append_block()
        self.jump(block)
        self.module.block_addresses.append(f"i8* blockaddress(@{self.name}, %{block.name})")
        self.position_at_end(block)
        self.part += 1

    def operation(self, name: str, a: Value, b: Value) -> Value:
        """Append an instruction, such as "add" or "fmul fast", on two values of the same type; return its result."""
        return self._append_value(a.type, f"{name} {a.type} {a.text}, {b.text}")

    def negate(self, flags: str, a: Value) -> Value:
        """Return -a for a floating-point number a."""
        return self._append_value(a.type, f"fneg {flags} {a.type} {a.text}")

    def convert(self, name: str, a: Value, kind: str) -> Value:
        """Return a value converted to the type `kind` by the instruction `name`, such as "sitofp" or "bitcast"."""
        return self._append_value(kind, f"{name} {a.type} {a.text} to {kind}")

    def compare(self, name: str, a: Value, b: Value) -> Value:
        """Return the result (BIT) of comparing two values by an instruction such as "fcmp oeq" or "icmp slt"."""
        kind = vector_of(BIT, width_of(a.type))
        return self._append_value(kind, f"{name} {a.type} {a.text}, {b.text}")

    def select(self, condition: Value, a: Value, b: Value) -> Value:
        """Return a if the condition is true, else b; for vectors, element by element."""
        return self._append_value(a.type, f"select {condition}, {a}, {b}")

    def call(self, name: str, kind: str, arguments: Sequence[Value], flags: str = "") -> Value:
        """Append a call of the function `name`, and declare it in the module; return its result of type `kind`."""
        self.module.add_declaration(name, kind, [value.type for value in arguments])
        return self._append_value(kind, f"call {flags} {kind} @{name}({', '.join(map(str, arguments))})")

    def call_void(self, name: str, arguments: Sequence[Value]) -> None:
        """Append a call of a function that is defined in the module and returns no value."""
        self._append_line(f"call {VOID} @{name}({', '.join(map(str, arguments))})")

    def allocate(self, kind: str, size: int) -> Value:
        """Return a pointer to `size` values of type `kind` on the stack; the function allocates them when it begins."""
        pointer = Value(f"{kind}*", f"%room{self._n_allocated}")
        self._blocks[0].lines.insert(
            self._n_allocated, f"{pointer.text} = alloca {kind}, {integer(max(size, 1))}, align 64"
        )
        self._n_allocated += 1
        return pointer

    def load_constant(self, number: float) -> Value:
        """Return a number that is loaded from memory right before its use; LLVM would keep a literal in a register."""
        if self._far_pointer is None:
            self._far_pointer = Value(f"{DOUBLE}*", "%far")
            self._blocks[0].lines.insert(0, f"%far = load {DOUBLE}*, {DOUBLE}** @far")
            self._n_allocated += 1
        return self.load(self.advance(self._far_pointer, integer(self.module.add_number(number))))

    def return_false_unless(self, condition: Value) -> None:
        """Append instructions that return false from the function if `condition` is false."""
        next_block, return_block = self.append_block(), self.append_block()
        self.branch(condition, next_block, return_block)
        self.position_at_end(return_block)
        self.ret(Value(BIT, "false"))
        self.position_at_end(next_block)

    def advance(self, base: Value, index: Value) -> Value:
        """Return the pointer `base` advanced by `index` elements."""
        return self._append_value(base.type, f"getelementptr inbounds {base.type[:-1]}, {base}, {index}")

    def load(self, pointer: Value, align: int = 8, constant: bool = False) -> Value:
        """Return the value at the address `pointer`; `constant`: this value does not change during a call."""
        kind, metadata = pointer.type[:-1], ", !invariant.load !0" if constant else ""
        return self._append_value(kind, f"load {kind}, {pointer}, align {align}{metadata}")

    def store(self, value: Value, pointer: Value, align: int = 8) -> None:
        """Store a value at the address `pointer`."""
        self._append_line(f"store {value}, {pointer}, align {align}")

    def insert(self, vector: Value, value: Value, index: int) -> Value:
        """Return a copy of a vector with `value` in place of the element with this index."""
        return self._append_value(vector.type, f"insertelement {vector}, {value}, {WORD} {index}")

    def extract(self, vector: Value, index: int) -> Value:
        """Return the element with this index of a vector."""
        return self._append_value(element_of(vector.type), f"extractelement {vector}, {WORD} {index}")

    def shuffle(self, a: Value, b: Value, indices: Sequence[int]) -> Value:
        """Return a vector of the elements with these indices in the vector [a, b], the concatenation of a and b."""
        mask = f"<{len(indices)} x {WORD}> <{', '.join(f'{WORD} {index}' for index in indices)}>"
        return self._append_value(vector_of(element_of(a.type), len(indices)), f"shufflevector {a}, {b}, {mask}")

    def broadcast_first(self, vector: Value) -> Value:
        """Return a vector whose elements all equal the first element of `vector`."""
        mask = f"<{width_of(vector.type)} x {WORD}> zeroinitializer"
        return self._append_value(vector.type, f"shufflevector {vector}, {vector}, {mask}")

    def phi(self, kind: str) -> Phi:
        """Append a phi node to the current block, and return it; `Phi.add_incoming` adds its values."""
        phi = Phi(kind, f"%{self._n_values}", self)
        self._n_values += 1
        self.block.lines.append(phi)
        return phi

    def jump(self, block: Block) -> None:
        """End the current block by a jump to `block`."""
        self._append_line(f"br label %{block.name}")

    def branch(self, condition: Value, then: Block, otherwise: Block) -> None:
        """End the current block by a branch to `then` if the condition is true, else to `otherwise`."""
        self._append_line(f"br {condition}, label %{then.name}, label %{otherwise.name}")

    @contextmanager
    def if_then(self, condition: Value) -> Iterator[None]:
        """Return a context manager: instructions appended in its `with` block run only if `condition` is true."""
        then, after = self.append_block(), self.append_block()
        self.branch(condition, then, after)
        self.position_at_end(then)
        yield
        self.jump(after)
        self.position_at_end(after)

    def ret(self, value: Value | None) -> None:
        """Write a return from the function with the result `value`; None: without a result."""
        self._append_line("ret void" if value is None else f"ret {value}")
