"""Measured recordings: a name that no set has is an error before anything is written."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.errors import InputError
from tools.mismatch.prove.real import reproduce


def test_unknown_set_writes_no_page(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="silverbox multisine"):
        reproduce(tmp_path, only=("nosuch",), doc=tmp_path / "page.md")
    assert not (tmp_path / "page.md").exists()
