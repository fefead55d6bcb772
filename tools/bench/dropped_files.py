"""Files that were dropped into the page and that nobody has described yet."""

from __future__ import annotations

import secrets
import shutil
import tempfile
from pathlib import Path

from tools.errors import InputError
from tools.mismatch.recording_columns import SUFFIXES

MOST_KEPT = 4


class Dropped:
    """Files that were dropped and are not described yet; the oldest beyond ``MOST_KEPT`` goes."""

    def __init__(self, recordings: Path) -> None:
        self._recordings = recordings
        self._root: Path | None = None
        self.files: dict[str, Path] = {}

    def new_file(self, name: str) -> tuple[str, Path]:
        """Return the number of a new file and where it goes."""
        suffix = Path(name).suffix.lower()
        if suffix not in SUFFIXES:
            raise InputError(f"{name}: a file must be {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}")
        if self._root is None:
            self._root = Path(tempfile.mkdtemp(prefix=".dropped-", dir=self._recordings))
        while len(self.files) >= MOST_KEPT:
            shutil.rmtree(self.files.pop(next(iter(self.files))).parent, ignore_errors=True)
        number = secrets.token_hex(8)
        folder = self._root / number
        folder.mkdir()
        return number, folder / f"data{suffix}"

    def get(self, number: str) -> Path:
        """Return a file. ``InputError`` when it is not kept any more."""
        if number not in self.files:
            raise InputError("this file is not kept any more; drop it again")
        return self.files[number]

    def close(self) -> None:
        if self._root is not None:
            shutil.rmtree(self._root, ignore_errors=True)
