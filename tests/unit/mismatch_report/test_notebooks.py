"""The notebooks of the documents run from their first cell to their last, and find what was put in."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest

FOLDER = Path(__file__).parents[3] / "docs" / "notebooks"


def run_cells(name: str) -> dict[str, Any]:
    """Execute the code of a notebook, and show what each cell ends in as a notebook would."""
    cells = json.loads((FOLDER / name).read_text(encoding="utf-8"))["cells"]
    scope: dict[str, Any] = {}
    for cell in cells:
        if cell["cell_type"] != "code":
            continue
        lines = "".join(cell["source"]).rstrip().splitlines()
        exec("\n".join(lines), scope)
        if lines[-1].isidentifier() or lines[-1].endswith((".plot()", ".to_dataframe()")):
            value = eval(lines[-1], scope)
            assert any(hasattr(value, show) for show in ("_repr_html_", "_repr_png_"))
            if hasattr(value, "_repr_png_"):
                assert value._repr_png_().startswith(b"\x89PNG")
    return scope


@pytest.fixture(autouse=True)
def without_a_screen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pandas", reason="pandas is an extra: pip install 'micron-bench[notebook]'")
    monkeypatch.chdir(tmp_path)
    mpl.use("agg")


@pytest.mark.slow
def test_the_motor() -> None:
    diagnosis = run_cells("motor.ipynb")["diagnosis"]
    assert [p.name for p in diagnosis.physics] == ["backlash"]
    assert diagnosis.physics[0].parameters["gap"].value == pytest.approx(np.degrees(0.03), rel=0.02)


@pytest.mark.slow
def test_the_stack() -> None:
    diagnosis = run_cells("piezo_stack.ipynb")["diagnosis"]
    fit = diagnosis.report.fit
    assert diagnosis.verdict == "missing_physics"
    assert diagnosis.to_html().lstrip().lower().startswith("<!doctype html>")
    assert "hysteresis" in diagnosis.physics[0].name
    assert fit.fitted_rms["displacement"] < 1.5 * 0.004
    assert fit.recalibrated_rms["displacement"] > 10 * fit.fitted_rms["displacement"]


def test_every_notebook_is_run_here_and_kept_without_outputs() -> None:
    tested = {"motor.ipynb", "piezo_stack.ipynb"}
    assert {p.name for p in FOLDER.glob("*.ipynb")} == tested
    for path in FOLDER.glob("*.ipynb"):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        assert not any(cell.get("outputs") for cell in cells)
