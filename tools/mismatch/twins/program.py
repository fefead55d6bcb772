"""Represents equations as data: parsed from text or traced from a Python function, run by a compiled interpreter.

A program is a list of operations on registers. It contains no Python code, so equations of an untrusted recording are
safe to read, and no new equation has to be compiled.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Mapping, Sequence

import numpy as np

from hal.compiled import inlined_kernel
from tools.guest.equations import (
    ADD,
    DIV,
    FUNCTIONS,
    LEQ,
    LESS,
    MUL,
    NEG,
    PICK,
    POW,
    SUB,
    Builder,
    EquationError,
    called,
)


@inlined_kernel
def run_program(operations, registers):
    """Carry out the operations; ``registers`` (r,) change in place."""
    for i in range(operations.shape[0]):
        code = operations[i, 0]
        a = registers[operations[i, 2]]
        b = registers[operations[i, 3]]
        # arithmetic is tested first: a long chain of comparisons costs more than the operation
        if code < 4:
            if code < 2:
                v = a + b if code == 0 else a - b
            else:
                v = a * b if code == 2 else a / b
        elif code < 10:
            if code == 4:
                v = a * a if b == 2.0 else a**b
            elif code == 5:
                v = -a
            elif code == 6:
                v = abs(a)
            elif code == 7:
                v = 1.0 if a > 0.0 else (-1.0 if a < 0.0 else 0.0)
            elif code == 8:
                v = np.sqrt(a)
            else:
                v = np.exp(a)
        elif code < 17:
            if code == 10:
                v = np.log(a)
            elif code == 11:
                v = np.sin(a)
            elif code == 12:
                v = np.cos(a)
            elif code == 13:
                v = np.tan(a)
            elif code == 14:
                v = np.tanh(a)
            elif code == 15:
                v = np.arctan(a)
            else:
                v = np.arctan2(a, b)
        elif code == 17:
            v = min(a, b)
        elif code == 18:
            v = max(a, b)
        elif code == 19:
            v = 1.0 if a < b else 0.0
        elif code == 20:
            v = 1.0 if a <= b else 0.0
        else:
            v = b if a != 0.0 else registers[operations[i, 4]]
        registers[operations[i, 1]] = v


_BINARY: Mapping[type[ast.operator], int] = {ast.Add: ADD, ast.Sub: SUB, ast.Mult: MUL, ast.Div: DIV, ast.Pow: POW}
_COMPARED: Mapping[type[ast.cmpop], tuple[int, bool]] = {
    ast.Lt: (LESS, False), ast.Gt: (LESS, True), ast.LtE: (LEQ, False), ast.GtE: (LEQ, True),
}  # fmt: skip


def parse(builder: Builder, texts: Mapping[str, str], wanted: Sequence[str]) -> list[int]:
    """Registers of the equations ``wanted``. ``texts``: equations by name; one may use another by its name, unless a
    variable has that name. Raises EquationError.
    """
    at = {name: i for i, name in enumerate(builder.names)}
    under_way: list[str] = []
    done: dict[str, int] = {}

    def named(name: str, where: str) -> int:
        if name in at:
            return at[name]
        if name == "pi":
            return builder.constant(math.pi)
        if name not in texts:
            known = ", ".join((*builder.names, *(t for t in texts if t.isidentifier())))
            raise EquationError(f"equation of '{where}': '{name}' is no state, input or parameter; known: {known}")
        if name in under_way:
            raise EquationError(f"equation of '{where}': '{name}' is defined by itself ({' -> '.join(under_way)})")
        return equation(name)

    def equation(name: str) -> int:
        if name not in done:
            under_way.append(name)
            try:
                tree = ast.parse(texts[name].strip(), mode="eval")
            except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
                why = error.msg if isinstance(error, SyntaxError) else error
                raise EquationError(f"equation of '{name}': '{texts[name]}' cannot be read ({why})") from None
            try:
                done[name] = value(tree.body, name)
            except RecursionError:
                raise EquationError(f"equation of '{name}' is nested too deeply") from None
            under_way.pop()
        return done[name]

    def value(node: ast.expr, where: str) -> int:
        match node:
            case ast.Constant(value=bool() | int() | float() as number):
                return builder.constant(float(number))
            case ast.Name(id=name):
                return named(name, where)
            case ast.BinOp(left=left, op=op, right=right) if type(op) in _BINARY:
                return builder.operation(_BINARY[type(op)], value(left, where), value(right, where))
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return builder.operation(NEG, value(operand, where))
            case ast.UnaryOp(op=ast.UAdd(), operand=operand):
                return value(operand, where)
            case ast.IfExp(test=test, body=body, orelse=other):
                return builder.operation(PICK, value(test, where), value(body, where), value(other, where))
            case ast.Compare(left=left, ops=[op], comparators=[right]) if type(op) in _COMPARED:
                code, turned = _COMPARED[type(op)]
                a, b = value(left, where), value(right, where)
                return builder.operation(code, b, a) if turned else builder.operation(code, a, b)
            case ast.Call(func=ast.Name(id=name), args=args, keywords=[]):
                return called(builder, name, [value(a, where) for a in args], where)
            case ast.BinOp(op=ast.BitXor()):
                raise EquationError(f"equation of '{where}': '{ast.unparse(node)}': write a power as **, not ^")
            case _:
                raise EquationError(
                    f"equation of '{where}': '{ast.unparse(node)}' is not allowed; use numbers, names, + - * / ** < >,"
                    f" 'a if b else c' and {', '.join(FUNCTIONS)}"
                )

    return [equation(name) if name in texts else named(name, name) for name in wanted]
