"""``micron simulate``: figures as JSON, the same bits twice, one clear error for what it cannot do."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tools.cli.main import app

BENCHES = Path(__file__).parents[3] / "benches"


def simulated(*options: str) -> dict:
    result = CliRunner().invoke(app, ["simulate", "--seconds", "4", "--json", "-", *options])
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def test_figures_and_the_same_bits_again() -> None:
    first = simulated("--seed", "3")
    assert first == simulated("--seed", "3")
    tremor = first["tremor"]
    assert 0.0 < tremor["compensated_rms_um"] < 0.5 * tremor["uncompensated_rms_um"]
    assert simulated("--seed", "4")["tremor"] != tremor


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--delay-us", "1000"], "less than a tick"),
        (["--scale", "1"], "--hand FILE"),
        (["--bench", str(BENCHES / "micron-can.toml")], "dac_amplifier"),
        (["--bench", str(BENCHES / "endoscope.toml")], "endoscope"),
        (["--json", "/no/such/folder/x.json"], "does not exist"),
    ],
)
def test_what_it_cannot_do_is_one_error(options: list[str], said: str) -> None:
    result = CliRunner().invoke(app, ["simulate", "--seconds", "4", *options])
    assert result.exit_code == 2
    assert said in " ".join(result.output.split())
