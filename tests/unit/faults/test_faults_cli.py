"""``micron faults`` and ``micron soak`` refuse what they cannot do before any work, in one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.command import micron
from tests.conftest import DEFAULT_BENCH

BENCHES = DEFAULT_BENCH.parent


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["faults", "--only", "meteorite"], "no fault is called so"),
        (["faults", "--bench", "nowhere.toml"], "nowhere.toml: no such bench file"),
        (["faults", "--bench", str(BENCHES / "imus.toml")], "this bench has mpu6050, lsm6ds3, bmx055"),
        (["faults", "--beside", f"{BENCHES / 'endoscope.toml'}"], "this bench has imu, card"),
        (["faults", "--beside", f"{BENCHES / 'micron-eight.toml'}#meteorite"], "no fault is called so"),
        (["faults", "--keep", "nowhere"], "there is no such folder"),
        (["faults", "--out", "nowhere/page.md"], "does not exist; create it first"),
        (["faults", "--json", "."], "this is a folder; name a file in it"),
        (["soak", "--start-ns", "5", "--without-wires"], "without wires there is none"),
        (["soak", "--out", str(BENCHES.parent / "README.md")], "not a page of long runs"),
        (["soak", "--bench", "nowhere.toml"], "nowhere.toml: no such bench file"),
    ],
)
def test_bad_input_is_one_clear_line_and_exit_2(arguments: list[str], says: str) -> None:
    result = micron(*arguments)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert len(result.stderr.strip().splitlines()) == 1
    assert says in result.stderr


def test_a_fault_of_a_part_that_the_bench_has_not_is_refused(tmp_path: Path) -> None:
    text = DEFAULT_BENCH.read_text(encoding="utf-8").replace("can0", "can7")
    bench = tmp_path / "bench.toml"
    bench.write_text(text, encoding="utf-8")
    result = micron("faults", "--bench", bench, "--only", "can: bus silent")
    assert result.exit_code == 2
    assert "'can: bus silent' breaks 'can0', which is not on this bench" in result.stderr
