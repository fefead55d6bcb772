"""A stranger's motor (``examples/motor``), which imports nothing of this project: right names, or unexplained with the
advice which twin would say more; never a wrong name that is more than half sure.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tools.mismatch.engine.diagnose import diagnose
from tools.mismatch.engine.report import Report
from tools.mismatch.recording_load import load

EXAMPLE = Path(__file__).parents[2] / "examples" / "motor"
TRUTH = {
    "nothing": set(),
    "backlash": {"backlash"},
    "friction": {"coulomb_friction", "stribeck_friction"},
    "friction_and_backlash": {"coulomb_friction", "stribeck_friction", "backlash"},
    "delay": {"dead_time"},
}
"""What may be named. The breakaway of Stribeck's friction is zero here, which the recording need not show."""


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("motor")
    subprocess.run([sys.executable, "make.py", str(folder)], cwd=EXAMPLE, check=True, timeout=300)
    return folder


def sure(report: Report) -> set[str]:
    """The names that are more than half sure."""
    return {p.name for p in report.physics if p.confidence > 0.5}


def test_the_example_knows_nothing_of_this_project() -> None:
    for file in EXAMPLE.glob("*.py"):
        text = file.read_text(encoding="utf-8")
        assert not any(
            f"{word} {room}" in text for word in ("import", "from") for room in ("tools", "sim_devices", "hal")
        )


@pytest.mark.slow
@pytest.mark.parametrize("variant", TRUTH)
def test_columns_name_what_is_behind_the_motor_and_advise_for_the_rest(recordings: Path, variant: str) -> None:
    report = diagnose(load(recordings / variant / "columns.toml"), jobs=1)
    assert sure(report) <= TRUTH[variant], report.summary
    assert "kind 'ode'" in report.not_tried
    if variant == "nothing":
        assert report.verdict in ("agrees", "recalibrate")
    elif "friction" in variant:
        assert report.verdict == "unexplained"
    else:
        assert sure(report) == TRUTH[variant]


@pytest.mark.slow
@pytest.mark.parametrize("variant", TRUTH)
def test_equations_name_what_is_inside_the_motor(recordings: Path, variant: str) -> None:
    report = diagnose(load(recordings / variant / "ode.toml"), jobs=1)
    assert sure(report) <= TRUTH[variant], report.summary
    assert report.not_tried == ""
    if variant == "nothing":
        assert report.verdict in ("agrees", "recalibrate")
        return
    assert report.verdict == "missing_physics"
    if "friction" in variant:
        found = next(p for p in report.physics if "friction" in p.name)
        assert found.target == "speed"
        assert found.parameters["coulomb_forward"].value == pytest.approx(0.35, rel=0.05)
        assert found.parameters["coulomb_forward"].unit == "V"
    if "backlash" in variant:
        gap = next(p for p in report.physics if p.name == "backlash").parameters["gap"]
        assert gap.value == pytest.approx(0.3, rel=0.1)
    if variant == "delay":
        assert report.physics[0].parameters["delay"].value == pytest.approx(0.04, rel=0.05)
