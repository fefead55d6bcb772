"""Call a function of Python from compiled code: virtual time stands behind such calls, never the wall clock."""

# pyright: basic
# numba's extension interface has no types

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

_Call = ctypes.CFUNCTYPE(ctypes.c_int64)


def python_call(function: Callable[[], int]) -> tuple[int, Any]:
    """Return the address by which compiled code calls ``function``, with the GIL, and the object that keeps it alive.
    ``function`` returns a number; it must not raise."""
    made = _Call(function)
    return ctypes.cast(made, ctypes.c_void_p).value or 0, made


@intrinsic
def call_python(typing_context: Any, address: Any) -> Any:
    """Call the function at ``address``, which is that of a ``python_call``. Return what it returns."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        function = ir.FunctionType(ir.IntType(64), [])
        return builder.call(builder.inttoptr(arguments[0], function.as_pointer()), [])

    return types.int64(types.int64), generate
