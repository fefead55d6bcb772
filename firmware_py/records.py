"""Parameters and states of the kernels: numpy records with named fields.

A record crosses from Python into a kernel as one pointer, whatever it holds; the same numbers as separate
arrays cost about 0.3 us each per call. A kernel writes ``state[0].rate``; its Python twin needs ``attributes``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

# a record, or the one-element record array around it; its fields are known to its dtype, not to the type checker
Record = Any


def new_record(dtype: np.dtype[Any], **values: Any) -> Record:
    """A one-element record array of zeros, its fields set from ``values`` (nested records as one-element arrays)."""
    record = np.zeros(1, dtype)
    for name, value in values.items():
        record[name] = value
    return record


def attributes(record: Record) -> Record:
    """The same memory with fields as attributes, for Python code (too slow to hand to a kernel)."""
    return record.view(np.recarray)


def copy_record(target: Record, source: Record) -> None:
    """Overwrite ``target`` with ``source``, same dtype."""
    target[:] = source
