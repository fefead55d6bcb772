"""Every parser, on sound inputs, on what others have found (corpus), and on damaged forms of both."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.motion_card_protocol import LineParser
from firmware_py.recording.reader import Recording
from hal.bench import load_bench
from hal.npz import NpzError, open_npz
from sim_devices.plant.hand_file import load_hand
from tests.fuzz.targets import TARGETS, seeds
from tools.mismatch.recording import RecordingError
from tools.mismatch.recording_columns import column_names, read_columns
from tools.mismatch.twins.fmu import check_archive

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


def test_the_first_seeds_are_really_read(tmp_path: Path) -> None:
    """A parser that refuses everything would pass all the other tests."""

    def written(name: str, suffix: str) -> Path:
        path = tmp_path / f"{name}{suffix}"
        path.write_bytes(SEEDS[name][0])
        return path

    assert read_columns(written("columns_csv", ".csv"), ["t", "x"])["x"][3] == 1.5
    assert read_columns(written("columns_npz", ".npz"), ["t", "x"])["t"][2] == 0.002
    assert read_columns(written("columns_mcap", ".mcap"), ["log.x", "log.y.1"])["log.x"].tolist() == list(range(10))
    assert "log.y.0" in column_names(written("columns_mcap", ".mcap"))
    assert Recording(written("own_recording", ".mcap")).n_rows == 20
    assert load_bench(written("bench_toml", ".toml")).description.name == "micron"
    assert load_hand(written("hand_csv", ".csv"))
    assert load_hand(written("hand_npz", ".npz"))
    check_archive(written("fmu_archive", ".fmu"))
    assert LineParser("raw").feed(SEEDS["motion_card_lines"][0])[0].values[3] == -4.0


def test_an_archive_that_would_unpack_outside_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bad.fmu"
    path.write_bytes(SEEDS["fmu_archive"][1])
    with pytest.raises(RecordingError, match="outside its folder"):
        check_archive(path)


def test_an_array_that_claims_more_than_the_file_holds_is_refused_before_it_is_made(tmp_path: Path) -> None:
    """A header of 128 bytes that claims 8 TB; and one whose zeros unpack to more than is allowed."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    path = tmp_path / "liar.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("x.npy", header.getvalue())
    with open_npz(path) as npz, pytest.raises(NpzError, match="claims 8000000000000 bytes"):
        npz["x"]
    np.savez_compressed(path, x=np.zeros(100_000))
    with open_npz(path, most_bytes=1000) as npz, pytest.raises(NpzError, match="claims 800000 bytes"):
        npz["x"]
    np.savez(path, x=np.array([{}], dtype=object))
    with open_npz(path) as npz, pytest.raises(NpzError, match="pickled"):
        npz["x"]


@pytest.mark.parametrize("name", TARGETS)
def test_damage_ends_in_a_value_or_a_clear_error(name: str) -> None:
    target = TARGETS[name]

    @settings(max_examples=60, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
    @given(damaged(SEEDS[name]))
    def never_crashes(data: bytes) -> None:
        target(data)

    never_crashes()
