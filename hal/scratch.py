"""Small work arrays on the stack of a compiled kernel: ``np.empty`` there is a call to the heap in every tick.

Such an array lives as long as the call that made it: hand it down, never return it or keep it. In the plain
interpreter it is an ordinary array.
"""

# pyright: basic
# numba's extension interface has no types

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, overload
from numba.np.arrayobj import make_array, populate_array
from numpy.typing import NDArray


def scratch(n: int) -> NDArray[np.float64]:
    """Return an uninitialised array (n,). ``n`` is a number or a global constant, known when the kernel is compiled."""
    return np.empty(n)


def scratch_matrix(rows: int, columns: int) -> NDArray[np.float64]:
    """Return an uninitialised array (rows, columns) in C order. Both are known when the kernel is compiled."""
    return np.empty((rows, columns))


def scratch_index(n: int) -> NDArray[np.int64]:
    """(n,) uninitialised whole numbers."""
    return np.empty(n, np.int64)


def _array_on_stack(builder: Any, context: Any, array_type: Any, shape: tuple[int, ...]) -> Any:
    size = int(np.prod(shape))
    item = context.get_value_type(array_type.dtype)
    # in the entry block: one place in the frame, also when the kernel makes it in a loop
    data = cgutils.alloca_once(builder, ir.ArrayType(item, size))
    intp: Any = context.get_value_type(types.intp)
    array = make_array(array_type)(context, builder)
    strides = [8 * int(np.prod(shape[i + 1 :])) for i in range(len(shape))]
    populate_array(
        array,
        data=builder.bitcast(data, item.as_pointer()),
        shape=[intp(n) for n in shape],
        strides=[intp(n) for n in strides],
        itemsize=intp(8),
        meminfo=None,
    )
    return array._getvalue()


@intrinsic(prefer_literal=True)
def _vector(typing_context: Any, n: Any) -> Any:
    array_type = types.Array(types.float64, 1, "C")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _array_on_stack(builder, context, array_type, (n.literal_value,))

    return array_type(n), generate


@intrinsic(prefer_literal=True)
def stack_index(typing_context: Any, n: Any) -> Any:
    """(n,) whole numbers like ``scratch_index``, for compiled code alone: the place is in the frame of the kernel that
    calls this, so that a function of C may be given its address."""
    array_type = types.Array(types.int64, 1, "C")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _array_on_stack(builder, context, array_type, (n.literal_value,))

    return array_type(n), generate


@intrinsic(prefer_literal=True)
def _matrix(typing_context: Any, rows: Any, columns: Any) -> Any:
    array_type = types.Array(types.float64, 2, "C")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _array_on_stack(builder, context, array_type, (rows.literal_value, columns.literal_value))

    return array_type(rows, columns), generate


@overload(scratch, prefer_literal=True, strict=False)
def _scratch(n: Any) -> Any:
    if isinstance(n, types.IntegerLiteral):
        return lambda n: _vector(n)  # pyright: ignore[reportCallIssue]
    return None


@overload(scratch_index, prefer_literal=True, strict=False)
def _scratch_index(n: Any) -> Any:
    if isinstance(n, types.IntegerLiteral):
        return lambda n: stack_index(n)  # pyright: ignore[reportCallIssue]
    return None


@overload(scratch_matrix, prefer_literal=True, strict=False)
def _scratch_matrix(rows: Any, columns: Any) -> Any:
    if isinstance(rows, types.IntegerLiteral) and isinstance(columns, types.IntegerLiteral):
        return lambda rows, columns: _matrix(rows, columns)  # pyright: ignore[reportCallIssue]
    return None
