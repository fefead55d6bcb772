"""One word for one thing: what docs/glossary.md says not to say is not said."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
# word not to use -> the word, and the files in which it is a device's, a paper's or a format's own
FORBIDDEN: dict[str, tuple[str, tuple[str, ...]]] = {
    r"extensions?": ("stroke", ("hal/scratch.py",)),
    r"set-?points?": (
        "command",
        (
            "benches/micron-can.toml",
            "docs/limits.md",
            "drivers/can_frames.py",
            "drivers/piezo/can_amplifier.py",
            "drivers/sheets/can_amplifier.toml",
            "sim_devices/devices/can_piezo_node.py",
            "tests/wire/",
        ),
    ),
    r"desired(?!_tip)": ("target", ("tools/reproduce/actuation_real.py",)),
    r"rigs?": ("bench, or stand in a test", ()),
    r"end[- ]effectors?": ("tip", ()),
    r"time ?steps?": ("tick, step", ()),
}
NOT_OURS = ("tools/bench/static/vendor/", "docs/glossary.md", "docs/licences.md", "tests/unit/tree/test_words.py")


@pytest.fixture(scope="module")
def texts() -> dict[str, str]:
    listed = ["git", "ls-files", "*.py", "*.md", "*.toml", "*.js", "*.html"]
    done = subprocess.run(listed, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip("not a git checkout")
    names = [name for name in done.stdout.split() if not name.startswith(NOT_OURS) and (ROOT / name).is_file()]
    return {name: (ROOT / name).read_text(encoding="utf-8") for name in names}


@pytest.mark.parametrize("word", FORBIDDEN)
def test_a_word_that_has_a_better_one_is_not_used(texts: dict[str, str], word: str):
    better, theirs = FORBIDDEN[word]
    pattern = re.compile(rf"(?<![a-z])(?:{word})(?![a-z])", re.IGNORECASE)
    found = [
        f"{name}: {line.strip()}"
        for name, text in texts.items()
        if not name.startswith(theirs or ("\0",))
        for line in text.splitlines()
        if pattern.search(line)
    ]
    assert not found, f"say {better}"


def test_the_exceptions_are_needed(texts: dict[str, str]):
    for word, (_, theirs) in FORBIDDEN.items():
        for place in theirs:
            assert any(re.search(word, t, re.IGNORECASE) for name, t in texts.items() if name.startswith(place)), place
