"""Makes named random streams: one seed gives one physical unit, whatever else is drawn."""

from __future__ import annotations

import zlib

import numpy as np


def stream(seed: int, name: str) -> np.random.Generator:
    """Return the generator for one purpose. Streams of different names are independent; adding one changes no other."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])
