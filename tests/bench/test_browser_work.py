"""What a person does on the page beside looking: recordings taken away, filters compared, long jobs."""

from __future__ import annotations

import csv
import json
import time
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_py.recording.reader import Recording
from tests.bench.conftest import Server, bench_server, go, opened_page
from tests.conftest import DEFAULT_BENCH
from tests.recording_text import stack_channels
from tools.formats.export import FORMATS

pytestmark = pytest.mark.timeout(400)

RECORDING = """
format = 1
title = "a stack with another gain"
data = "data.npz"
rate_hz = 200.0
[twin]
kind = "piezo_stack"
[twin.parameters]
gain_um_per_V = 0.12
"""


def test_a_recording_is_looked_at_downloaded_and_exported(page: Any, server: Server, tmp_path: Path):
    go(page, "collect")
    page.fill("input[placeholder^='Name']", "taken away")
    page.click("#rec-start")
    page.wait_for_selector("#rec:not([hidden])")
    page.fill("input[placeholder='Notes']", "in the middle")
    page.click("text=Add note")
    server.wait_for(lambda s: (s["recording"] or {}).get("written", 0) > 300, "rows")
    page.click("#rec-stop")
    row = page.locator("tr", has_text="taken away")
    row.locator("button", has_text="Download").wait_for()
    assert "in the middle" in row.inner_text()
    row.locator("button", has_text="taken away").click()
    page.wait_for_selector("select[aria-label='What to look at']")
    assert page.locator(".plot .legend").inner_text().count("command") == 3
    with page.expect_download() as download:
        row.locator("button", has_text="Download").click()
    download.value.save_as(tmp_path / "run.mcap")
    recording = Recording(tmp_path / "run.mcap")
    ticks = sum(block.data.shape[1] for block in recording.blocks())
    assert ticks > 300
    assert server.token not in str(recording.metadata)
    assert all(server.token.encode() not in path.read_bytes() for path in server.recordings.glob("taken away*"))
    offered = [option.get_attribute("value") for option in row.locator("option").all()]
    assert offered == ["", *FORMATS, "recover"]
    with page.expect_download() as download:
        row.locator("select").select_option("csv")
    download.value.save_as(tmp_path / "run.csv")
    with (tmp_path / "run.csv").open() as file:
        assert sum(1 for _ in csv.DictReader(file)) == ticks


@pytest.mark.slow
def test_another_filter_runs_beside_the_firmwares_and_then_in_it(page: Any, server: Server, artefacts: Path):
    go(page, "attitude")
    choice = "select[aria-label='Filter beside it']"
    page.wait_for_selector(f"{choice} option[value=observer]", state="attached")
    for method in ("quaternion-kalman", "observer"):
        page.select_option(choice, method)
        page.wait_for_function(f"micron.link.state.shadow === '{method}' && micron.link.shadow")
        page.wait_for_function(f"document.getElementById('view').innerText.includes('{method}, ')")
    assert np.linalg.norm(page.evaluate("micron.link.shadow")) == pytest.approx(1.0, abs=1e-3)
    page.screenshot(path=artefacts / "attitude-beside.png")
    run, original = (server.state()[key] for key in ("run", "bench_file"))
    page.click("#use-filter")
    server.wait_for(lambda s: s["run"] > run and s["phase"] == "running", "the firmware with the other filter", 220)
    page.wait_for_selector("h2:has-text('Firmware: observer')")
    page.click("text=Back to the original bench")
    server.wait_for(lambda s: s["bench_file"] == original and s["phase"] == "running", "the original bench", 220)


def wait_for_job(server: Server, kind: str) -> None:
    """Until the job has ended: beside a firmware on a busy machine it has little of a processor. It must be done."""
    while (job := server.request("GET", f"/api/jobs/{kind}")[1])["state"] == "running":
        time.sleep(1.0)
    assert job["state"] == "done", job["lines"]


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_a_diagnosis_from_the_page_and_its_twin_on_the_emulated_bench(page: Any, server: Server, artefacts: Path):
    folder = server.recordings / "stack"
    folder.mkdir()
    (folder / "recording.toml").write_text(RECORDING + stack_channels("command_V", "displacement_um", 0.02))
    rng = np.random.default_rng(1)
    command = 50.0 + 20.0 * np.sin(np.arange(800) / 200.0 * 2.0 * np.pi * 3.0) + rng.standard_normal(800)
    displacement = 0.15 * command + 0.02 * rng.standard_normal(800)
    np.savez(folder / "data.npz", command_V=command, displacement_um=displacement)
    go(page, "mismatch")
    page.select_option("select[aria-label=Recording]", "stack/")
    with page.expect_response("**/api/mismatch/start"):
        page.click("text=Diagnose")
    wait_for_job(server, "mismatch")
    page.wait_for_selector("iframe.report")
    apply = page.locator("button", has_text="Apply to the emulated bench")
    apply.wait_for()
    page.screenshot(path=artefacts / "mismatch-report.png")
    original = server.state()["bench_file"]
    apply.click()
    server.wait_for(lambda s: s["bench_file"] != original and s["phase"] == "running", "the other bench", 220)
    assert 'twin = "' in Path(server.state()["bench_file"]).read_text()
    page.wait_for_selector("#difference")
    assert server.request("POST", "/api/jobs/difference/cancel", b"{}")[0] == 200
    page.click("text=Back to the original bench")
    server.wait_for(lambda s: s["bench_file"] == original and s["phase"] == "running", "the original bench", 220)


def test_a_calibration_is_applied_over_the_bench_and_discarded(page: Any, server: Server):
    go(page, "calibrate")
    page.click("text=Identify the stacks")
    page.wait_for_function("document.getElementById('view').innerText.includes('step 1 of 4')")
    assert server.request("POST", "/api/calibrate/lab", b'{"what": "tumble"}')[0] == 400  # one at a time
    assert server.request("POST", "/api/jobs/calibrate/cancel", b"{}")[0] == 200
    page.wait_for_function("document.getElementById('view').innerText.includes('cancelled')")
    # what the wizard would have sent
    unit = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], float)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    axes = [0, 2, 1, 2, 0, 1]  # 1x 1z 2y 2z 3x 3y
    means = np.column_stack([2.5 + unit[:, axes], np.zeros((len(unit), 2)), np.full(len(unit), 5.0)]).tolist()
    code, found = server.request("POST", "/api/calibrate/poses", json.dumps({"means_V": means}).encode())
    assert code == 200, found
    original = server.state()["bench_file"]
    assert server.request("POST", "/api/calibrate/apply", b'{"kind": "poses"}')[0] == 200
    page.wait_for_function("document.getElementById('view').innerText.includes('Applied over the bench file: poses')")
    assert "poses.toml" in Path(server.state()["bench_file"]).read_text()
    page.click("text=Discard, back to the original")
    server.wait_for(lambda s: s["bench_file"] == original, "the original bench")


TURNING = """
[emulation.hand]
performs = "poses"
reach_s = [2.0, 2.2]
hold_s = [0.0, 0.0]
"""


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_the_pose_wizard_takes_what_a_trembling_hand_shows_it(browser: Any, artefacts: Path):
    known = tomllib.loads((DEFAULT_BENCH.parent / "calibration" / "sensors.toml").read_text())["sensing"]
    with bench_server(TURNING) as server, opened_page(browser, server) as page:
        go(page, "calibrate")
        page.click("button:has-text('Arm nothing while I turn')")
        server.wait_for(lambda s: s["status"].get("state") == "sensing only", "sensing only", 220)
        # the hand repeats its poses: a starved page takes in a later round what it missed
        page.wait_for_selector("b:has-text('All poses are taken')", timeout=0)
        page.click("button:has-text('Identify')")
        page.wait_for_selector("button:has-text('Apply to this bench')")
        page.screenshot(path=artefacts / "poses-taken.png")
        found = server.request("GET", "/api/calibrate")[1]["found"]
        page.click("button:has-text('Arm again')")
        server.wait_for(lambda s: s["status"].get("state") == "running", "running", 220)
    assert found["poses"] == 14
    # the stage's calibration of the same unit, which knows cross-axis terms that poses by hand cannot
    assert found["table"]["bias_V"] == pytest.approx(known["bias_V"], abs=0.01)
    assert found["table"]["scale_V_per_g"] == pytest.approx(known["scale_V_per_g"], rel=0.01)
