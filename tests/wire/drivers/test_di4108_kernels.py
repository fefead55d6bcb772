"""The DI-4108's kernels over streams that are split, lossy and damaged: the pieces they come in change no scan."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.daq import di4108_kernels as kernels
from firmware_py.records import attributes
from hal import scan_time_kernel

MS = 1_000_000
PACKET = 16
COMPILED = (
    (kernels, ("accept", "decode", "_ends_with_overflow", "stamp_kernel", "shifted_kernel")),
    (scan_time_kernel, ("_close_window",)),
)
Piece = tuple[int, bytes]
"""When a read returned (ns), and what."""


def scans(n: int, seed: int) -> NDArray[np.int16]:
    return np.random.default_rng(seed).integers(-32768, 32768, (n, 8)).astype("<i2")


def live(data: bytes, rng: np.random.Generator) -> list[Piece]:
    """Each packet is read within 0.3 ms of its scan, in up to three pieces; now and then several packets at once."""
    pieces: list[Piece] = []
    at, t_ns = 0, 10 * MS
    while at < len(data):
        size = PACKET * (1 if rng.random() < 0.9 else int(rng.integers(2, 9)))
        packet, at = data[at : at + size], at + size
        t_ns += size // PACKET * MS
        cuts = sorted({0, len(packet), *map(int, rng.integers(0, len(packet) + 1, int(rng.integers(0, 3))))})
        late_ns = int(rng.integers(0, 200_000))
        for i, (begin, end) in enumerate(pairwise(cuts)):
            pieces.append((t_ns + late_ns + 20_000 * i, packet[begin:end]))
    return pieces


def damaged(pieces: list[Piece], rng: np.random.Generator) -> list[Piece]:
    """Bytes are lost, inserted or changed in a few of the pieces; some streams end with an overflow."""
    pieces = list(pieces)
    for _ in range(int(rng.integers(1, 4))):
        k = int(rng.integers(len(pieces)))
        t_ns, data = pieces[k]
        at, n = int(rng.integers(0, len(data) + 1)), int(rng.choice([1, 3, 16, 17]))
        kept = data[:at] + data[at + n :]
        pieces[k] = (t_ns, [kept, data[:at] + rng.bytes(n) + data[at:], bytes(255 - b for b in data)][rng.integers(3)])
    if rng.random() < 0.5:
        pieces[rng.integers(len(pieces)) :] = [(pieces[-1][0], b"stop 01")]
    return [piece for piece in pieces if piece[1]]


def read(pieces: list[Piece], *, plain: bool = False) -> tuple[list[tuple[int, ...]], NDArray[np.int16], int]:
    """Return what ``decode`` said of each read, all rows, and the last verdict; reading ends with the first bad one.
    ``plain``: the state allows the kernels' Python functions."""
    stream = kernels.new_stream(8, PACKET, 1000.0)
    if plain:
        stream = attributes(stream)
    room, rows = np.zeros(4096, np.uint8), np.zeros((64, 8), np.int16)
    said, every, verdict = [], [np.zeros((0, 8), np.int16)], kernels.WAIT
    for t_ns, data in pieces:
        end = int(stream["end"][0])
        room[end : end + len(data)] = np.frombuffer(data, np.uint8)
        verdict = int(kernels.accept(stream, room, len(data), t_ns))
        if verdict != kernels.WAIT:
            found = tuple(map(int, kernels.decode(stream, room, rows)))
            said.append(found)
            every.append(rows[: found[0]].copy())
        if verdict in (kernels.OVERFLOWED, kernels.MISALIGNED):
            break
    return said, np.concatenate(every), verdict


@pytest.mark.parametrize("seed", range(40))
def test_the_pieces_of_a_stream_change_no_scan(seed: int) -> None:
    truth = scans(500, seed)
    said, rows, _ = read(live(truth.tobytes(), np.random.default_rng(seed)))
    np.testing.assert_array_equal(rows, truth)
    firsts = [seq0 for _, _, seq0, *_ in said]
    np.testing.assert_array_equal(firsts, np.cumsum([0, *(n for n, *_ in said)])[:-1])


@pytest.mark.parametrize("seed", range(40))
def test_what_follows_lost_bytes_is_never_taken_for_scans(seed: int) -> None:
    """Whole packets that are lost leave no trace in the bytes; the timeline counts them by the device's clock."""
    rng = np.random.default_rng(seed)
    truth = scans(300, seed)
    data = bytearray(truth.tobytes())
    at, n = int(rng.integers(0, 200 * PACKET)), int(rng.choice([1, 2, 7, 15, 17, 33]))
    del data[at : at + n]
    # the device goes on sending a packet a millisecond; what is left of the torn one comes when it is sent
    pieces, sent, t_ns = list[Piece](), 0, 10 * MS
    for edge in range(PACKET, len(truth) * PACKET + 1, PACKET):
        t_ns += MS
        end = edge if edge <= at else max(at, edge - n)
        if end > sent:
            pieces.append((t_ns, bytes(data[sent:end])))
            sent = end
    _, rows, verdict = read(pieces)
    assert verdict == kernels.MISALIGNED
    np.testing.assert_array_equal(rows, truth[: at // PACKET])


@pytest.mark.parametrize("seed", range(40))
def test_compiled_kernels_are_their_python(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bit for bit, over damaged streams: rows, times, numbers, losses and verdicts."""
    rng = np.random.default_rng(seed)
    pieces = damaged(live(scans(400, seed).tobytes(), rng), rng)
    compiled = read(pieces)
    for module, names in COMPILED:
        for name in names:
            monkeypatch.setattr(module, name, getattr(module, name).py_func)
    python = read(pieces, plain=True)
    assert compiled[0] == python[0]
    np.testing.assert_array_equal(compiled[1], python[1])
    assert compiled[2] == python[2]


def test_the_damage_reaches_every_verdict() -> None:
    """Else the comparison above would compare little."""
    seen = set()
    for seed in range(40):
        rng = np.random.default_rng(seed)
        seen.add(read(damaged(live(scans(400, seed).tobytes(), rng), rng))[2])
    assert seen >= {kernels.READY, kernels.OVERFLOWED, kernels.MISALIGNED}
