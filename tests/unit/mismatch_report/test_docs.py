"""The commands and files of docs/mismatch.md are there, and the page stays short."""

import re
from pathlib import Path

from tools.cli.main import INSIDE
from tools.cli.mismatch import app

ROOT = Path(__file__).parents[3]
TEXT = (ROOT / "docs" / "mismatch.md").read_text(encoding="utf-8")


def test_every_command_that_is_shown_exists():
    commands = {c.name or c.callback.__name__ for c in app.registered_commands} | INSIDE["mismatch"].keys()
    assert set(re.findall(r"^micron mismatch (\w+)", TEXT, flags=re.M)) == commands


def test_every_file_that_is_named_exists():
    for name in re.findall(r"`((?:sim_devices|tools)/[\w/]+\.py)`", TEXT):
        assert (ROOT / name).is_file(), name


def test_the_page_is_short_and_has_at_most_ten_limits():
    assert len(TEXT.split()) <= 2000
    limits = TEXT[TEXT.index("\n## Limits") :]
    assert 0 < len(re.findall(r"^\d+\. ", limits, flags=re.M)) <= 10
