"""Compiles equations that are data to machine code: some milliseconds each, and arithmetic alone.

An interpreter of the operations takes several times as long, and numba would compile its loops anew for each twin.
"""

from __future__ import annotations

import ctypes
import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import llvmlite.binding as llvm
import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from hal.arrays import Array
from tools.guest import equations as eq
from tools.guest.equations import Program

DOUBLE = ir.DoubleType()
TAKES_REGISTERS = ir.FunctionType(ir.VoidType(), [DOUBLE.as_pointer()])
LIBRARY = "libm.so.6"
FUNCTIONS = {
    eq.EXP: "exp", eq.LOG: "log", eq.SIN: "sin", eq.COS: "cos", eq.TAN: "tan", eq.TANH: "tanh", eq.ATAN: "atan",
    eq.ATAN2: "atan2", eq.POW: "pow",
}  # fmt: skip
"""Names of functions of the C library, by operation."""


class Code(NamedTuple):
    """Holds a program as machine code at ``address``; ``registers`` and ``results`` are those of ``Program``."""

    address: int
    registers: Array
    results: NDArray[np.int64]


def _run_code(typingctx: Any, address: Any, registers: Any) -> tuple[Any, Callable[..., Any]]:
    """Run machine code on ``registers`` (r,), which change in place: the results are set, what is between is not."""

    def generated(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array = context.make_array(signature.args[1])(context, builder, args[1])
        builder.call(builder.inttoptr(args[0], TAKES_REGISTERS.as_pointer()), [array.data])
        return context.get_dummy_value()

    return types.void(types.int64, registers), generated


run_code: Any = intrinsic(_run_code)
"""``run_code(address, registers)`` within a kernel."""


def code_of(program: Program) -> Code:
    """Return the machine code of a program, compiled once in a process."""
    operations, registers, results = program
    address = _address(operations.tobytes(), registers.tobytes(), results.tobytes())
    return Code(address, registers.copy(), results)


@cache
def _address(operations: bytes, registers: bytes, results: bytes) -> int:
    name = f"program_{hashlib.sha256(operations + b'|' + registers + b'|' + results).hexdigest()}"
    of = (
        np.frombuffer(operations, np.int64).reshape(-1, 5),
        np.frombuffer(registers),
        np.frombuffer(results, np.int64),
    )
    engine = _engine()
    engine.add_module(_module(name, *of))
    engine.finalize_object()
    return int(engine.get_function_address(name))


@cache
def _engine() -> Any:
    """Return the engine that holds all code of this process."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    library = ctypes.CDLL(LIBRARY)
    for name in FUNCTIONS.values():
        address = ctypes.cast(getattr(library, name), ctypes.c_void_p).value
        assert address is not None
        llvm.add_symbol(name, address)
    machine = llvm.Target.from_default_triple().create_target_machine(opt=2)
    return llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)


@dataclass
class Writer:
    """Writes the code of a program: each operation is one or few instructions, without a branch."""

    module: ir.Module
    builder: ir.IRBuilder
    pointer: Any
    values: dict[int, Any]
    constants: dict[int, float]

    def register(self, i: int) -> Any:
        """Return the value of a register."""
        if i not in self.values:
            number = self.constants.get(i)
            self.values[i] = self.builder.load(self.at(i)) if number is None else ir.Constant(DOUBLE, number)
        return self.values[i]

    def at(self, i: int) -> Any:
        return self.builder.gep(self.pointer, [ir.Constant(ir.IntType(64), i)])

    def called(self, name: str, *args: Any) -> Any:
        found = self.module.globals.get(name)
        if found is None:
            found = ir.Function(self.module, ir.FunctionType(DOUBLE, [DOUBLE] * len(args)), name)
        return self.builder.call(found, args)

    def operation(self, code: int, i: int, j: int, k: int) -> Any:
        """Return the result of an operation on the registers ``i``, ``j`` and ``k``."""
        b, a = self.builder, self.register(i)
        zero = ir.Constant(DOUBLE, 0.0)
        plain = {eq.ADD: b.fadd, eq.SUB: b.fsub, eq.MUL: b.fmul, eq.DIV: b.fdiv}
        if code in plain:
            return plain[code](a, self.register(j))
        if code == eq.POW and self.constants.get(j) == 2.0:
            return b.fmul(a, a)
        if code in (eq.POW, eq.ATAN2):
            return self.called(FUNCTIONS[code], a, self.register(j))
        if code in FUNCTIONS:
            return self.called(FUNCTIONS[code], a)
        if code == eq.NEG:
            return b.fneg(a)
        if code in (eq.ABS, eq.SQRT):
            return self.called("llvm.fabs.f64" if code == eq.ABS else "llvm.sqrt.f64", a)
        one = ir.Constant(DOUBLE, 1.0)
        if code == eq.SIGN:
            below = b.select(b.fcmp_ordered("<", a, zero), ir.Constant(DOUBLE, -1.0), zero)
            return b.select(b.fcmp_ordered(">", a, zero), one, below)
        other = self.register(j)
        if code in (eq.MIN, eq.MAX):
            return b.select(b.fcmp_ordered("<" if code == eq.MIN else ">", other, a), other, a)
        if code in (eq.LESS, eq.LEQ):
            return b.select(b.fcmp_ordered("<" if code == eq.LESS else "<=", a, other), one, zero)
        assert code == eq.PICK
        return b.select(b.fcmp_unordered("!=", a, zero), other, self.register(k))


def _module(name: str, operations: NDArray[np.int64], registers: Array, results: NDArray[np.int64]) -> Any:
    """Return the code of a function. A register that begins with a number and is no result is a constant."""
    module = ir.Module()
    function = ir.Function(module, TAKES_REGISTERS, name)
    builder = ir.IRBuilder(function.append_basic_block())
    made = set(operations[:, 1].tolist())
    constants = {i: v for i, v in enumerate(registers.tolist()) if v != 0.0 and i not in made}
    writer = Writer(module, builder, function.args[0], {}, constants)
    for code, result, i, j, k in operations.tolist():
        writer.values[result] = writer.operation(code, i, j, k)
    for i in dict.fromkeys(results.tolist()):
        if i in made:
            builder.store(writer.values[i], writer.at(i))
    builder.ret_void()
    parsed = llvm.parse_assembly(str(module))
    parsed.verify()
    return parsed
