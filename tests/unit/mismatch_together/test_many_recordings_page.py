"""``docs/many-recordings.md``: what it tells a stranger to do works in an empty folder and says what the page says."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tools.cli.main import app

PAGE = Path(__file__).parents[3] / "docs" / "many-recordings.md"


@pytest.mark.slow
def test_a_stranger_with_five_days(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    make, commands = re.findall(r"^``` \{[^\n]*\n(.*?)^```", PAGE.read_text(encoding="utf-8"), flags=re.S | re.M)
    exec(make, {})
    five = commands.strip().splitlines()
    assert len(five) == 5
    for line in five:
        found = CliRunner().invoke(app, shlex.split(line)[1:])
        assert found.exit_code == 0, found.output
    alone, shared, together = (json.loads(Path(f"{n}.json").read_text()) for n in ("alone", "shared", "together"))
    assert (alone["verdict"], shared["verdict"]) == ("recalibrate", "unexplained")
    (play,) = together["physics"]
    assert play["name"] == "backlash"
    assert play["parameters"]["gap"]["value"] == pytest.approx(12.0, rel=0.1)
    alike = {n for e in together["equivalent"] for n in e["names"]}
    assert {"backlash", "hysteresis"} <= alike
    assert not alike & {"clock_skew", "slew_limit"}  # they gain less than half of what the play gains
    (change,) = together["together"]["changes"]
    assert change["condition"] == "temperature_C"
    assert change["relative"] == pytest.approx(-0.004, rel=0.1)
    assert "falls by" in Path("together.html").read_text()
