"""Encodes a frame of the page in binary form: little endian, every array at a multiple of eight bytes.

0  uint32 kind (1)      4  uint32 subscription      8  uint32 channels c      12 uint32 buckets n
16 uint32 rows a bucket 20 uint32 flags (1: no high part, it equals low)      24 float64 first bucket
32 float64 t_s[n]       then float32 low[c][n], then float32 high[c][n]
"""

from __future__ import annotations

import struct

from tools.bench.history import Buckets

HEADER = struct.Struct("<6Id")
KIND_BUCKETS = 1
FLAG_SINGLE = 1


def encode(buckets: Buckets, subscription: int) -> bytes:
    """Return one message as bytes."""
    single = buckets.per_bucket == 1
    channels, n = buckets.low.shape
    header = HEADER.pack(
        KIND_BUCKETS, subscription, channels, n, buckets.per_bucket, FLAG_SINGLE if single else 0, float(buckets.first)
    )
    parts = [header, buckets.t_s.tobytes(), buckets.low.tobytes()]
    if not single:
        parts.append(buckets.high.tobytes())
    return b"".join(parts)
