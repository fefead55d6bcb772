"""Files dropped into the Mismatch view: columns drawn, roles, units and twin described, and bad input in one place."""

from __future__ import annotations

import http.client
import json
import re
import threading
import tomllib
import urllib.error
import urllib.request
import zipfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.bench.conftest import go
from tests.bench.still import Still
from tests.bench.test_replay import write
from tools.bench.dropped import NEEDS_FILE, OFFERED, description, parameter_value
from tools.bench.dropped_files import MOST_KEPT, Dropped
from tools.bench.guard import MAX_UPLOAD_BYTES
from tools.errors import InputError
from tools.mismatch.key_tables import of_kind
from tools.mismatch.keys import Key
from tools.mismatch.recording_load import load
from tools.mismatch.twins.make import make

pytestmark = pytest.mark.timeout(400)


def motor(path: Path, n: int = 1000) -> Path:
    t = np.arange(n) / 200.0
    force = 8 * np.sin(2 * np.pi * 0.7 * t)
    table = np.column_stack([t, force, 20 * np.cos(t), 20 + t])
    np.savetxt(path, table, delimiter=",", header="t_s,force_N,x_mm,temp_degC", comments="")
    return path


@pytest.mark.parametrize(
    ("said", "value"),
    [("2.1", 2.1), ("[1, 2.5]", [1, 2.5]), ('{ "1" = [0, 0, 1] }', {"1": [0, 0, 1]}), ("zero", "zero"), ("true", True)],
)
def test_what_is_typed_for_a_parameter(said: str, value: Any):
    assert parameter_value("p", said) == value


@pytest.mark.parametrize("said", ["2,1", "[1, 2", "= 3", "1\nformat = 2", "'"])
def test_what_is_no_value_is_refused(said: str):
    with pytest.raises(InputError, match="parameter mass"):
        parameter_value("mass", said)


def test_kinds_that_name_a_file_take_one_of_this_machine(still: Still, tmp_path: Path):
    assert set(NEEDS_FILE) <= set(OFFERED)
    with pytest.raises(InputError, match="choose a kind"):
        description({"kind": ""}, "data.csv")
    code, said = put(still, "run.csv", motor(tmp_path / "a.csv").read_bytes(), still.token)
    assert code == 200
    number = json.loads(said)["number"]
    table = {
        "number": number, "name": "whole instrument", "kind": "instrument", "time_column": "t_s",
        "channels": [
            {"column": "force_N", "role": "input", "signal": "command_1", "unit": "V"},
            {"column": "x_mm", "role": "output", "signal": "tip_x", "unit": "um"},
        ],
    }  # fmt: skip
    for kind, key, wrong in (
        ("instrument", "bench", "passwd.toml"),
        ("fmu", "path", "none.fmu"),
        ("fmu", "path", ""),
    ):
        said = post(still, "/api/mismatch/new", {**table, "kind": kind, "parameters": {key: wrong}}, 400)["error"]
        assert "choose one of the files" in said
    for kind in json.loads(get(still, "/api/mismatch/kinds"))["kinds"]:
        assert (kind["files"] != []) == (kind["kind"] == "instrument"), "there is no FMU among the recordings"
    post(still, "/api/mismatch/new", {**table, "parameters": {"bench": "micron.toml", "hand": "bench"}}, 200)
    folder = still.session.recorder.folder / "whole instrument"
    assert make(load(folder)).kind == "instrument"
    assert (folder / "micron.toml").read_bytes() == (still.session.home / "micron.toml").read_bytes()


def test_simulated_columns_beside_measured_ones_are_a_twin(still: Still, tmp_path: Path):
    code, said = put(still, "two.csv", motor(tmp_path / "a.csv").read_bytes(), still.token)
    assert code == 200
    table = {
        "number": json.loads(said)["number"], "name": "other program", "kind": "columns", "time_column": "t_s",
        "channels": [
            {"column": "temp_degC", "role": "input", "signal": "simulated_x", "unit": "mm"},
            {"column": "x_mm", "role": "output", "signal": "x", "unit": "mm"},
        ],
    }  # fmt: skip
    post(still, "/api/mismatch/new", table, 200)
    assert make(load(still.session.recorder.folder / "other program")).kind == "columns"


def test_the_oldest_file_that_nobody_described_goes(tmp_path: Path):
    dropped = Dropped(tmp_path)
    kept = []
    for k in range(MOST_KEPT + 2):
        number, path = dropped.new_file(f"{k}.csv")
        path.write_text("a")
        dropped.files[number] = path
        kept.append((number, path))
    assert [path.exists() for _, path in kept] == [False, False] + [True] * MOST_KEPT
    with pytest.raises(InputError, match="drop it again"):
        dropped.get(kept[0][0])
    dropped.close()
    assert list(tmp_path.iterdir()) == []


def put(still: Still, name: str, body: bytes, token: str | None, length: int | None = None) -> tuple[int, str]:
    connection = http.client.HTTPConnection(*still.place, timeout=60)
    connection.putrequest("PUT", f"/api/upload/{name}")
    connection.putheader("Content-Length", str(len(body) if length is None else length))
    if token is not None:
        connection.putheader("X-Micron-Token", token)
    connection.endheaders(body)
    answer = connection.getresponse()
    found = answer.status, answer.read().decode()
    connection.close()
    return found


def test_orders_are_answered_while_the_kinds_are_looked_up(still: Still, monkeypatch: pytest.MonkeyPatch):
    """The first look imports modules, which takes seconds on a busy machine."""
    looking, answered = threading.Event(), threading.Event()

    def slow(kind: str) -> Sequence[Key]:
        looking.set()
        assert answered.wait(60), "the server answers nobody else meanwhile"
        return of_kind(kind)

    monkeypatch.setattr("tools.bench.dropped.of_kind", slow)
    with ThreadPoolExecutor(1) as pool:
        asked = pool.submit(get, still, "/api/mismatch/kinds")
        assert looking.wait(60)
        post(still, "/api/safe", {}, 200)
        answered.set()
        assert len(json.loads(asked.result(60))["kinds"]) == len(OFFERED)


def test_who_may_send_what(still: Still, tmp_path: Path):
    csv = motor(tmp_path / "a.csv").read_bytes()
    assert put(still, "a.csv", b"", None, 10)[0] == 403
    assert put(still, "a.csv", b"", "wrong", 10)[0] == 403
    code, said = put(still, "a.csv", b"", still.token, 500_000_000)
    assert code == 413
    assert f"{MAX_UPLOAD_BYTES // 1_000_000} MB" in said
    code, said = put(still, "a.csv", csv, still.token)
    assert code == 200, said
    own = tmp_path / "own.mcap"
    write(own, 3.0)
    for name, body, part in (
        ("a.exe", csv, "must be .csv"),
        ("torn.npz", b"PK\x03\x04 and no more", "(File is not a zip file); write it again"),
        ("torn.mcap", b"\x89MCAP0\r\n" + bytes(40), "torn.mcap"),
        ("own.mcap", own.read_bytes()[:-3000], "micron recover"),
        ("words.csv", b"a,b\nx,y\n", "is not a number"),
        ("empty.csv", b"", "empty"),
    ):
        code, said = put(still, name, body, still.token)
        assert (code, part in said) == (400, True), said
        assert "/dropped" not in said
        assert "/.dropped" not in said
    left = [p for p in still.session.recorder.folder.iterdir() if p.name.startswith(".dropped")]
    assert [len(list(p.iterdir())) for p in left] == [1], "the good one alone is kept"


def post(still: Still, path: str, table: dict[str, Any], expected: int) -> dict[str, Any]:
    request = urllib.request.Request(f"{still.base}{path}", json.dumps(table).encode(), {"X-Micron-Token": still.token})
    try:
        with urllib.request.urlopen(request, timeout=60) as answer:
            code, said = answer.status, answer.read()
    except urllib.error.HTTPError as error:
        with error:
            code, said = error.code, error.read()
    assert code == expected, said
    return json.loads(said)


def get(still: Still, path: str) -> bytes:
    with urllib.request.urlopen(f"{still.base}{path}", timeout=60) as answer:
        return answer.read()


@pytest.fixture
def page(still_page: Any) -> Any:
    go(still_page, "mismatch")
    still_page.wait_for_selector("select option", state="attached")
    return still_page


FILE = "input[aria-label='Data file']"


def test_a_csv_becomes_a_recording_that_is_diagnosed(page: Any, still: Still, tmp_path: Path):
    page.set_input_files(FILE, motor(tmp_path / "my motor.csv"))
    form = page.locator(".new-recording")
    form.wait_for()
    assert form.locator("canvas").count() == 4
    assert form.locator("[aria-label='Kind of twin']").input_value() == "mechanical_axis"
    assert form.locator("[aria-label='Signal of x_mm']").input_value() == "position"
    form.locator("[aria-label=mass]").fill("2.1")
    form.locator("[aria-label=stiffness]").fill("120")
    form.locator("[aria-label='Unit of x_mm']").fill("kg")
    page.screenshot(path="out/browser/dropped.png") if Path("out/browser").is_dir() else None
    form.locator("text=Make the recording").click()
    page.wait_for_function("document.querySelector('.new-recording p[role=alert]').textContent.includes('kg')")
    said = form.locator("p[role=alert]").inner_text()
    assert said == "column 'x_mm': unit 'kg' is not of the dimension of m or rad"
    assert form.locator("[aria-label=mass]").input_value() == "2.1", "nothing is lost"
    form.locator("[aria-label='Unit of x_mm']").fill("mm")
    form.locator("[aria-label=damping]").fill("5,0")
    form.locator("text=Make the recording").click()
    page.wait_for_function("document.querySelector('.new-recording p[role=alert]').textContent.includes('damping')")
    form.locator("[aria-label=damping]").fill("5.0")
    form.locator("text=Make the recording").click()
    page.wait_for_function("document.querySelector('[aria-label=Recording]').value === 'my motor/'")
    page.wait_for_function("document.getElementById('view').innerText.includes('diagnose my motor/')")
    assert not form.is_visible()
    page.locator("button", has_text="Cancel").click()
    made = still.session.recorder.folder / "my motor"
    assert load(made).twin.kind == "mechanical_axis"
    text = tomllib.loads((made / "recording.toml").read_text())
    assert text["twin"]["parameters"] == {"mass": 2.1, "damping": 5.0, "stiffness": 120}
    assert [c["unit"] for c in text["channels"]] == ["N", "mm", "degC"]


def stack(path: Path) -> Path:
    """A stack with 0.15 um/V on one tone and noise, 200 Hz, 0.02 um of noise."""
    rng = np.random.default_rng(1)
    t_s = np.arange(800) / 200.0
    command = 50.0 + 20.0 * np.sin(2.0 * np.pi * 3.0 * t_s) + rng.standard_normal(t_s.size)
    displacement = 0.15 * command + 0.02 * rng.standard_normal(t_s.size)
    table = np.column_stack([t_s, command, displacement])
    np.savetxt(path, table, delimiter=",", header="t_s,command_V,displacement_um", comments="", fmt="%.9g")
    return path


def test_a_parameter_that_the_twin_does_not_take_is_said_in_the_form(page: Any, still: Still, tmp_path: Path):
    page.set_input_files(FILE, stack(tmp_path / "own stack.csv"))
    form = page.locator(".new-recording")
    form.locator("[aria-label=gain_um_per_V]").fill("twelve")
    form.locator("text=Make the recording").click()
    alert = form.locator("p[role=alert]", has_text="gain_um_per_V")
    alert.wait_for()
    assert alert.inner_text() == "[twin.parameters] gain_um_per_V must be a finite number, got 'twelve'"
    assert form.locator("[aria-label=gain_um_per_V]").input_value() == "twelve", "nothing is lost"
    assert not (still.session.recorder.folder / "own stack").exists(), "nothing half written"


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_from_a_dropped_csv_to_the_corrected_twin_that_is_downloaded(page: Any, tmp_path: Path, artefacts: Path):
    page.set_input_files(FILE, stack(tmp_path / "my stack.csv"))
    form = page.locator(".new-recording")
    form.wait_for()
    assert form.locator("[aria-label='Kind of twin']").input_value() == "piezo_stack"
    form.locator("[aria-label=gain_um_per_V]").fill("0.12")
    form.locator("[aria-label='Noise of displacement_um']").fill("0.02")
    form.locator("text=Make the recording").click()
    page.wait_for_selector("iframe.report", timeout=600_000)
    twin_button = page.locator("button", has_text="Corrected twin")
    twin_button.wait_for(timeout=200_000)
    page.screenshot(path=artefacts / "dropped-report.png")
    with page.expect_download() as download:
        twin_button.click()
    download.value.save_as(tmp_path / "twin.toml")
    said = (tmp_path / "twin.toml").read_text()
    gains = [float(found) for found in re.findall(r"gain_um_per_V\s*=\s*\[?\s*([0-9.eE+-]+)", said)]
    assert gains[0] == pytest.approx(0.15, rel=0.01), said


def test_a_comparison_that_was_cancelled_shows_what_it_has(page: Any, still: Still):
    """A run that was cut short has no percentage: its report says null."""
    job = {"kind": "difference", "title": "both benches", "state": "cancelled", "step": 0, "steps": 2, "seconds": 1.0,
           "lines": ["interrupted"], "files": ["before.json"]}  # fmt: skip
    state = json.loads(get(still, "/api/mismatch")) | {"applied": ["corrected twin"], "difference": job}
    found = {"job": job, "before": {"band": [25.0, None, None], "all": [30.0, None]}}
    page.route("**/api/mismatch", lambda route: route.fulfill(json=state))
    page.route("**/api/mismatch/difference", lambda route: route.fulfill(json=found))
    page.evaluate("micron.context.reload('mismatch')")
    page.wait_for_selector("#difference")
    rows = [row.locator("td").all_inner_texts() for row in page.locator("#difference tbody tr, #difference > tr").all()]
    assert [cells[1:] for cells in rows] == [["25.00 µm", "–", "–", "–"], ["…", "…", "…", "…"]]
    assert "cancelled: interrupted" in page.locator("#view").inner_text()


@pytest.fixture
def fmu(still: Still) -> Iterator[Path]:
    """An FMU among the recordings; what is in it is read by nobody before it is trusted."""
    path = still.session.recorder.folder / "stage.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", "<fmiModelDescription/>")
    yield path
    path.unlink()


def test_an_fmu_of_this_machine_is_chosen_with_parameters_of_its_own(page: Any, fmu: Path, tmp_path: Path):
    page.set_input_files(FILE, motor(tmp_path / "own fmu.csv"))
    form = page.locator(".new-recording")
    form.locator("[aria-label='Kind of twin']").select_option("fmu")
    assert form.locator("select[aria-label=path] option").all_inner_texts() == ["stage.fmu"]
    assert "micron trust" in form.inner_text()
    others = form.locator("[aria-label='Other parameters']")
    others.fill("um_per_W 2.0")
    form.locator("text=Make the recording").click()
    alert = form.locator("p[role=alert]", has_text="'um_per_W 2.0' is not a new name = value")
    alert.wait_for()
    others.fill("um_per_W = 2.0\n\ncontroller.gain = 3\n")
    form.locator("text=Make the recording").click()
    # no program runs that nobody has trusted: the job says so
    page.locator(".lines", has_text="nobody here has trusted").wait_for(timeout=200_000)
    made = fmu.with_name("own fmu")
    text = tomllib.loads((made / "recording.toml").read_text())
    assert text["twin"] == {
        "kind": "fmu", "parameters": {"path": "stage.fmu", "um_per_W": 2.0, "controller.gain": 3}
    }  # fmt: skip
    assert (made / "stage.fmu").read_bytes() == fmu.read_bytes()
    assert not form.is_visible()


def test_a_file_that_is_dropped_is_taken(page: Any, tmp_path: Path):
    page.evaluate(
        """(text) => {
            const data = new DataTransfer();
            data.items.add(new File([text], "dropped.csv", { type: "text/csv" }));
            const drop = new DragEvent("drop", { dataTransfer: data, bubbles: true });
            document.querySelector(".mismatch").dispatchEvent(drop);
        }""",
        motor(tmp_path / "a.csv", 100).read_text(),
    )
    page.locator(".new-recording", has_text="dropped.csv").wait_for()


def test_a_csv_of_500_mb_is_one_message_and_what_was_there_stays(page: Any, tmp_path: Path):
    page.set_input_files(FILE, motor(tmp_path / "first.csv"))
    form = page.locator(".new-recording")
    form.wait_for()
    form.locator("[aria-label='Noise of x_mm']").fill("0.02")
    form.locator("[aria-label='Unit of x_mm']").fill("parsnips")
    form.locator("text=Make the recording").click()
    form.locator("p[role=alert]", has_text="parsnips").wait_for()
    with (tmp_path / "large.csv").open("wb") as file:
        file.truncate(500_000_000)
    page.set_input_files(FILE, tmp_path / "large.csv")
    said = "large.csv has 500.0 MB; the page takes 200.0 MB"
    page.wait_for_function(f"document.querySelector('.mismatch').innerText.includes('{said}')")
    alerts = [alert.inner_text() for alert in page.locator(".mismatch [role=alert]:visible").all()]
    assert len([text for text in alerts if text]) == 1, "the form's message of before is gone"
    box = page.locator(".mismatch [role=alert]", has_text="large.csv").bounding_box()
    assert box["y"] >= 0, "it is seen"
    assert box["y"] + box["height"] <= page.evaluate("innerHeight"), "it is seen"
    assert form.locator("[aria-label='Noise of x_mm']").input_value() == "0.02"
    assert "first.csv" in form.inner_text()
