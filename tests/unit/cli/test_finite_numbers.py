"""An option that takes a number takes a finite one, in every command; what it means is checked beside."""

from __future__ import annotations

import pytest

from tests.command import micron


@pytest.mark.parametrize("number", ["nan", "inf", "-inf", "1e999"])
@pytest.mark.parametrize(
    "words",
    [
        "run --seconds",
        "run --watch-reference",
        "run --false-alarms-per-hour",
        "simulate --delay-us",
        "simulate --hand h.csv --scale",
        "bench --stale-ms",
        "noise log.csv --scale",
        "imu log.csv --rate-hz",
        "export run.mcap out.csv --to",
        "calibrate gyroscope log.csv --rate-hz",
        "mismatch new data.csv --rate",
        "mismatch diagnose rec --held-out",
        "mismatch cut rec --out new --stop",
        "mismatch plan rec --amplitude",
        "mismatch plan rec --duration",
        "mismatch watch twin.toml rec --reference",
    ],
)
def test_a_number_that_is_not_finite_is_refused(words: str, number: str) -> None:
    done = micron(*words.split(), number)
    assert done.exit_code == 2
    text = " ".join(done.stderr.split())
    assert (
        f"micron: {words.split()[-1]} {float(number)}: is no finite number; give one" in text
        or "Invalid value for" in text
    )


@pytest.mark.parametrize("scale", ["0", "-1", "1e300"])
def test_a_hand_is_scaled_by_a_factor_that_leaves_a_motion(scale: str) -> None:
    done = micron("simulate", "--hand", "h.csv", "--scale", scale)
    assert done.exit_code == 2
    assert "--scale" in done.stderr


@pytest.mark.parametrize("words", ["--help", "mismatch plan --help", "run --help"])
def test_the_help_is_as_before(words: str) -> None:
    done = micron(*words.split())
    assert done.exit_code == 0
    assert "Usage" in done.stdout
