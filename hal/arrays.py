"""Names the type of arrays that every room uses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Numbers of any shape; the comment beside an array says which one, as in (n, 3)."""
