"""Options of ``micron emulate`` for a bus that the bench does not have are refused."""

from __future__ import annotations

import pytest

from tests.command import micron
from tests.conftest import DEFAULT_BENCH


@pytest.mark.parametrize(
    ("bench", "words", "message"),
    [
        ("imus", "--can vcan7", "has 0 CAN buses; name no more interfaces"),
        (str(DEFAULT_BENCH), "--can vcan7 --can vcan8", "has 1 CAN bus; name no more interfaces"),
        ("imus", "--tcp 0", "--tcp belongs to serial buses"),
    ],
)
def test_an_option_for_a_bus_that_is_not_there_is_refused(bench: str, words: str, message: str) -> None:
    done = micron("emulate", bench, *words.split(), "--", "true")
    assert done.exit_code == 2, done.output
    assert message in done.stderr
