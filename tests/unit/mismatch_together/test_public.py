"""Measured sets of several recordings: what their page says, and which folder is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.research.prove import together_public as public

ROW = {
    "set": "tanks", "revision": "abc, 2026-11-30", "recordings": 2, "samples": 2048, "cpu_s": 40,
    "verdict": "missing_physics", "names": {"square_root_flow": 0.9}, "alike": [["square_root_flow", "overflow"]],
    "unit": {"level": "V"}, "as_given": {"level": 0.5}, "recalibrated": {"level": 0.4}, "fitted": {"level": 0.2},
    "floor": {"level": [0.01, 0.02]}, "floor_from": {"level": "repeats"}, "changes": [],
}  # fmt: skip


def test_the_page_says_what_was_named_and_what_was_not_run() -> None:
    text = public.page([ROW])
    answer = "square root flow 90 % (square root flow = overflow)"
    assert f"| two tanks | 2 | 2048 | 40 | missing physics | {answer} | level (V) | 0.5 | 0.4 | 0.2 |" in text
    assert "0.01 to 0.02, repeats |" in text
    assert text.strip().endswith("positioning axis (EMPS).")
    assert "two tanks" not in text.splitlines()[-1]


def test_a_folder_without_the_data_is_one_message(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        public.main(["--data", str(tmp_path), "--keep", str(tmp_path / "keep")])
    assert ended.value.code == 2
    assert "holds no coupled_electric_drives/prbs_0V5.toml" in capsys.readouterr().err
    assert not (tmp_path / "keep").exists()
