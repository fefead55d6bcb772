"""Run kernels as the plain Python they are written in, callees included."""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

from firmware_py.records import attributes


def without_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace every compiled kernel that a firmware module holds by its Python function, for one test."""
    for name, module in list(sys.modules.items()):
        if name.startswith("firmware_py."):
            for key, value in list(vars(module).items()):
                if isinstance(value, Dispatcher):
                    monkeypatch.setattr(module, key, value.py_func)


def assert_kernel_is_python(
    monkeypatch: pytest.MonkeyPatch, module: ModuleType, kernel: str, fresh: Any, before: np.ndarray, after: np.ndarray,
    *, rtol: float = 1e-9, atol: float,
) -> None:  # fmt: skip
    """``after`` (n, columns) is what the compiled ``module.kernel`` made of the frames ``before``: its Python function
    makes the same of them, frame by frame, with the state of the stage ``fresh``, which has not stepped yet."""
    without_compiler(monkeypatch)
    for frame in before:
        getattr(module, kernel)(frame, attributes(fresh.state), attributes(fresh.params))
    np.testing.assert_allclose(before, after, rtol=rtol, atol=atol)
