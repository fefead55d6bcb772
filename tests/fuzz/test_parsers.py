"""Every parser, on sound inputs, on what others have found (corpus), and on damaged forms of both."""

from __future__ import annotations

import io
import random
import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.motion_card_protocol import LineParser
from firmware_py.recording.errors import RecordingError as OwnRecordingError
from firmware_py.recording.reader import Recording
from hal.bench import load_bench
from hal.npz import NpzError, open_npz
from sim_devices.plant.hand_file import load_hand
from tests.fuzz.mcap_parts import change, change_some_bytes, put_together, take_apart
from tests.fuzz.targets import TARGETS, seeds
from tools.errors import RecordingError
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
    np.savez_compressed(path, x=np.zeros(1 << 24))
    assert path.stat().st_size < 200_000
    with open_npz(path) as npz, pytest.raises(NpzError, match="claims 134217728 bytes; of a file of this size"):
        npz["x"]
    np.savez(path, x=np.array([{}], dtype=object))
    with open_npz(path) as npz, pytest.raises(NpzError, match="pickled"):
        npz["x"]


@pytest.mark.parametrize(
    "array",
    [
        np.arange(300_000.0),
        np.asfortranarray(np.arange(12.0).reshape(3, 4)),
        np.array(7),
        np.empty((0, 3)),
        np.array([True, False]),
        np.array([[1, 2], [3, 4]], dtype=">i2"),
    ],
)
def test_arrays_of_every_shape_come_out_as_they_went_in(tmp_path: Path, array: np.ndarray) -> None:
    np.savez_compressed(tmp_path / "a.npz", x=array)
    with open_npz(tmp_path / "a.npz") as npz:
        read = npz["x"]
    assert read.dtype == array.dtype
    assert read.shape == array.shape
    assert np.array_equal(read, array)
    assert read.flags.writeable


@pytest.mark.parametrize("name", TARGETS)
def test_damage_ends_in_a_value_or_a_clear_error(name: str) -> None:
    target = TARGETS[name]

    @settings(max_examples=60, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
    @given(damaged(SEEDS[name]))
    def never_crashes(data: bytes) -> None:
        target(data)

    never_crashes()


@pytest.mark.parametrize("name", ["own_recording", "columns_mcap"])
def test_hostile_content_behind_right_crcs_ends_in_a_value_or_a_clear_error(name: str) -> None:
    """The changes are those of the coverage-guided fuzzer (run.py): a recording taken apart and put together again."""
    target = TARGETS[name]

    @settings(max_examples=250, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
    @given(st.sampled_from(SEEDS[name]), st.randoms(use_true_random=False))
    def never_crashes(data: bytes, rng: random.Random) -> None:
        target(change(data, rng, change_some_bytes))

    never_crashes()


def test_the_structural_changes_pass_the_crcs(tmp_path: Path) -> None:
    """A mutator whose files are all refused at the first CRC would find nothing."""
    path = tmp_path / "r.mcap"
    opened = 0
    for seed in range(200):
        path.write_bytes(change(SEEDS["own_recording"][0], random.Random(seed), change_some_bytes))
        with suppress(OwnRecordingError):
            opened += "CRC" not in " ".join(Recording(path).health.lines())
    assert opened > 60
    path.write_bytes(put_together(take_apart(SEEDS["own_recording"][0]) or []))
    assert not Recording(path).health.lost
    assert Recording(path).n_rows == 20
