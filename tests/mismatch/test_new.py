"""``micron mismatch new``: what it writes loads at once, what it cannot know it says, bad input is one message."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat
from typer.testing import CliRunner, Result

from tools.cli.main import app
from tools.mismatch.recording_load import load

N, RATE = 600, 200.0
T = np.arange(N) / RATE
FORCE, X = 8 * np.sin(4.4 * T), 20 * np.cos(4.4 * T)


def call(*words: object) -> Result:
    return CliRunner().invoke(app, ["mismatch", "new", *map(str, words)])


def contents(folder: Path) -> dict[Path, bytes]:
    return {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def refused(*words: object) -> str:
    """The message of a call that ends with status 2 and leaves the folder as it was."""
    folder = Path(str(words[0])).parent
    before = contents(folder)
    result = call(*words)
    assert result.exit_code == 2, result.output
    assert contents(folder) == before
    assert result.stderr.startswith("micron: ")
    return result.stderr


def csv(path: Path, header: str, *columns: np.ndarray, delimiter: str = ",", decimal: str = ".") -> Path:
    rows = (delimiter.join(f"{v:.9g}" for v in row).replace(".", decimal) for row in zip(*columns, strict=True))
    path.write_text("\n".join([*([header] if header else []), *rows]) + "\n")
    return path


@pytest.mark.parametrize(
    "form", ["csv", "decimal comma", "milliseconds", "units in a row", "npz", "mat", "nc", "parquet"]
)
def test_what_is_written_loads_at_once(tmp_path: Path, form: str):
    data = tmp_path / "data.csv"
    if form == "decimal comma":
        csv(data, "Time (s);Force [N];pos [mm]", T, FORCE, X, delimiter=";", decimal=",")
    elif form == "milliseconds":
        csv(data, "t_ms,force_N,pos_mm", 1e3 * T, FORCE, X)
    elif form == "units in a row":
        csv(data, "time\tforce\tpos\ns\tN\tmm", T, FORCE, X, delimiter="\t")
    elif form == "npz":
        data = tmp_path / "data.npz"
        np.savez(data, force_N=FORCE, pos_mm=X, fs=RATE)
    elif form == "mat":
        data = tmp_path / "data.mat"
        savemat(data, {"rig": {"force_N": FORCE[:, None], "pos_mm": X[:, None]}, "Ts": 1 / RATE})
    elif form == "nc":
        xarray = pytest.importorskip("xarray")
        data = tmp_path / "data.nc"
        units = {"force": "N", "pos": "mm"}
        columns = {k: ("time", v, {"units": units[k]}) for k, v in (("force", FORCE), ("pos", X))}
        xarray.Dataset(columns, {"time": ("time", T, {"units": "s"})}).to_netcdf(data, engine="h5netcdf")
    elif form == "parquet":
        pyarrow = pytest.importorskip("pyarrow")
        parquet = pytest.importorskip("pyarrow.parquet")
        data = tmp_path / "data.parquet"
        parquet.write_table(pyarrow.table({"t_s": T, "force_N": FORCE, "pos_mm": X}), data)
    else:
        csv(data, "t_s,force_N,pos_mm", T, FORCE, X)
    result = call(data)
    assert result.exit_code == 0, result.output
    assert "could not be known" not in result.stderr
    assert (tmp_path / "recording.png").read_bytes().startswith(b"\x89PNG")
    found = load(tmp_path)
    assert (found.n, found.twin.kind) == (N, "mechanical_axis")
    assert 1 / found.dt == pytest.approx(RATE)
    np.testing.assert_allclose(found.inputs["force"], FORCE, atol=1e-6)
    np.testing.assert_allclose(found.outputs["position"], 1e-3 * X, atol=1e-9)


def test_what_it_cannot_know_is_said_and_stands_in_the_file(tmp_path: Path):
    data = tmp_path / "a.npz"
    np.savez(data, u=FORCE, y=X)
    result = call(data, "--json", tmp_path / "new.json")
    assert result.exit_code == 0
    text = (tmp_path / "recording.toml").read_text()
    found = json.loads((tmp_path / "new.json").read_text())
    assert [said.partition(":")[0] for said in found["unknown"]] == ["the twin", "the rate"]
    for said in found["unknown"]:
        assert said in result.stderr.replace("\n", " ")
        assert said[:60] in text
    (tmp_path / "recording.toml").unlink()
    assert call(data, "--twin", "piezo_stack", "--rate", "200", "--force").exit_code == 0
    loaded = load(tmp_path)
    assert (loaded.twin.kind, list(loaded.inputs), list(loaded.outputs)) == (
        "piezo_stack", ["command"], ["displacement"],
    )  # fmt: skip


def test_two_positions_and_a_drive_voltage_find_places(tmp_path: Path):
    rng = np.random.default_rng(0)
    data = csv(
        tmp_path / "a.csv", "n,t_s,force_N,x_mm,x2_mm,u_V,temp_C,dead",
        np.arange(N), T, FORCE, X, X + rng.normal(0, 1, N), 0.5 * FORCE, 20 + T, 0 * T,
    )  # fmt: skip
    assert "the columns fit a piezo_stack and a mechanical_axis" in call(data, "--out", tmp_path / "b.toml").stderr
    result = call(data, "--twin", "mechanical_axis")
    assert result.exit_code == 0, result.output
    found = load(tmp_path)
    assert list(found.inputs) == ["force"]
    assert list(found.outputs) == ["position"]
    assert set(found.context) == {"u", "temperature"}
    for said in ("'n' is not used", "'dead' is not used", "'x2_mm' is not used", "'u_V' is context"):
        assert said in result.stderr


def test_a_header_less_file_and_a_named_twin(tmp_path: Path):
    result = call(csv(tmp_path / "a.txt", "", T, FORCE, X, delimiter=" "), "--twin", "mechanical_axis")
    assert result.exit_code == 0, result.output
    assert "'column_1' is the time in s" in result.stderr
    assert load(tmp_path).n == N


def test_letters_of_system_identification_and_a_step_in_one_cell(tmp_path: Path):
    rows = [f"{u:.9g},{y:.9g},{0.005 if k == 0 else ''}" for k, (u, y) in enumerate(zip(FORCE, X, strict=True))]
    (tmp_path / "a.csv").write_text("\n".join(["uEst,yEst,Ts", *rows]))
    result = call(tmp_path / "a.csv", "--twin", "piezo_stack")
    assert result.exit_code == 0, result.output
    found = load(tmp_path)
    assert (1 / found.dt, found.column) == (
        pytest.approx(RATE), {"command": "uEst", "displacement": "yEst"},
    )  # fmt: skip


def test_a_twin_that_needs_more_says_so(tmp_path: Path):
    result = call(csv(tmp_path / "a.csv", "t_s,u_V,y_V", T, FORCE, X), "--twin", "state_space")
    assert result.exit_code == 0
    assert "the twin's A, B, C: a state_space needs them" in result.stderr
    path = tmp_path / "recording.toml"
    assert f"next: complete in {path} what could not be known, then: micron mismatch diagnose {path}" in result.stderr
    assert "micron:" not in result.stderr


def with_gaps(path: Path) -> Path:
    """Three runs: a gap of 3 s after 200 samples, and a clock that starts anew after 400; one value is missing."""
    t = np.r_[T[:200], T[200:400] + 3.0, T[:200]]
    x = X.copy()
    x[50] = np.nan
    return csv(path, "t_s,force_N,pos_mm", t, FORCE, x)


def test_gaps_are_named_and_cut_into_runs_that_are_diagnosed_together(tmp_path: Path):
    data = with_gaps(tmp_path / "a.csv")
    said = refused(data)
    assert "line 202 (0.995 s): jumps by 3.005 s; line 402 (4.995 s): runs back by 4.995 s" in said
    assert "column 'pos_mm' has 1 missing values, the first at line 52" in said
    assert "--cut" in said
    assert "--resample 200" in said
    result = call(data, "--cut")
    assert result.exit_code == 0, result.output
    assert "in 3 runs" in result.stderr
    found = load(tmp_path)
    assert (found.n, found.segments) == (600, (200, 400))
    np.testing.assert_allclose(found.inputs["force"], FORCE, atol=2e-3)  # amplitude (w dt)^2 / 2 of the line


@pytest.mark.parametrize("rate", [50.0, 400.0])
def test_resampled_to_a_rate(tmp_path: Path, rate: float):
    result = call(with_gaps(tmp_path / "a.csv"), "--resample", rate)
    assert result.exit_code == 0, result.output
    found = load(tmp_path)
    assert 1 / found.dt == rate
    begins = (0, *found.segments)
    assert len(begins) == 3
    t = np.concatenate(
        [
            T[k * 200] + np.arange(b - a) / rate
            for k, (a, b) in enumerate(zip(begins, (*begins[1:], found.n), strict=True))
        ]
    )
    inner = np.ones(found.n, bool)
    inner[[*begins, *(b - 1 for b in begins[1:]), -1]] = False  # a mean at the end of a run has one side only
    np.testing.assert_allclose(found.inputs["force"][inner], (8 * np.sin(4.4 * t))[inner], atol=0.02)


def test_means_over_a_longer_step_keep_out_what_is_too_fast(tmp_path: Path):
    data = csv(tmp_path / "a.csv", "t_s,force_N,pos_mm", T, FORCE + np.sin(2 * np.pi * 50 * T), X)
    assert call(data, "--resample", "50").exit_code == 0
    t = np.arange(load(tmp_path).n) / 50
    np.testing.assert_allclose(load(tmp_path).inputs["force"][1:-1], (8 * np.sin(4.4 * t))[1:-1], atol=0.02)


def test_a_clock_that_follows_nothing_is_brought_to_a_rate_that_it_has_samples_for(tmp_path: Path):
    """Even steps at the usual rate of such a clock hold more samples than were measured: said, with another."""
    t = np.sort(np.random.default_rng(0).uniform(0, 30, T.size))
    data = csv(tmp_path / "a.csv", "t_s,force_N,pos_mm", t, 8 * np.sin(0.9 * t), np.cos(0.9 * t))
    result = call(data, "--cut")
    assert result.exit_code == 0, result.output
    said = " ".join(result.stderr.split())
    assert "lie where nothing was measured" in said
    offered = said.split("--resample ")[1].split()[0]
    assert float(offered) == pytest.approx(0.5 * T.size / 30, rel=0.02)
    result = call(data, "--resample", offered, "--force")
    assert result.exit_code == 0, result.output
    assert "lie where nothing was measured" not in " ".join(result.stderr.split())
    assert 1 / load(tmp_path).dt == float(offered)


ROWS = range(60)
BAD = {
    "empty file": ("a.csv", b"", "no columns"),
    "one column": ("a.csv", b"t_s,force_N\n" + b"".join(b"%d,%d\n" % (k, k % 7) for k in ROWS), "beside the time: 1"),
    "words alone": ("a.csv", b"state,mode\n" + b"on,off\n" * 60, "is not a number"),
    "a word in a column": (
        "a.csv", b"u_V,z_um\n" + b"1,2\n2,3\n" * 30 + b"1,ERR\n" + b"2,3\n" * 9, "line 62: column 'z_um': 'ERR'",
    ),
    "columns of words": ("a.csv", b"t_s,a,b\n" + b"".join(b"%d,on,off\n" % k for k in ROWS), "holds words ('on')"),
    "torn mat": ("a.mat", b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1IM" + b"\x0f\0\0\0\0\1\0\0", "torn"),
    "unknown extension": ("a.xlsx", b"PK", "data must be .csv"),
    "too short": ("a.csv", b"u_V,z_um\n" + b"1,2\n2,3\n" * 9, "18 samples; at least 50"),
}  # fmt: skip


@pytest.mark.parametrize(("name", "content", "message"), BAD.values(), ids=BAD)
def test_bad_input_is_one_message_and_nothing_is_written(tmp_path: Path, name: str, content: bytes, message: str):
    (tmp_path / name).write_bytes(content)
    assert message in refused(tmp_path / name, "--rate", "100")


def test_what_is_there_stays_without_force(tmp_path: Path):
    data = csv(tmp_path / "data.csv", "t_s,force_N,pos_mm", T, FORCE, X)
    assert call(data).exit_code == 0
    assert "recording.toml" in refused(data)
    assert call(data, "--out", tmp_path / "other.toml").exit_code == 0
    assert call(data, "--force", "--twin", "ode").exit_code == 0
    assert refused(data, "--out", tmp_path / "data.csv", "--force").count("ends in .toml") == 1
    assert "unknown kind" in refused(data, "--twin", "motor", "--force")
    assert "no columns are an input and an output" in refused(data, "--twin", "magnetometer", "--force")


def test_an_output_elsewhere_is_refused_unless_the_columns_go_with_it(tmp_path: Path):
    data, folder = csv(tmp_path / "data.csv", "t_s,force_N,pos_mm", T, FORCE, X), tmp_path / "there"
    folder.mkdir()
    assert "lies in the folder of its data" in refused(data, "--out", folder / "recording.toml")
    assert call(data, "--out", folder / "recording.toml", "--cut").exit_code == 0
    assert load(folder).n == N


@pytest.mark.slow
def test_a_csv_of_500_mb_needs_little_memory(tmp_path: Path):
    """At most 300 MB above what the imports need: the file is read in blocks."""
    rows = 200_000
    t = np.arange(rows) / 1000.0
    part = "\n".join(f"{a:.3f},{b:.9f},{c:.9f}" for a, b, c in zip(t, np.sin(t), np.cos(t), strict=True)) + "\n"
    data = tmp_path / "large.csv"
    repeats = 500_000_000 // len(part) + 1
    with data.open("w") as file:
        file.write("t_ignored,command_V,stroke_um\n")
        for _ in range(repeats):
            file.write(part)
    code = (
        "import resource, sys\nfrom pathlib import Path\nimport tools.mismatch.new as new, matplotlib.figure, "
        "matplotlib.backends.backend_agg\nbefore = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        f"made = new.new_recording(Path({str(data)!r}), rate_hz=1000.0, kind='piezo_stack')\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before, made.guess.samples)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=230)
    assert done.returncode == 0, done.stderr
    used_kib, samples = map(int, done.stdout.split())
    assert samples == repeats * rows
    assert used_kib < 300 * 1024


def test_a_time_in_ms_under_a_bare_name_is_told_by_its_consequence(tmp_path: Path):
    data = csv(tmp_path / "a.csv", "t,force_N,x_mm", 1e3 * T, FORCE, X)
    result = call(data)
    assert result.exit_code == 0, result.output
    said = result.stderr.replace("\n", " ")
    assert f"the time in 't' is in s: {RATE / 1e3:g} samples per second" in said
    assert f"if it is in ms, repeat with --rate {RATE:g}" in said
    assert call(data, "--rate", f"{RATE:g}", "--force").exit_code == 0
    assert 1 / load(tmp_path).dt == pytest.approx(RATE)
