"""Names the types of arrays that every room uses. Shapes and units stand beside each array."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Numbers of any shape; the comment beside an array says which one, as in (n, 3)."""
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]
Int32Array = NDArray[np.int32]
Int16Array = NDArray[np.int16]
AnyArray = NDArray[Any]
"""Real or complex numbers, for code that takes both."""
