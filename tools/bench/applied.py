"""Keeps the calibrations and the corrected twin that the page applied, in a copy of the bench file; one step goes
back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from firmware_py.frame import LAYOUT
from hal.bench import BenchFile, load_bench
from tools.bench.bench_copy import with_calibration, with_twin
from tools.bench.session import Session
from tools.errors import InputError
from tools.output import write_text_atomic

TWIN = "corrected twin"


class Applied:
    """Holds what is applied, in order, and ``original``, the bench file to go back to (None while nothing is
    applied)."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._folder = session.recorder.folder / "applied"
        self.original: Path | None = None
        self.what: list[str] = []
        self._copies = 0

    async def calibration(self, kind: str, toml: str) -> Path:
        """Start the firmware again with the calibration file ``toml`` over the calibrations that the bench has."""
        return await self._apply(kind, f"{kind}.toml", toml, with_calibration)

    async def twin(self, source: Path) -> Path:
        """Start the emulated bench again with a corrected twin in its stacks' place. ``BenchError`` when it cannot."""
        if TWIN in self.what:
            raise InputError("a corrected twin is applied already; go back to the original bench first")
        return await self._apply(TWIN, "twin.toml", source.read_text(encoding="utf-8"), with_twin)

    async def discard(self) -> None:
        """Back to the original bench, if something was applied."""
        if self.original is not None:
            original, self.original, self.what = self.original, None, []
            await self._session.start(replace(self._session.choice, bench=original))

    async def _apply(self, what: str, name: str, toml: str, laid_over: Callable[[BenchFile, Path, Path], Path]) -> Path:
        if self._session.recorder.active:
            raise InputError("a recording is running; stop it first: the firmware starts again with the copy")
        if self._session.layout is not LAYOUT:
            raise InputError("this bench is of another instrument, which takes neither calibrations nor twins")
        choice = self._session.choice
        original = self.original or choice.bench
        self._folder.mkdir(parents=True, exist_ok=True)
        kept = self._folder / name
        write_text_atomic(kept, toml)
        # a new copy each time: the one before stays what it was for whoever compares
        copy = self._folder / f"{original.stem}.{self._copies + 1}.toml"
        out = laid_over(load_bench(choice.bench), kept, copy)
        self.original, self._copies = original, self._copies + 1
        self.what = [*(w for w in self.what if w != what), what]
        await self._session.start(replace(choice, bench=out))
        return out
