"""The examples of docs/mismatch.md work as they stand."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_report.systems import CHANNELS, RATE_HZ, TWIN
from tools.cli.mismatch import app
from tools.mismatch.engine.diagnose import diagnose
from tools.mismatch.recording_load import load

TEXT = (Path(__file__).parents[3] / "docs" / "mismatch.md").read_text(encoding="utf-8")


def blocks() -> dict[str, str]:
    """Fenced blocks that begin with ``# file: NAME``, by name."""
    found = re.findall(r"```\w+\n# file: (\S+)\n(.*?)```", TEXT, flags=re.S)
    return dict(found)


@pytest.fixture
def on_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The example files in a folder that Python imports from."""
    for name, text in blocks().items():
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    sys.modules.pop("humidity", None)


def test_the_effect_of_the_example_is_found(on_path: Path):
    import humidity  # pyright: ignore[reportMissingImports]

    rng = np.random.default_rng(1)
    t = np.arange(1500) / RATE_HZ
    u = 50 + 20 * np.sin(2 * np.pi * 0.3 * t)
    h = 40 + np.cumsum(rng.normal(0, 0.3, t.size))
    z = 0.125 * u - 1.0 + 0.02 * (h - 40) + rng.normal(0, 0.01, t.size)
    np.savez(on_path / "data.npz", u=u, z=z, h=h)
    context = '[[channels]]\ncolumn = "h"\nrole = "context"\nsignal = "humidity"\nunit = "1"\n'
    text = f'format = 1\ndata = "data.npz"\nrate_hz = {RATE_HZ}\n[twin]\n{TWIN}{CHANNELS}{context}'
    (on_path / "recording.toml").write_text(text)
    few = [humidity.HUMIDITY_SENSITIVITY, EFFECTS["saturation"]]
    report = diagnose(load(on_path), jobs=1, effects=few)
    assert [p.name for p in report.physics] == ["humidity_sensitivity"]
    assert report.physics[0].parameters["per_percent"].value == pytest.approx(0.02, rel=0.02)


def test_every_command_that_is_shown_exists():
    commands = {c.name or c.callback.__name__ for c in app.registered_commands}
    assert set(re.findall(r"^micron mismatch (\w+)", TEXT, flags=re.M)) == commands


def test_every_file_that_is_named_exists():
    root = Path(__file__).parents[3]
    for name in re.findall(r"`((?:sim_devices|tools)/[\w/]+\.py)`", TEXT):
        assert (root / name).is_file(), name
