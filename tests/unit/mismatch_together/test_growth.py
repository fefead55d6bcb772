"""Time and memory of many recordings together: what is written, and how growth is judged."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tools.mismatch.together import load_together
from tools.research.prove.growth import exponent, main, page, write_runs


def row(recordings: int, cpu_s: float, place: str = "here", **more: Any) -> dict[str, Any]:
    cost = {"cpu_s": cpu_s, "wall_s": cpu_s, "peak_MB": 500, "samples": recordings * 12_000, "seconds": 60.0}
    answer = {"names": ["backlash"], "changes": ["gain_um_per_V: temperature_C"], "revision": "a, 2026-01-01"}
    return {"recordings": recordings, "place": place, "processes": 2, **cost, **answer, **more}


def test_recordings_are_of_one_system(tmp_path: Path) -> None:
    write_runs(tmp_path / "runs", 3, seconds=2.0)
    joined = load_together([tmp_path / "runs"], ["gain"])
    assert (len(joined.parts), joined.n) == (3, 1200)


def test_time_in_proportion_has_an_exponent_of_one() -> None:
    assert exponent([row(25, 10.0), row(50, 20.0), row(100, 40.0)], "cpu_s") == pytest.approx(1.0)
    assert exponent([row(25, 10.0), row(50, 40.0)], "cpu_s") == pytest.approx(2.0)


def test_the_page_says_where_and_how_it_grows() -> None:
    text = page([row(50, 40.0), row(25, 10.0), row(25, 12.0, "dask", workers_MB=300)])
    assert "| this machine, joblib, processes: 2 | 25 | 300000 | 10 | 0.40 | 10 | 500 | backlash, gain" in text
    assert "| Dask, workers: 2 | 25 | 300000 | 12 | 0.48 | 12 | 500, each worker 300 |" in text
    assert "grows with the power 2.00 of the number of recordings" in text
    assert "this machine, joblib: 100, 200; Dask: 50, 100, 200." in text


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_run_keeps_its_rows_and_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--keep", str(tmp_path / "keep"), "--seconds", "5", "--place", "here", "--processes", "1"]
    main([*options, "--counts", "2"])
    main([*options, "--counts", "2", "3"])
    kept = (tmp_path / "keep" / "growth.jsonl").read_text().splitlines()
    assert len(kept) == 2
    assert "| this machine, joblib, processes: 1 | 3 | 3000 |" in capsys.readouterr().out
