"""Several recordings at once: what is refused, how they are joined, and what is found to change between them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.recording_text import stack_channels
from tools.cli.main import app
from tools.mismatch.engine.many import changes_between, repeated_noise
from tools.mismatch.engine.report import BetweenRecordings
from tools.mismatch.engine.split import split_of_parts
from tools.mismatch.together import load_together

TEMPERATURES = (19.0, 27.0, 22.5, 31.0, 24.0)


def write(folder: Path, k: int, play: float = 0.0, n: int = 1200, drive: int | None = None) -> Path:
    """A stack whose gain falls by 0.4 %/K, with a concealed play operator of weight ``play``."""
    t = np.arange(n) / 200.0
    d = k if drive is None else drive
    volts = 50 + 25 * np.sin(2 * np.pi * 0.41 * t + d) + 15 * np.sin(2 * np.pi * (1.3 + 0.1 * d) * t)
    lagging, p = np.empty(n), volts[0]
    for i, v in enumerate(volts):
        p = max(v - 6.0, min(v + 6.0, p))
        lagging[i] = p
    gain = 0.12 * (1 - 0.004 * (TEMPERATURES[k % 5] - 20))
    um = gain * volts + play * (lagging - volts) + np.random.default_rng(100 + k).normal(0, 0.02, n)
    folder.mkdir(parents=True)
    np.savetxt(folder / "data.csv", np.column_stack([volts, um]), delimiter=",", header="command_V,um", comments="")
    (folder / "recording.toml").write_text(
        f"""format = 1
data = "data.csv"
rate_hz = 200.0
[conditions]
temperature_C = {TEMPERATURES[k % 5]}
operator = "{"AB"[k % 2]}"
[twin]
kind = "piezo_stack"
parameters = {{ gain_um_per_V = 0.12, offset_um = 0.0, hold = "linear" }}
"""
        + stack_channels("command_V", "um")
    )
    return folder


def edited(folder: Path, old: str, new: str) -> Path:
    file = folder / "recording.toml"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))
    return folder


def refused(*arguments: str | Path) -> str:
    found = CliRunner().invoke(app, ["mismatch", "diagnose", *map(str, arguments)])
    assert found.exit_code == 2, found.output
    return " ".join(found.output.split())


def test_parts_keep_their_samples_starts_and_conditions(tmp_path: Path) -> None:
    paths = [write(tmp_path / f"day{k}", k, n=200 + 10 * k) for k in range(3)]
    edited(paths[1], "[conditions]", "segments = [100]\n[conditions]")
    joined = load_together([tmp_path])
    assert [(p.name, p.start, p.stop) for p in joined.parts] == [
        ("day0", 0, 200),
        ("day1", 200, 410),
        ("day2", 410, 630),
    ]
    assert joined.segments == (200, 300, 410)
    assert joined.parts[1].conditions == {"temperature_C": 27.0, "operator": "B"}
    assert joined.n == 630


def test_folders_patterns_and_files_are_taken_once(tmp_path: Path) -> None:
    for k in range(3):
        write(tmp_path / "runs" / f"day{k}", k, n=100)
    again = [tmp_path / "runs" / "day*", tmp_path / "runs", tmp_path / "runs" / "day1" / "recording.toml"]
    assert len(load_together(again).parts) == 3


def test_relative_and_absolute_names_of_one_recording_are_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for k in range(2):
        write(tmp_path / "runs" / f"day{k}", k, n=100)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link").symlink_to(tmp_path / "runs" / "day1")
    mixed = [Path("runs/day0"), tmp_path / "runs" / "day1", tmp_path / "runs" / "day0" / "recording.toml", Path("link")]
    joined = load_together(mixed)
    assert [p.name for p in joined.parts] == ["day0", "day1"]
    assert joined.path == tmp_path / "runs"
    assert load_together([Path("runs")]).path == Path("runs")
    assert load_together([Path("runs/day0"), Path("link")]).path == Path(".")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('unit = "um"', 'unit = "nm"', "'displacement' is in um in one file and in nm"),
        ('kind = "piezo_stack"', 'kind = "columns"', "cannot be diagnosed together"),
        ("rate_hz = 200.0", "rate_hz = 100.0", "200 samples per second"),
        ("gain_um_per_V = 0.12", "gain_um_per_V = 0.13", "[twin] tables differ"),
    ],
)
def test_recordings_that_do_not_fit_together(tmp_path: Path, old: str, new: str, said: str) -> None:
    a, b = write(tmp_path / "a", 0, n=100), write(tmp_path / "b", 1, n=100)
    if new.endswith('"columns"'):
        text = (b / "recording.toml").read_text().replace(old, new)
        text = text.replace('signal = "command"', 'signal = "displacement_simulated"')
        (b / "recording.toml").write_text(text.split("parameters")[0] + "\n" + text.split("}", 1)[1])
    else:
        edited(b, old, new)
    output = refused(a, b, "--together")
    assert said in output.replace("\n", " ")
    assert "a/recording.toml" in output.replace(" ", "")
    assert "b/recording.toml" in output.replace(" ", "")


def tank(folder: Path, x0: list[float]) -> Path:
    """A first-order plant with an offset that is written as a constant state."""
    folder.mkdir()
    u = np.sin(np.arange(200) / 9.0)
    np.savez(folder / "data.npz", u_V=u, y_V=np.convolve(u, np.exp(-np.arange(50)))[:200])
    parameters = f"A = [[-1.0, 1.0], [0.0, 0.0]]\nB = [[1.0], [0.0]]\nC = [[1.0, 0.0]]\nD = [[0.0]]\nx0 = {x0}\n"
    channels = "".join(
        f'[[channels]]\ncolumn = "{c}"\nrole = "{role}"\nsignal = "{s}"\nunit = "V"\n'
        for c, role, s in (("u_V", "input", "drive"), ("y_V", "output", "level"))
    )
    head = 'format = 1\ndata = "data.npz"\nrate_hz = 10.0\n[twin]\nkind = "state_space"\n[twin.parameters]\n'
    (folder / "recording.toml").write_text(head + parameters + channels)
    return folder


def test_a_start_state_belongs_to_a_recording_and_a_constant_state_to_the_twin(tmp_path: Path) -> None:
    one, other = tank(tmp_path / "one", [0.0, 2.0]), tank(tmp_path / "other", [1.5, 2.0])
    assert len(load_together([one, other]).parts) == 2
    assert "[twin] tables differ" in refused("--together", one, tank(tmp_path / "offset", [0.0, 2.5]))


def test_one_message_for_each_wrong_command(tmp_path: Path) -> None:
    a, b = write(tmp_path / "a", 0, n=100), write(tmp_path / "b", 1, n=100)
    (tmp_path / "empty").mkdir()
    assert "at least two" in refused(a, "--together")
    assert "no recording.toml" in refused(tmp_path / "empty", "--together")
    assert "no recording.toml" in refused(a, tmp_path / "empty", "--together")
    assert "no file or folder matches" in refused(tmp_path / "none*", "--together")
    assert "no file or folder matches" in refused(a, tmp_path / "none*", "--together")
    assert "data.csv: is not a recording" in refused(b, tmp_path / "a" / "*", "--together")
    assert "no such recording" in refused(a, tmp_path / "nowhere", "--together")
    json_file = tmp_path / "report.json"
    assert "--per-recording friction.level" in refused(
        a, b, "--together", "--per-recording", "friction.level", "--json", json_file
    )
    assert not json_file.exists()
    assert "creep has no such parameter" in refused(a, b, "--together", "--per-recording", "creep.")
    assert "--per-recording wobble" in refused(a, b, "--together", "--per-recording", "wobble")
    assert "has no such parameter" in refused(a, b, "--together", "--per-recording", "creep.wobble")
    assert "--per-recording needs --together" in refused(a, "--per-recording", "gain")
    assert "add --together" in refused(a, b)
    assert "[conditions] load_N" in refused(edited(a, "[conditions]", "[conditions]\nload_N = [1]"), b, "--together")


def test_a_split_holds_whole_recordings_out() -> None:
    parts = [(0, 100), (100, 220), (220, 300), (300, 420)]
    split = split_of_parts(np.random.default_rng(1).normal(size=(420, 1)), parts, init=20)
    fit, held = split.fit_mask(), split.held_out_mask()
    for a, b in parts:
        assert fit[a:b].all() != held[a + 20 : b].all()
        assert not (fit[a:b].any() and held[a:b].any())


def test_repeats_give_the_noise(tmp_path: Path) -> None:
    for k in range(3):
        write(tmp_path / f"r{k}", k, n=4000, drive=0)
    assert repeated_noise(load_together([tmp_path]), "displacement") == pytest.approx(0.02, rel=0.05)
    for k in range(2):
        write(tmp_path / "others" / f"r{k}", k, n=400)
    assert repeated_noise(load_together([tmp_path / "others"]), "displacement") is None


def test_changes_are_named_after_correction_and_nothing_else_is() -> None:
    rng = np.random.default_rng(3)
    warm = tuple(map(float, rng.uniform(15, 30, 12)))
    who = tuple("AB"[i % 2] for i in range(12))
    order = tuple(float(i) for i in range(12))
    gain = 0.1 * (1 - 0.004 * (np.array(warm) - 20)) + rng.normal(0, 1e-5, 12)
    offset = np.where(np.array(who) == "A", 1.0, 2.0) + rng.normal(0, 0.01, 12)
    parameters = [
        BetweenRecordings(n, "", False, tuple(map(float, v)), (0.0,) * 12)
        for n, v in (("gain", gain), ("offset", offset), ("rest", rng.normal(size=12)))
    ]
    changes, tried = changes_between(parameters, {"order": order, "temperature": warm, "operator": who})
    assert tried == 9
    assert {(c.parameter, c.condition) for c in changes} == {("gain", "temperature"), ("offset", "operator")}
    slope = next(c for c in changes if c.parameter == "gain").slope
    assert slope == pytest.approx(-0.0004, rel=0.02)


def test_changes_of_nothing_are_rare() -> None:
    rng, alarms = np.random.default_rng(5), 0
    for _ in range(400):
        values = [BetweenRecordings(str(i), "", False, tuple(rng.normal(size=6)), (0.0,) * 6) for i in range(2)]
        conditions = {"order": tuple(map(float, range(6))), "load": tuple(map(float, rng.normal(size=6)))}
        alarms += bool(changes_between(values, conditions)[0])
    assert alarms <= 8  # 2 are expected at a level of 0.005


def test_an_effect_for_all_and_a_gain_that_follows_temperature(tmp_path: Path) -> None:
    for k in range(5):
        write(tmp_path / "runs" / f"day{k}", k, play=0.0015)
    out = tmp_path / "report.json"
    arguments = ["mismatch", "diagnose", str(tmp_path / "runs" / "day*"), "--together", "--per-recording", "gain"]
    found = CliRunner().invoke(app, [*arguments, "--jobs", "1", "--json", str(out), "--html", str(tmp_path / "r.html")])
    assert found.exit_code == 0, found.output
    report = json.loads(out.read_text())
    assert "gain_um_per_V falls by" in " ".join(found.output.split())
    assert report["verdict"] == "missing_physics"
    together = report["together"]
    assert len(together["held_out"]) == 5
    assert together["rms_fitted"]["displacement"] < together["rms_recalibrated"]["displacement"]
    assert together["p_value"] < 0.01
    (change,) = together["changes"]
    assert (change["parameter"], change["condition"]) == ("gain_um_per_V", "temperature_C")
    assert change["relative"] == pytest.approx(-0.004, rel=0.1)
    page = (tmp_path / "r.html").read_text()
    assert "Between the 5 recordings" in page
    assert "between1-" in page
    assert "falls by" in page
