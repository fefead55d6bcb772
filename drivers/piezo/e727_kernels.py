"""Encodes the E-727's commands in a compiled kernel, which the driver and a compiled loop call.

Importing this module imports numba; the driver does so when it asks the controller who it is, before a ramp can be due.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hal.compiled import kernel

TEXT_BYTES = 80
"""Room for a command with three values of up to 15 digits before the decimal point."""
VERBS = np.frombuffer(b"SVA MOV ", np.uint8).reshape(2, 4).copy()
DECIMALS = 10_000
LIMB = 1 << 26
HALF = LIMB // 2
SPACE, MINUS, POINT, ZERO, LINE_FEED = 32, 45, 46, 48, 10


@kernel
def encode(text: NDArray[np.uint8], servo: bool, values_V: NDArray[np.float64], per_V: float) -> int:
    """Write ``SVA 1 ... 2 ... 3 ...``, with ``servo`` ``MOV``, of ``values_V`` (3,) times ``per_V`` to ``text``, of at
    least TEXT_BYTES. Return its length, line feed included. The values must be finite and smaller than 1e15."""
    verb = VERBS[1 if servo else 0]
    for i in range(len(verb)):
        text[i] = verb[i]
    at = len(verb)
    for axis in range(3):
        text[at], text[at + 1] = ZERO + 1 + axis, SPACE
        at = put_decimal(text, at + 2, values_V[axis] * per_V)
        text[at] = SPACE if axis < 2 else LINE_FEED
        at += 1
    return at


@kernel
def put_decimal(text: NDArray[np.uint8], at: int, value: float) -> int:
    """Write ``value`` to ``text[at:]`` with four decimals, rounded correctly, ties to even, as ``f"{value:.4f}"`` does.
    Return the place after it.

    The fraction is multiplied by 10000 in whole numbers of 26 bits each; 78 bits hold every fraction that can round up.
    """
    if math.copysign(1.0, value) < 0.0:
        text[at] = MINUS
        at += 1
        value = -value
    whole = int(value)
    rest = (value - whole) * LIMB
    high = int(rest)
    rest = (rest - high) * LIMB
    middle = int(rest)
    low = int((rest - middle) * LIMB) * DECIMALS
    middle = middle * DECIMALS + low // LIMB
    high = high * DECIMALS + middle // LIMB
    digits, left = high // LIMB, high % LIMB
    beyond = middle % LIMB + low % LIMB > 0
    if left > HALF or (left == HALF and (beyond or digits % 2 == 1)):
        digits += 1
    if digits == DECIMALS:
        whole += 1
        digits = 0
    size = 1
    while whole // 10**size > 0:
        size += 1
    for i in range(size):
        text[at + size - 1 - i] = ZERO + whole % 10
        whole //= 10
    at += size
    text[at] = POINT
    for i in range(4):
        text[at + 4 - i] = ZERO + digits % 10
        digits //= 10
    return at + 5
