"""The Setup view: a draft becomes a commented bench file that doctor accepts; parts that a bench lacks are left out."""

from __future__ import annotations

import itertools
import tomllib
from pathlib import Path
from typing import Any

import pytest

from hal.bench import load_bench
from tests.bench.conftest import go
from tests.bench.still import Still
from tests.conftest import DEFAULT_BENCH, copy_of_default_bench
from tools.bench.setup_file import DAQS, OUTPUTS, PLACES, bench_text, checked, read_draft
from tools.diagnose.findings import bench_findings
from tools.diagnose.scan import serial_ports
from tools.errors import InputError

pytestmark = pytest.mark.timeout(400)

SIM = {bus: f"sim://{bus}" for bus in ("daq0", "i2c0", "i2c1", "e7270", "can0")}
GOOD: dict[str, Any] = {
    "name": "lab", "uris": SIM, "inputs": dict(zip(PLACES, range(8), strict=True)),
    "piezo": 0x0C, "magnetometer": 0x48, "monitor": 0x49, "telemetry": True,
}  # fmt: skip


@pytest.mark.parametrize(
    ("magnetometer", "monitor", "telemetry"), list(itertools.product((0x48, None), (0x49, None), (True, False)))
)
def test_doctor_accepts_what_is_written_with_any_parts(
    tmp_path: Path, magnetometer: int | None, monitor: int | None, telemetry: bool
):
    draft = read_draft({**GOOD, "magnetometer": magnetometer, "monitor": monitor, "telemetry": telemetry})
    content = bench_text(draft, [])
    assert [f["verdict"] for f in checked(content, tmp_path)] == ["ok"] * len(checked(content, tmp_path))
    (tmp_path / "lab.toml").write_text(content)
    description = load_bench(tmp_path / "lab.toml").description
    bench_findings(load_bench(tmp_path / "lab.toml"))
    assert ("mag" in description.device) is (magnetometer is not None)
    assert ("monitor" in description.device) is (monitor is not None)
    assert ("telemetry" in description.device) is telemetry
    assert ("i2c1" in description.bus) is (magnetometer is not None or monitor is not None)
    assert ("can0" in description.bus) is telemetry
    assert content.count("#") >= 8, "it is commented"
    assert list(tmp_path.iterdir()) == [tmp_path / "lab.toml"]


@pytest.mark.parametrize("daq", DAQS)
@pytest.mark.parametrize("output", OUTPUTS)
def test_doctor_accepts_every_converter_with_every_output(tmp_path: Path, daq: str, output: str):
    least = {"magnetometer": None, "monitor": None, "telemetry": False, "daq_card": "Dev1", "output_card": "cDAQ1Mod2"}
    draft = read_draft({**GOOD, "daq": daq, "output": output, **least})
    content = bench_text(draft, [])
    not_here = {f["part"] for f in checked(content, tmp_path) if f["verdict"] != "ok"}
    assert not_here <= {part for part in not_here if "nidaqmx" in part or "NI" in part}
    (tmp_path / "lab.toml").write_text(content)
    description = load_bench(tmp_path / "lab.toml").description
    assert description.device["daq"].driver == daq
    assert description.device["piezo"].driver == output
    used = {spec.bus for spec in description.device.values() if spec.bus}
    assert set(description.bus) == used, "no bus that nothing hangs on"


def test_the_bench_with_another_output_is_the_project_s_own(tmp_path: Path):
    """What is written agrees with the benches of the project in everything that decides how the output is driven."""
    for output, own in (("e727", "micron-e727"), ("can_amplifier", "micron-can"), ("dac_amplifier", "micron")):
        written = tomllib.loads(bench_text(read_draft({**GOOD, "output": output}), []))
        known = tomllib.loads(DEFAULT_BENCH.with_name(f"{own}.toml").read_text())
        assert written["device"]["piezo"] == known["device"]["piezo"]
        assert written["firmware"]["tremor"] == known["firmware"]["tremor"]


def test_a_serial_port_is_named_by_its_usb_descriptor_and_nothing_is_sent(tmp_path: Path):
    usb = tmp_path / "sys/devices/usb1/1-2"
    for name, device in (("ttyACM0", usb / "1-2:1.0"), ("ttyUSB0", usb / "1-2:1.1/ttyUSB0"), ("ttyAMA0", tmp_path)):
        device.mkdir(parents=True, exist_ok=True)
        (tmp_path / "dev").mkdir(exist_ok=True)
        (tmp_path / "dev" / name).touch()
        (tmp_path / "sys/class/tty" / name).mkdir(parents=True)
        (tmp_path / "sys/class/tty" / name / "device").symlink_to(device)
    for name, said in (
        ("idVendor", "0683"),
        ("manufacturer", "DATAQ"),
        ("product", "DI-4108\x1b[31m"),
        ("serial", "7"),
    ):
        (usb / name).write_text(said + "\n")
    named = "DATAQ DI-4108[31m 7"
    assert [(p.path, p.product) for p in serial_ports(tmp_path)] == [
        ("/dev/ttyACM0", named), ("/dev/ttyUSB0", named), ("/dev/ttyAMA0", "")
    ]  # fmt: skip


def test_inputs_go_where_they_were_dragged():
    turned = {**GOOD["inputs"], "1x": 5, "3y": 0}
    table = tomllib.loads(bench_text(read_draft({**GOOD, "inputs": turned}), ["calibration/sensors.toml"]))
    assert table["device"]["acc1"]["channels"] == {"x": 5, "z": 1}
    assert table["device"]["acc3"]["channels"] == {"x": 4, "y": 0}
    assert table["firmware"]["calibration"] == ["calibration/sensors.toml"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"inputs": {**GOOD["inputs"], "1x": 1}}, "input 1 is both 1x and 1z"),
        ({"inputs": {"1x": 0}}, "1z has no input"),
        ({"uris": {**SIM, "daq0": "file:///etc/passwd"}}, "daq0"),
        ({"uris": {**SIM, "i2c0": 'sim://i2c0"\n[x]'}}, "i2c0"),
        ({"uris": {**SIM, "i2c0": "linux-i2c://1", "i2c1": "linux-i2c://1"}}, "a bus of their own|bus of their own"),
        ({"piezo": None}, "needs the address"),
        ({"monitor": 300}, "0x08 to 0x77"),
        ({"name": "../other"}, "not a name"),
        ({"output": "loudspeaker"}, "the output one of"),
        ({"daq": "nidaqmx", "daq_card": 'Dev1"\nx'}, "no name of an NI card"),
        ({"output": "e727", "uris": {**SIM, "e7270": ""}}, "e7270"),
    ],
)
def test_what_makes_no_sense_is_one_message(change: dict[str, Any], said: str):
    with pytest.raises(InputError, match=said):
        read_draft({**GOOD, **change})


def test_an_address_taken_twice_is_refused_as_doctor_does(tmp_path: Path):
    with pytest.raises(InputError, match="the bench file"):
        checked(bench_text(read_draft({**GOOD, "monitor": 0x48}), []), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_bench_is_described_and_written_from_the_page(still_page: Any, still: Still, tmp_path: Path):
    tab, still.session.home = still_page, tmp_path  # new benches go beside this copy
    copy_of_default_bench(tmp_path, "")
    go(tab, "setup")
    tab.wait_for_function("document.querySelector('[aria-label=\"Address of i2c1\"]').value === 'sim://i2c1'")
    tab.wait_for_function("document.querySelector('.chip b').textContent.endsWith('V')")
    volts = tab.locator(".chip").nth(0).inner_text().split()[-2]
    assert float(volts) == pytest.approx(0.6, abs=0.05), "live volts"
    tab.locator(".chip").nth(5).drag_to(tab.locator("[data-place='1x']"))
    assert tab.evaluate("[micron.setup.inputs['1x'], micron.setup.inputs['3y']]") == [5, 0]
    tab.select_option("[aria-label='Input of temperature']", "6")
    assert tab.evaluate("[micron.setup.inputs.temperature, micron.setup.inputs.supply]") == [6, 7]
    tab.uncheck("[aria-label='The bench has: converter of the monitor']")
    tab.uncheck("[aria-label='The bench has: telemetry on CAN']")
    tab.fill("[aria-label='Name of the bench']", "bench")  # the copy of the default bench has this name
    tab.click("text=Write the bench file")
    tab.wait_for_function("document.querySelector('.setup [role=alert]').textContent.includes('there already')")
    tab.fill("[aria-label='Name of the bench']", "new lab")
    tab.click("text=Write the bench file")
    tab.wait_for_function("document.querySelector('.setup pre').textContent.includes('no monitor')")
    path = still.session.home / "new lab.toml"
    description = load_bench(path).description
    assert description.device["acc1"].model_dump()["channels"] == {"x": 5, "z": 1}
    assert "monitor" not in description.device
    tab.select_option("[aria-label=Outputs]", "e727")
    assert tab.locator("[aria-label='Address of e7270']").is_visible()
    assert not tab.locator("[aria-label='Address of i2c0']").is_visible()
    assert not tab.locator("[aria-label='Address of can0']").is_visible(), "there is no telemetry on this bench"
    tab.click("text=Check")
    tab.wait_for_function("document.querySelector('.setup pre').textContent.includes('driver = \"e727\"')")
    assert not tab.locator("text=Try it: sensing only").is_disabled()
    tab.click("text=Try it: sensing only")
    tab.wait_for_function("micron.link.state.run === 2")
    assert still.session.choice.bench == path
    assert still.session.choice.sense_only


def test_a_part_that_is_left_out_while_a_scan_runs_stays_out(still_page: Any):
    tab = still_page
    asked: list[Any] = []
    tab.route("**/api/setup/scan", lambda route: asked.append(route))  # a builtin cannot be inspected

    def answer(number: int) -> None:
        while len(asked) <= number:
            tab.wait_for_timeout(20)
        asked[number].fulfill(json={"kind": "i2c", "addresses": [0x48], "frames": []})

    go(tab, "setup")
    tab.wait_for_function("document.querySelector('[aria-label=\"Address of i2c1\"]').value === 'sim://i2c1'")
    tab.uncheck("[aria-label='The bench has: telemetry on CAN']")
    tab.click("text=Scan I2C and CAN")
    tab.uncheck("[aria-label='The bench has: converter of the magnetometer']")
    answer(0)
    answer(1)
    tab.wait_for_selector("text=sim://i2c1: 0x48")
    assert not tab.is_checked("[aria-label='The bench has: converter of the magnetometer']"), "chosen by hand"
    assert not tab.is_checked("[aria-label='The bench has: converter of the monitor']"), "nobody answers there"


@pytest.mark.slow
def test_the_emulated_buses_are_scanned_and_parts_that_nobody_answers_for_are_left_out(still: Still):
    import json
    import urllib.request

    def ask(uri: str) -> dict[str, Any]:
        request = urllib.request.Request(
            f"{still.base}/api/setup/scan", json.dumps({"uri": uri}).encode(), {"X-Micron-Token": still.token}
        )
        with urllib.request.urlopen(request, timeout=200) as answer:
            return json.loads(answer.read())

    assert 0x0C in ask("sim://i2c0")["addresses"]
    assert {0x48, 0x49} <= set(ask("sim://i2c1")["addresses"])
    frames = {name: rate_hz for _, name, rate_hz in ask("sim://can0")["frames"]}
    assert frames, "the emulated node and button are heard"
    print(frames)
