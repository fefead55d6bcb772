"""Runs the targeting experiment on the page: the firmware's state machine, driven by the pointer that a browser reports
or by the motion card of an endoscope bench, read in a process of its own."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from firmware_py.endoscope.control import ControlConfig
from firmware_py.endoscope.report import experiment, report_csv
from firmware_py.endoscope.targets import GameConfig, GameState, TargetGame
from hal.bench import load_bench
from hal.children import child_command, child_environment
from tools.bench.recorder import check_name
from tools.errors import InputError
from tools.output import write_text_atomic

Source = Literal["mouse", "card"]
MAX_ANGLE_DEG = 180.0


class Game:
    """Runs the experiment once for one user. ``read_clock_s`` returns seconds that never run backwards."""

    def __init__(self, config: GameConfig, user: str, folder: Path, read_clock_s: Callable[[], float]) -> None:
        self.user = check_name(user or "user")
        self._folder = folder
        self._game = TargetGame(config)
        self._read_clock_s = read_clock_s
        self._started_s = read_clock_s()
        self._report: Path | None = None
        self.state: GameState = self._game.state()

    @property
    def config(self) -> GameConfig:
        return self._game.config

    def _now_s(self) -> float:
        return self._read_clock_s() - self._started_s

    def pointer(self, psi_deg: float, theta_deg: float, pressed: bool) -> None:
        """Take angles from the mouse. Values that are not finite are dropped."""
        if all(math.isfinite(v) and abs(v) <= MAX_ANGLE_DEG for v in (psi_deg, theta_deg)):
            self.state = self._game.step((psi_deg, theta_deg), pressed, self._now_s())
            self._keep_report()

    def card(self, psi_deg: float, theta_deg: float, status: int, use: bool) -> None:
        """Take a sample of the motion card."""
        self.state = self._game.step_card((psi_deg, theta_deg), status, self._now_s(), use=use)
        self._keep_report()

    def _keep_report(self) -> None:
        if self.state.done and self._report is None:
            self._folder.mkdir(parents=True, exist_ok=True)
            stamp = datetime.now(UTC).strftime("%Y-%m-%d %H.%M.%S")
            self._report = self._folder / f"{self.user} {stamp}.csv"
            write_text_atomic(self._report, report_csv(self.user, self.result()))

    def result(self) -> dict[str, Any]:
        """Return the experiment so far."""
        return experiment(self._game)

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON values for the page, with the whole result once it is done."""
        c = self._game.config.control
        table: dict[str, Any] = {**self.state.as_dict(), "user": self.user, "screen": [c.width_px, c.height_px]}
        table["tolerance_px"] = self._game.config.tolerance_px
        if self._report is not None:
            table["report"] = self._report.name
            table["result"] = self.result()
        return table


class CardReader:
    """``python -m tools.bench.card BENCH`` and what it says, a JSON line per sample."""

    def __init__(self, process: asyncio.subprocess.Process, on_sample: Callable[[dict[str, Any]], None]) -> None:
        self._process = process
        self.error = ""
        self._task = asyncio.create_task(self._read(on_sample))

    @classmethod
    async def start(cls, bench: Path, on_sample: Callable[[dict[str, Any]], None]) -> CardReader:
        """Start a game. Raises ``InputError`` for a bench without a motion card."""
        if not load_bench(bench).description.devices_with("motion_card"):
            raise InputError(f"{bench} has no motion_card; choose a bench like endoscope.toml")
        process = await asyncio.create_subprocess_exec(
            *child_command("tools.bench.card", str(bench)),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
            env=child_environment(),
        )
        return cls(process, on_sample)

    async def _read(self, on_sample: Callable[[dict[str, Any]], None]) -> None:
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        async for line in self._process.stdout:
            with contextlib.suppress(ValueError):
                on_sample(json.loads(line))
        stderr = (await self._process.stderr.read()).decode(errors="replace").strip()
        if await self._process.wait() > 0:
            self.error = stderr.splitlines()[-1] if stderr else "the motion card's reader ended"

    async def stop(self) -> None:
        if self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                self._process.terminate()
        await asyncio.gather(self._task, return_exceptions=True)


class Targets:
    """The experiment that is on; one for all viewers of the bench."""

    def __init__(self, folder: Path, read_clock_s: Callable[[], float] = time.monotonic) -> None:
        self._folder = folder
        self._read_clock_s = read_clock_s
        self.game: Game | None = None
        self.source: Source = "mouse"
        self._reader: CardReader | None = None

    async def start(self, user: str, mapping: str, source: str, bench: Path | None, seed: int) -> None:
        """A new run. ``InputError`` when it cannot be."""
        if mapping not in ("position", "speed"):
            raise InputError(f"{mapping!r} is not a mapping; there are position and speed")
        await self.stop()
        config = GameConfig(control=ControlConfig(mapping=mapping), seed=seed)  # pyright: ignore[reportArgumentType]
        game = Game(config, user, self._folder, self._read_clock_s)
        if source == "card":
            if bench is None:
                raise InputError("name the bench file whose motion card shall be used")
            self._reader = await CardReader.start(
                bench, lambda s: game.card(s["psi"], s["theta"], s["status"], s["use"])
            )
        elif source != "mouse":
            raise InputError(f"{source!r} is not a pointer; there are mouse and card")
        self.game, self.source = game, "card" if source == "card" else "mouse"

    async def stop(self) -> None:
        reader, self._reader, self.game = self._reader, None, None
        if reader is not None:
            await reader.stop()

    def pointer(self, psi_deg: float, theta_deg: float, pressed: bool) -> None:
        if self.game is not None and self.source == "mouse":
            self.game.pointer(psi_deg, theta_deg, pressed)

    def as_dict(self) -> dict[str, Any] | None:
        """Return the JSON values for the page, or None when nothing is played."""
        if self.game is None:
            return None
        error = self._reader.error if self._reader is not None else ""
        return {**self.game.as_dict(), "source": self.source, "error": error}

    def reports(self) -> list[str]:
        return sorted((p.name for p in self._folder.glob("*.csv")), reverse=True)

    def report(self, name: str) -> Path:
        """A report file. ``InputError`` when there is none of that name."""
        path = self._folder / Path(name).name
        if not path.is_file() or path.is_symlink():
            raise InputError(f"there is no report {name!r}")
        return path
