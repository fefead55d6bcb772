"""Run kernels as the plain Python they are written in, callees included."""

from __future__ import annotations

import sys

import pytest
from numba.core.dispatcher import Dispatcher


def without_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace every compiled kernel that a firmware module holds by its Python function, for one test."""
    for name, module in list(sys.modules.items()):
        if name.startswith("firmware_py."):
            for key, value in list(vars(module).items()):
                if isinstance(value, Dispatcher):
                    monkeypatch.setattr(module, key, value.py_func)
