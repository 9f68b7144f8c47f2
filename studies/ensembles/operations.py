"""Operations on floating-point numbers: those that code for lanes makes, counted as it runs; the most there can be.

Counted are additions, subtractions, multiplications and divisions, a fused one twice, in all lanes, those that stand
idle too; not so what the kernels add that lead the lanes.
"""

import ctypes
import re
import time
from collections.abc import Callable, Sequence

import numpy as np

from twoloop.kernels.compile.own_functions import OwnFunctions, object_code

COUNT = "operations_so_far"
_PLAIN = re.compile(r"= f(?:add|sub|mul|div) [^<%]*?(?:<(\d+) x )?double")
_FUSED = re.compile(r"call [^@]*@llvm\.fma\.(?:v(\d+))?f64\(")
CHAINS = 12  # of fused operations that do not wait for one another: 16 registers hold them and their operands
TIMES, ROUNDS = 2_000_000, 5  # that each is made in a call, and calls, of which the fastest counts


def counting(text: str) -> str:
    """The text of a module whose blocks count their operations, with a function COUNT that returns the sum so far."""
    lines: list[str] = []
    for function in re.split(r"^(?=define )", text, flags=re.MULTILINE):
        for block in re.split(r"^(?=\w+:$)", function, flags=re.MULTILINE):
            lines.append(_counted(block, len(lines)))
    variable = f"@{COUNT}.number = internal global i64 0\n"
    read = f"\ndefine i64 @{COUNT}() {{\n %1 = load i64, i64* @{COUNT}.number\n ret i64 %1\n}}\n"
    return variable + "".join(lines) + read


def _counted(block: str, number: int) -> str:
    """A block, which begins with its label, or what is before the first one of a function."""
    label, *rest = block.splitlines(keepends=True)
    made = sum(int(width or 1) for width in _PLAIN.findall(block)) + sum(
        2 * int(width or 1) for width in _FUSED.findall(block)
    )
    if not re.fullmatch(r"\w+:\n", label) or made == 0:
        return block
    n_phis = sum(" = phi " in line for line in rest)  # which come first
    before, after = f"%{COUNT}.before.{number}", f"%{COUNT}.after.{number}"
    adding = f" {before} = load i64, i64* @{COUNT}.number\n {after} = add i64 {before}, {made}\n"
    adding += f" store i64 {after}, i64* @{COUNT}.number\n"
    return "".join([label, *rest[:n_phis], adding, *rest[n_phis:]])


def compiled(names: Sequence[str], text: str) -> OwnFunctions:
    """Functions of a module, which are not kept on the disk."""
    return OwnFunctions(list(names), object_code(text))


def count_of(functions: OwnFunctions) -> Callable[[], int]:
    """What returns the operations so far."""
    return ctypes.CFUNCTYPE(ctypes.c_int64)(functions.addresses[COUNT])


def most(width: int) -> float:
    """Operations a second that one core makes, at most: fused ones on vectors of this width, in independent chains."""
    vector, fma = f"<{width} x double>", f"@llvm.fma.v{width}f64"
    chains = range(CHAINS)
    lines = [f"declare {vector} {fma}({vector}, {vector}, {vector})", "define void @chains(i64 %n, double* %x) {"]
    lines += [
        "start:",
        f" %p = bitcast double* %x to {vector}*",
        f" %a = load {vector}, {vector}* %p",
        " br label %loop",
    ]
    lines += ["loop:", " %i = phi i64 [0, %start], [%j, %loop]"]
    lines += [f" %v{k} = phi {vector} [%a, %start], [%w{k}, %loop]" for k in chains]
    lines += [f" %w{k} = call {vector} {fma}({vector} %v{k}, {vector} %a, {vector} %a)" for k in chains]
    lines += [" %j = add i64 %i, 1", " %more = icmp slt i64 %j, %n", " br i1 %more, label %loop, label %end", "end:"]
    lines += [f" %s{k} = fadd {vector} {f'%s{k - 1}' if k else '%a'}, %w{k}" for k in chains]
    lines += [f" store {vector} %s{CHAINS - 1}, {vector}* %p", " ret void", "}", ""]
    functions, x = compiled(["chains"], "\n".join(lines)), np.full(2 * width, 0.5)
    call = ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_void_p)(functions.addresses["chains"])
    aligned = x.ctypes.data + -x.ctypes.data % (8 * width)
    fastest = np.inf
    for _ in range(ROUNDS):
        began = time.process_time()
        call(TIMES, aligned)
        fastest = min(fastest, time.process_time() - began)
    return 2.0 * width * CHAINS * TIMES / fastest
