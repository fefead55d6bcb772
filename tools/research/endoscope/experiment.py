"""Elapsed times for both mappings and several response times: the shape of Tables 6.1 and 6.2 of Erat 2018."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from firmware_py.endoscope.control import ControlConfig
from firmware_py.endoscope.targets import GameConfig
from tools.research.endoscope.play import play
from tools.research.endoscope.user import UserConfig

RESPONSES_S = (0.25, 0.5, 1.0, 2.0)
EXPERIMENTS = 5
Mapping = Literal["position", "speed"]


@dataclass(frozen=True)
class Cell:
    """Holds all experiments at one response time; ``elapsed_s`` is in the order of the experiments."""

    mapping: Mapping
    response_s: float
    elapsed_s: tuple[float, ...]
    clicks: tuple[int, ...]
    rotation_deg: tuple[float, float]
    done: bool

    @property
    def mean_s(self) -> float:
        return sum(self.elapsed_s) / len(self.elapsed_s)


def run_cell(
    mapping: Mapping, response_s: float, user: UserConfig, *, gain: float = 8.0, experiments: int = EXPERIMENTS
) -> Cell:
    """``experiments`` runs with targets of seeds 1, 2, ...; the same person with fresh noise in each."""
    results = [
        play(
            user.model_copy(update={"seed": 1000 * user.seed + i}),
            GameConfig(control=ControlConfig(mapping=mapping, gain=gain, response_s=response_s), seed=i),
        )
        for i in range(1, experiments + 1)
    ]
    n = len(results)
    return Cell(
        mapping,
        response_s,
        tuple(r["elapsed_s"] for r in results),
        tuple(r["clicks"] for r in results),
        (sum(r["mean_rotation_deg"][0] for r in results) / n, sum(r["mean_rotation_deg"][1] for r in results) / n),
        all(r["done"] for r in results),
    )
