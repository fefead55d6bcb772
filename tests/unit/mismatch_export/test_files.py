"""A stranger's way: csv, recording.toml, diagnose, apply to every form, simulate: each gives the report's fit."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from hal.trust import NotTrusted, trust_program
from sim_devices.physics.catalogue import EFFECTS
from tools.cli.main import app
from tools.errors import RecordingError
from tools.mismatch.export.run import simulate_file
from tools.mismatch.infer import diagnose
from tools.mismatch.recording_load import load

runner = CliRunner()
N, RATE_HZ = 1500, 100.0


def run(*words: object, code: int = 0) -> str:
    result = runner.invoke(app, ["mismatch", *map(str, words)])
    assert result.exit_code == code, result.output
    return result.output


def wave(seed: int = 1) -> np.ndarray:
    rng, t = np.random.default_rng(seed), np.arange(N) / RATE_HZ
    return sum((np.sin(2 * np.pi * rng.uniform(0.1, 2.0) * t + rng.uniform(0, 6.28)) for _ in range(5)), np.zeros(N))


def write(folder: Path, columns: dict[str, np.ndarray], twin: str, channels: dict[str, tuple[str, str, str]]) -> Path:
    """A folder as a stranger makes it; ``channels``: column -> (role, signal, unit)."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = np.column_stack(list(columns.values()))
    np.savetxt(folder / "data.csv", rows, delimiter=",", header=",".join(columns), comments="", fmt="%.17g")
    text = f'format = 1\ndata = "data.csv"\nrate_hz = {RATE_HZ}\n[twin]\n{twin}'
    for column, (role, signal, unit) in channels.items():
        text += f'[[channels]]\ncolumn = "{column}"\nrole = "{role}"\nsignal = "{signal}"\nunit = "{unit}"\n'
    (folder / "recording.toml").write_text(text)
    return folder


def stack(folder: Path) -> tuple[Path, tuple[str, ...]]:
    """A stack with a dead zone, its command in mV and its displacement in nm."""
    u = 50 + 9 * wave()
    z = 0.13 * (u - np.clip(u - 50.0, -3.0, 3.0)) - 1.0 + np.random.default_rng(2).normal(0, 0.01, N)
    twin = 'kind = "piezo_stack"\n[twin.parameters]\ngain_um_per_V = 0.125\noffset_um = -1.0\n'
    channels = {"u": ("input", "command", "mV"), "z": ("output", "displacement", "nm")}
    return write(folder, {"u": 1e3 * u, "z": 1e3 * z}, twin, channels), ("dead_zone", "saturation")


def axis(folder: Path) -> tuple[Path, tuple[str, ...]]:
    """A sprung axis with a spring that hardens, integrated here in small steps."""
    force, x, v, h = 20 * wave(3), 0.0, 0.0, 1 / RATE_HZ / 40
    position = np.empty(N)
    for k in range(N):
        position[k] = x
        for j in range(40 if k + 1 < N else 0):
            f = force[k] + (force[k + 1] - force[k]) * (j + 0.5) / 40
            v += h * (f - 6.0 * v - 300.0 * x - 4e4 * x**3) / 2.0
            x += h * v
    position += np.random.default_rng(4).normal(0, 2e-5, N)
    twin = 'kind = "mechanical_axis"\n[twin.parameters]\nmass = 2.0\ndamping = 5.0\nstiffness = 300.0\n'
    channels = {"f": ("input", "force", "N"), "x": ("output", "position", "mm")}
    return write(folder, {"f": force, "x": 1e3 * position}, twin, channels), ("cubic_stiffness", "coulomb_friction")


def filtered(folder: Path) -> tuple[Path, tuple[str, ...]]:
    """A second-order filter behind which the reading is limited."""
    u, x, v, h = wave(5), 0.0, 0.0, 1 / RATE_HZ / 20
    y = np.empty(N)
    for k in range(N):
        y[k] = x
        for j in range(20 if k + 1 < N else 0):
            f = u[k] + (u[k + 1] - u[k]) * (j + 0.5) / 20
            v += h * 900.0 * (f - x - v / 40.0)
            x += h * v
    y = np.clip(y, -1.2, 1.5) + np.random.default_rng(6).normal(0, 2e-3, N)
    twin = 'kind = "state_space"\n[twin.parameters]\nA = [[0, 1], [-900, -22]]\nB = [[0], [1]]\nC = [[900, 0]]\n'
    return write(folder, {"u": u, "y": y}, twin, {"u": ("input", "u", "V"), "y": ("output", "y", "V")}), ("saturation",)


MADE: dict[str, Callable[[Path], tuple[Path, tuple[str, ...]]]] = {"stack": stack, "axis": axis, "filter": filtered}


@pytest.fixture(scope="module", params=MADE)
def found(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Path, dict[str, Any]]:
    """(recording, report file, report) of each made-up machine."""
    folder, names = MADE[request.param](tmp_path_factory.mktemp(request.param) / "rec")
    report = diagnose(load(folder), jobs=1, effects=[EFFECTS[n] for n in names]).to_json()
    assert [p["name"] for p in report["physics"]][:1] == [names[0]]
    (folder.parent / "report.json").write_text(json.dumps(report))
    return folder, folder.parent / "report.json", report


def held_rms(folder: Path, report: dict[str, Any], simulated: dict[str, np.ndarray]) -> float:
    """The residual on the report's held-out samples, in the report's unit."""
    rec = load(folder)
    (o,) = rec.outputs
    data = np.genfromtxt(folder / "data.csv", delimiter=",", names=True)
    away = data[rec.column[o]] - simulated[o]
    held = np.concatenate([away[a:b] for a, b in report["fit"]["held_out_spans"]])
    scale = {"nm": 1e-3, "mm": 1e-3, "V": 1.0}[rec.file_unit[o]]
    return scale * float(np.sqrt(np.mean(held**2)))


def as_reported(rms: float, fitted: float) -> bool:
    """Not above the report's figure by 2 %, nor below by 5 %: a run of the whole sets its start state from more samples
    than a diagnosis, and may be the better for it."""
    return 0.95 * fitted < rms < 1.02 * fitted


@pytest.mark.parametrize("form", ["toml", "py"])
def test_a_twin_loaded_again_gives_the_residual_of_the_report(
    found: tuple[Path, Path, dict[str, Any]], form: str, tmp_path: Path
) -> None:
    """Run freely over the whole recording, judged where the report was."""
    folder, file, report = found
    out = tmp_path / f"twin.{form}"
    run("apply", folder, file, "--out", out)
    (fitted,) = report["fit"]["fitted_rms"].values()
    assert as_reported(held_rms(folder, report, simulate_file(out, folder)), fitted)
    said = run("simulate", out, folder, "--out", tmp_path / "again.csv")
    assert "residual" in said
    table = np.genfromtxt(tmp_path / "again.csv", delimiter=",", names=True)
    (column,) = (n for n in table.dtype.names if n.endswith("_simulated"))
    o = next(iter(load(folder).outputs))
    np.testing.assert_allclose(table[column], simulate_file(out, folder)[o], rtol=1e-12)


def test_simulated_columns(found: tuple[Path, Path, dict[str, Any]], tmp_path: Path) -> None:
    folder, file, report = found
    run("apply", folder, file, "--out", tmp_path / "twin.csv")
    table = np.genfromtxt(tmp_path / "twin.csv", delimiter=",", names=True)
    rec = load(folder)
    (o,) = rec.outputs
    assert table.dtype.names == ("t_s", *(rec.column[s] for s in (*rec.inputs, o)), f"{rec.column[o]}_simulated")
    (fitted,) = report["fit"]["fitted_rms"].values()
    assert as_reported(held_rms(folder, report, {o: table[f"{rec.column[o]}_simulated"]}), fitted)


def test_the_module_runs_where_nothing_of_ours_is(found: tuple[Path, Path, dict[str, Any]], tmp_path: Path) -> None:
    """In another folder and another process, with numpy alone."""
    folder, file, _ = found
    run("apply", folder, file, "--out", tmp_path / "twin.py")
    text = (tmp_path / "twin.py").read_text()
    assert [line for line in text.splitlines() if "import" in line] == ["import numpy as np"]
    assert 20 <= len(text.splitlines()) <= 110
    code = (
        "import sys, numpy as np; from twin import simulate;"
        f"d = np.genfromtxt({str(folder / 'data.csv')!r}, delimiter=',', names=True);"
        "names = {'command': 'u', 'force': 'f', 'u': 'u'};"
        "want = [s for s in names if f'\"{s}\"' in open('twin.py').read()];"
        "y = simulate({s: d[names[s]] for s in want[:1]});"
        "assert not [m for m in sys.modules if m.split('.')[0] in ('tools', 'sim_devices', 'hal', 'scipy', 'numba')];"
        "print(len(next(iter(y.values()))))"
    )
    done = subprocess.run(
        [sys.executable, "-I", "-c", f"import sys; sys.path.insert(0, '.'); {code}"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == str(N)


@pytest.mark.skipif(
    any(importlib.util.find_spec(m) is None for m in ("pythonfmu", "fmpy")), reason="needs PythonFMU and FMPy"
)
def test_an_fmu_is_the_module(found: tuple[Path, Path, dict[str, Any]], tmp_path: Path) -> None:
    """It is given before each step what the inputs are at its end, and interpolates as the module does."""
    folder, file, _ = found
    for form in ("py", "fmu"):
        run("apply", folder, file, "--out", tmp_path / f"twin.{form}")
    module = simulate_file(tmp_path / "twin.py", folder)
    (o,) = load(folder).outputs
    fmu = simulate_file(tmp_path / "twin.fmu", folder)[o]
    np.testing.assert_allclose(fmu, module[o], atol=1e-9 * np.std(module[o]))


def test_no_pythonfmu_is_one_message(
    found: tuple[Path, Path, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *a: None if name == "pythonfmu" else real(name, *a))
    said = " ".join(run("apply", found[0], found[1], "--out", tmp_path / "twin.fmu", code=2).split())
    assert "PythonFMU" in said
    assert "--out FILE.py" in said
    assert not list(tmp_path.iterdir())


def test_another_ending_and_a_foreign_twin_are_bad_input(
    found: tuple[Path, Path, dict[str, Any]], tmp_path: Path
) -> None:
    folder, file, _ = found
    assert "'.docx' is none" in " ".join(run("apply", folder, file, "--out", tmp_path / "twin.docx", code=2).split())
    (tmp_path / "bad.py").write_text(f"import nothing_of_that_name  # {tmp_path}\n")
    with pytest.raises(NotTrusted, match="names the program"):
        simulate_file(tmp_path / "bad.py", folder)
    trust_program(tmp_path / "bad.py")
    with pytest.raises(RecordingError, match="cannot be imported"):
        simulate_file(tmp_path / "bad.py", folder)
    (tmp_path / "other.py").write_text("def simulate(inputs, dt=1.0):\n    return {'level': [0.0]}\n")
    trust_program(tmp_path / "other.py")
    with pytest.raises(RecordingError, match="returned no output"):
        simulate_file(tmp_path / "other.py", folder)
    (tmp_path / "other.toml").write_text('[twin]\nkind = "magnetometer"\n')
    with pytest.raises(RecordingError, match="is a magnetometer"):
        simulate_file(tmp_path / "other.toml", folder)
    with pytest.raises(RecordingError, match="no such twin"):
        simulate_file(tmp_path / "none.py", folder)
