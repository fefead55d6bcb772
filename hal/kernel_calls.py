"""Let one kernel call another that it was not compiled with: by address, or as the chosen row of a table.

Numba compiles whatever a kernel calls into that kernel again, at every level. ``entry`` and ``call_entry`` avoid this:
a large kernel is compiled once, by itself, and its caller holds its address. ``ChosenKernel`` compiles the row of a
table that the records are made for, and none of the other rows.
"""

# pyright: basic
# numba's extension interface has no types

from __future__ import annotations

from collections.abc import Callable, Container, Mapping
from typing import Any

from numba import typeof, types
from numba.core import cgutils
from numba.core.imputils import lower_constant
from numba.extending import intrinsic, models, register_model, typeof_impl


def entry(kernel: Any, *arguments: Any) -> int:
    """Compile or load ``kernel`` for arguments of these types and return the address of its code for ``call_entry``.

    The address holds for the life of the process and for arguments of the same types.
    """
    kinds = tuple(typeof(argument) for argument in arguments)
    kernel.compile(kinds)
    result = kernel.overloads[kinds]
    address = int(result.library.get_pointer_to_function(result.fndesc.llvm_func_name))
    assert address != 0, kernel
    return address


def _call_entry(typing_context: Any, address: Any, given: Any, state: Any, params: Any) -> Any:

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        convention, kinds = context.call_conv, signature.args[1:]
        function = convention.get_function_type(types.none, kinds)
        callee = builder.inttoptr(values[0], function.as_pointer())
        status, _ = convention.call_function(builder, callee, types.none, kinds, values[1:])
        with cgutils.if_unlikely(builder, status.is_error):
            convention.return_status_propagate(builder, status)
        return context.get_dummy_value()

    return types.void(types.int64, given, state, params), generate


call_entry: Callable[..., None] = intrinsic(_call_entry)
"""Calls, from a kernel, the kernel at an address (``entry``), which takes ``(given, state, params)`` and returns
nothing."""


class ChosenKernel:
    """Calls, from a kernel with ``(given, state, params)``, the kernel ``part`` of the row that ``state`` is for.

    ``table`` maps the name of a record to a row; the chosen row is the first whose name is a field of ``state``. Numba
    looks when it compiles the caller, so the other rows cost nothing.
    """

    def __init__(self, table: Mapping[str, Any], part: str) -> None:
        self._table, self._part = table, part

    def among(self, fields: Container[str]) -> Any:
        """Return the kernel for a state with ``fields``."""
        return getattr(self._table[next(name for name in self._table if name in fields)], self._part)

    def __call__(self, given: Any, state: Any, params: Any) -> Any:
        return self.among(state.dtype.names).py_func(given, state, params)


class _ChosenType(types.Callable, types.Opaque):
    """Numba's type of a ``ChosenKernel``: it stands for the chosen kernel's own type."""

    def __init__(self, chosen: ChosenKernel) -> None:
        self.chosen = chosen
        super().__init__(f"ChosenKernel({id(chosen)})")

    def get_call_type(self, context: Any, args: Any, kws: Any) -> Any:
        return types.Dispatcher(self.chosen.among(args[1].fields)).get_call_type(context, args, kws)

    def get_call_signatures(self) -> Any:
        return (), True

    def get_impl_key(self, sig: Any) -> Any:
        return types.Dispatcher(self.chosen.among(sig.args[1].fields)).get_impl_key(sig)


register_model(_ChosenType)(models.OpaqueModel)


@typeof_impl.register(ChosenKernel)
def _type_of(value: ChosenKernel, context: Any) -> Any:
    return _ChosenType(value)


@lower_constant(_ChosenType)
def _constant(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    return context.get_dummy_value()
