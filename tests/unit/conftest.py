"""Accidents that several folders of tests need."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from typing import Any

import pytest

from tools import output


@pytest.fixture
def full_disk(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """The disk is full for files whose name contains the text."""
    make = output.tempfile.mkstemp
    sync = os.fsync
    hit: set[int] = set()
    texts: list[str] = []

    def mkstemp(*args: Any, **options: Any) -> tuple[int, str]:
        handle, name = make(*args, **options)
        if any(text in name for text in texts):
            hit.add(handle)
        return handle, name

    def fsync(fd: int) -> None:
        if fd in hit:
            hit.discard(fd)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(fd)

    monkeypatch.setattr(output.tempfile, "mkstemp", mkstemp)
    monkeypatch.setattr(output.os, "fsync", fsync)
    return texts.append
