"""MATLAB files of both formats: vectors, matrices, structs, single numbers; torn and foreign files are one message."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from tools.errors import RecordingError
from tools.mismatch.recording_columns import column_names, read_blocks, read_columns, read_scalars

T, U = np.arange(200) * 0.01, np.sin(np.arange(200) * 0.1)


def v5(path: Path, compressed: bool = False) -> Path:
    content = {"t": T[:, None], "d": {"u": U[None, :], "k": 3.0}, "xy": np.stack([U, T]), "fs": 100.0, "who": "me"}
    savemat(path, content, do_compression=compressed)
    return path


def v73(path: Path) -> Path:
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in (("t", T[None, :]), ("xy", np.stack([U, T])), ("fs", np.array([[100.0]]))):
            file[name] = value
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
        file["d/u"] = U[:, None]
        file["who"] = np.array([[109], [101]], np.uint16)
        file["who"].attrs["MATLAB_class"] = np.bytes_("char")
        file["#refs#/a"] = U
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512))
    return path


@pytest.mark.parametrize("form", ["v5", "v5 compressed", "v4", "v7.3"])
def test_every_format(tmp_path: Path, form: str):
    path = tmp_path / "a.mat"
    if form == "v4":
        savemat(path, {"t": T, "xy": np.stack([U, T]), "fs": 100.0}, format="4")
    else:
        v73(path) if form == "v7.3" else v5(path, form == "v5 compressed")
    names = column_names(path)
    assert sorted(names) == ["d.u"] * (form != "v4") + ["t", "xy_1", "xy_2"]
    found = read_columns(path, names)
    np.testing.assert_array_equal(found["t"], T)
    np.testing.assert_array_equal(found["xy_1"], U)
    assert form == "v4" or (found["d.u"] == U).all()
    assert read_scalars(path)["fs"] == 100.0


@pytest.mark.parametrize("form", ["v5", "v5 compressed", "v7.3"])
@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_a_torn_file_is_one_message(tmp_path: Path, form: str, share: float):
    path = tmp_path / "a.mat"
    data = (v73(path) if form == "v7.3" else v5(path, form == "v5 compressed")).read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(RecordingError, match=r"a\.mat: torn"):
        column_names(path)


def test_foreign_and_empty_files(tmp_path: Path):
    path = tmp_path / "a.mat"
    for content, message in ((b"", "is empty"), (b"t,u\n1,2\n" * 100, "not a readable MATLAB file")):
        path.write_bytes(content)
        with pytest.raises(RecordingError, match=message):
            column_names(path)


def test_a_claim_of_gigabytes_is_refused_before_it_is_believed(tmp_path: Path):
    import struct
    import zlib

    packed = zlib.compress(struct.pack("<II", 14, 3 << 30) + bytes(64))
    head = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM"
    (tmp_path / "a.mat").write_bytes(head + struct.pack("<II", 15, len(packed)) + packed)
    with pytest.raises(RecordingError, match="unpacks to more than 2 GiB"):
        column_names(tmp_path / "a.mat")


def test_other_files_come_in_one_block(tmp_path: Path):
    (block,) = read_blocks(v5(tmp_path / "a.mat"), ["t"])
    np.testing.assert_array_equal(block["t"], T)


@pytest.mark.parametrize("seed", range(200))
def test_a_damaged_file_never_ends_the_process(tmp_path: Path, seed: int):
    """Any bytes of the variables may be wrong: they are read as other numbers, or there is one message."""
    rng = np.random.default_rng(seed)
    data = bytearray(v5(tmp_path / "a.mat", compressed=seed % 4 == 0).read_bytes())
    for at in rng.integers(128, 600, rng.integers(1, 4)):
        data[int(at)] = int(rng.integers(256))
    (tmp_path / "a.mat").write_bytes(data)
    with contextlib.suppress(RecordingError):
        read_columns(tmp_path / "a.mat", column_names(tmp_path / "a.mat")[:1])


def test_a_type_that_does_not_exist_is_damage(tmp_path: Path):
    data = v5(tmp_path / "a.mat").read_bytes()
    at = data.index(T.tobytes()) - 8
    (tmp_path / "a.mat").write_bytes(data[:at] + b"\x4a\x00\x00\x00" + data[at + 4 :])
    with pytest.raises(RecordingError, match="is damaged"):
        column_names(tmp_path / "a.mat")
