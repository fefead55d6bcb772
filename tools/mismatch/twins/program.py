"""Represents equations as data: parsed from text or traced from a Python function, and run as machine code.

A program is a list of operations on registers. It contains no Python code, so equations of an untrusted recording are
safe to read (``native.py`` compiles the operations).
"""

from __future__ import annotations

import ast
import math
from collections.abc import Mapping, Sequence

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
