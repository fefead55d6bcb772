"""The code on ``docs/endoscope.md`` runs as it stands there."""

from __future__ import annotations

import re
from pathlib import Path

PAGE = Path(__file__).parents[3] / "docs" / "endoscope.md"


def test_the_targeting_experiment_of_the_page_runs() -> None:
    (code,) = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), flags=re.S | re.M)
    space: dict[str, object] = {}
    exec(f"{code}\nsaid = state.as_dict()", space)
    said = space["said"]
    assert isinstance(said, dict)
    assert set(code.rpartition("# ")[2].strip().split(", ")) <= set(said)
    assert said["view"] == {"x": 320.0, "y": 240.0, "size": 120.0}
    assert not said["done"]
