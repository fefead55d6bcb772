"""Every parser, on sound inputs, on what others have found (corpus), and on damaged forms of both."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz.targets import TARGETS, seeds

CORPUS = Path(__file__).with_name("corpus")
SEEDS = {
    name: [*found, *(p.read_bytes() for p in sorted((CORPUS / name).glob("*")))] for name, found in seeds().items()
}


@st.composite
def damaged(draw: st.DrawFn, sound: list[bytes]) -> bytes:
    """One of ``sound`` with a few bytes replaced, put in, taken out or repeated; or anything at all."""
    if draw(st.integers(0, 9)) == 0:
        return draw(st.binary(max_size=200))
    data = bytearray(draw(st.sampled_from(sound)))
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(data)))
        match draw(st.integers(0, 4)):
            case 0 if at < len(data):
                data[at] ^= 1 << draw(st.integers(0, 7))
            case 1:
                data[at:at] = draw(st.binary(min_size=1, max_size=8))
            case 2:
                del data[at : at + draw(st.integers(1, 40))]
            case 3:
                data[at:at] = data[at : at + draw(st.integers(1, 40))]
            case _:
                data[at : at + 4] = draw(st.sampled_from([b"\xff\xff\xff\xff", b"\0\0\0\0", b"nan ", b"1e99", b'"\\"']))
    return bytes(data)


@pytest.mark.parametrize("name", TARGETS)
def test_sound_inputs_and_the_corpus_crash_nothing(name: str) -> None:
    assert SEEDS[name]
    for data in SEEDS[name]:
        TARGETS[name](data)


@pytest.mark.parametrize("name", TARGETS)
def test_damage_ends_in_a_value_or_a_clear_error(name: str) -> None:
    target = TARGETS[name]

    @settings(max_examples=60, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
    @given(damaged(SEEDS[name]))
    def never_crashes(data: bytes) -> None:
        target(data)

    never_crashes()
