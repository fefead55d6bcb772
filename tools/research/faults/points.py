"""Operating points: whose hand holds the instrument while something breaks."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from hal.bench import load_bench
from hal.errors import BenchError


@dataclass(frozen=True)
class Point:
    """``hand``: keys of [emulation.hand] that differ from the bench's own."""

    name: str
    hand: Mapping[str, float] = field(default_factory=dict[str, float])


POINTS = (
    Point("steady", {"tremor_pp_um": 15.0, "voluntary_range_um": 20.0}),
    Point("typical"),
    Point("rough", {"tremor_pp_um": 150.0, "voluntary_range_um": 2000.0}),
)


def write_bench(bench: Path, point: Point, folder: Path) -> Path:
    """A copy of ``bench`` for ``point`` in ``folder``; calibration files keep their place.

    Raises ``BenchError`` when the bench sets the hand itself.
    """
    file = load_bench(bench)
    if point.hand and "hand" in file.description.emulation:
        raise BenchError(f"{bench}: [emulation.hand] is set; the campaign sets it for its operating points")
    text = re.sub(
        r'"([^"\n]+\.toml)"', lambda m: f'"{file.resolve(m.group(1))}"' if file.resolve(m.group(1)).is_file() else m[0],
        file.text,
    )  # fmt: skip
    if point.hand:
        text += "\n[emulation.hand]\n" + "".join(f"{key} = {value}\n" for key, value in point.hand.items())
    path = folder / f"{file.description.name}-{point.name}.toml"
    path.write_text(text, encoding="utf-8")
    return path
