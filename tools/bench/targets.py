"""Runs the targeting experiment on the page: the firmware's state machine, driven by the pointer that a browser reports
or by the motion card of the endoscope bench that runs."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from firmware_py.endoscope.control import ControlConfig
from firmware_py.endoscope.report import experiment, report_csv
from firmware_py.endoscope.targets import GameConfig, GameState, TargetGame
from firmware_py.frame import Layout
from tools.bench.recorder import check_name
from tools.errors import InputError
from tools.output import write_text_atomic

Source = Literal["mouse", "card"]
MAX_ANGLE_DEG = 180.0
CARD = ("psi", "theta", "card_status", "used")
"""Columns of the endoscope's frame that play in place of the mouse."""


def has_card(layout: Layout) -> bool:
    """Return True for an instrument that is steered by a motion card."""
    return set(CARD) <= set(layout.scalar_names())


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


class Targets:
    """The experiment that is on; one for all viewers of the bench."""

    def __init__(self, folder: Path, read_clock_s: Callable[[], float] = time.monotonic) -> None:
        self._folder = folder
        self._read_clock_s = read_clock_s
        self.game: Game | None = None
        self.source: Source = "mouse"

    def start(self, user: str, mapping: str, source: str, seed: int, layout: Layout) -> None:
        """Start a game. ``layout`` is that of the instrument that runs. Raises ``InputError`` when it cannot be."""
        if mapping not in ("position", "speed"):
            raise InputError(f"{mapping!r} is not a mapping; there are position and speed")
        config = GameConfig(control=ControlConfig(mapping=mapping), seed=seed)  # pyright: ignore[reportArgumentType]
        game = Game(config, user, self._folder, self._read_clock_s)
        if source not in ("mouse", "card"):
            raise InputError(f"{source!r} is not a pointer; there are mouse and card")
        if source == "card" and not has_card(layout):
            raise InputError("the bench that runs has no motion card; run one that has, such as endoscope.toml (Setup)")
        self.game, self.source = game, "card" if source == "card" else "mouse"

    def follow(self, rows: NDArray[np.float64], layout: Layout) -> None:
        """Take ``rows`` (n, columns) of the running instrument. They move the view if the card plays."""
        if self.game is None or self.source != "card" or not has_card(layout):
            return
        for row in rows[:, [layout.start(name) for name in CARD]].tolist():
            psi, theta, status, used = row
            self.game.card(psi, theta, round(status), bool(used))

    def pointer(self, psi_deg: float, theta_deg: float, pressed: bool) -> None:
        if self.game is not None and self.source == "mouse":
            self.game.pointer(psi_deg, theta_deg, pressed)

    def as_dict(self) -> dict[str, Any] | None:
        """Return the JSON values for the page, or None when nothing is played."""
        if self.game is None:
            return None
        return {**self.game.as_dict(), "source": self.source}

    def reports(self) -> list[str]:
        return sorted((p.name for p in self._folder.glob("*.csv")), reverse=True)

    def report(self, name: str) -> Path:
        """A report file. ``InputError`` when there is none of that name."""
        path = self._folder / Path(name).name
        if not path.is_file() or path.is_symlink():
            raise InputError(f"there is no report {name!r}")
        return path
