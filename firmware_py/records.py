"""Parameters and states of the kernels: numpy records with named fields, each declared once.

``@record`` makes of an annotated class the layout in memory, the constructor (``new``) and the view that
kernels and the type checker see: an annotation ``state: WflcState`` is the record itself, ``Records[WflcState]`` the
one-element array around it. Every number has a unit. A record crosses from Python into a kernel as one pointer,
whatever it holds; the same numbers as separate arrays cost about 0.3 us each per call. A kernel writes
``state[0].rate``; its Python twin needs ``attributes``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, TypeVar, cast, get_args, get_origin, get_type_hints, overload

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array, ComplexArray, IntArray

# a record, or the one-element record array around it, where the type is not declared
Record = Any
_T = TypeVar("_T")
_Kind = TypeVar("_Kind", covariant=True)


class Records(Protocol[_Kind]):
    """An array of records as the type checker sees it: ``[0]`` is a record, ``["name"]`` a field of all of them."""

    dtype: np.dtype[Any]
    shape: tuple[int, ...]

    @overload
    def __getitem__(self, key: int, /) -> _Kind: ...
    @overload
    def __getitem__(self, key: str, /) -> NDArray[Any]: ...
    def __setitem__(self, key: Any, value: Any, /) -> None: ...
    def __len__(self) -> int: ...


@dataclass(frozen=True)
class Declared:
    """A field as it is written in a record's class. A length that is a name is known when the record is made."""

    unit: str
    shape: tuple[int | str, ...]


_SCALARS: tuple[tuple[Any, str, bool], ...] = (
    (float, "f8", False), (int, "i8", False), (Array, "f8", True), (IntArray, "i8", True), (ComplexArray, "c16", True),
)  # fmt: skip
"""Annotation, layout, and if the field is an array."""


def field(unit: str, *shape: int | str) -> Any:
    """Declare a field of a ``@record`` class. ``unit`` is "1" for a plain number; a record within it has none."""
    return Declared(unit, shape)


def record(kind: type[_T]) -> type[_T]:
    """Make a class of annotated ``field``s a record's declaration; fields of base classes come first.

    Raises ``TypeError`` for an annotation that has no layout, and for numbers without a unit.
    """
    hints = get_type_hints(kind)
    fields: dict[str, tuple[Any, Declared]] = dict(getattr(kind, "__record__", {}))
    for name, declared in list(vars(kind).items()):
        if isinstance(declared, Declared):
            fields[name] = _layout_of(hints[name], declared, f"{kind.__qualname__}.{name}"), declared
            delattr(kind, name)
    cast(Any, kind).__record__ = fields
    return kind


def _layout_of(hint: Any, declared: Declared, where: str) -> Any:
    for annotation, code, is_array in _SCALARS:
        if hint == annotation and is_array == bool(declared.shape) and declared.unit:
            return code
    inner = get_args(hint)[0] if get_origin(hint) is Records else hint
    if hasattr(inner, "__record__") and (inner is not hint) == bool(declared.shape):
        return inner
    raise TypeError(f"{where}: {hint} with shape {declared.shape} and unit '{declared.unit}' is no field of a record")


def _dtype(kind: type[Any], sizes: dict[str, int], values: dict[str, Any]) -> np.dtype[Any]:
    fields: list[Any] = []
    for name, (layout, declared) in cast(Any, kind).__record__.items():
        inner: Any = layout
        if not isinstance(layout, str):  # a record's own lengths are those of its value
            inner = values[name].dtype if name in values else _dtype(layout, sizes, {})
        fields.append((name, inner, tuple(_length(n, sizes, kind) for n in declared.shape)))
    return np.dtype(fields)


def _length(length: int | str, sizes: dict[str, int], kind: type[Any]) -> int:
    if isinstance(length, int):
        return length
    if length not in sizes:
        raise TypeError(f"{kind.__qualname__}: the length '{length}' is not given")
    return sizes[length]


def new(kind: type[_T], sizes: dict[str, int] | None = None, **values: Any) -> Records[_T]:
    """Return a record of zeros as a one-element array, its fields set from ``values``.

    ``sizes`` are the record's named lengths; those that an array among the values has need not be given. Raises
    ``TypeError`` for a length that nobody gives, and for one that two give differently.
    """
    lengths = dict(sizes or {})
    for name, value in values.items():
        layout, declared = cast(Any, kind).__record__[name]
        shape = np.shape(value)[1:] if not isinstance(layout, str) else np.shape(value)
        for length, n in zip(declared.shape, shape, strict=False):
            if isinstance(length, str) and lengths.setdefault(length, n) != n:
                raise TypeError(f"{kind.__qualname__}.{name}: '{length}' is {n} here and {lengths[length]} elsewhere")
    return cast("Records[_T]", new_record(_dtype(kind, lengths, values), **values))


def new_record(dtype: np.dtype[Any], **values: Any) -> Record:
    """A one-element record array of zeros, its fields set from ``values`` (nested records as one-element arrays)."""
    made = np.zeros(1, dtype)
    for name, value in values.items():
        made[name] = value
    return made


def attributes(record: Record) -> Record:
    """The same memory with fields as attributes, for Python code (too slow to hand to a kernel)."""
    return record.view(np.recarray)


def copy_record(target: Record, source: Record) -> None:
    """Overwrite ``target`` with ``source``, same dtype."""
    target[:] = source
