"""Faults on purpose: what the option says, and that a real bench is only disturbed as far as somebody allowed."""

from __future__ import annotations

from pathlib import Path

import pytest
import typer

from firmware_py.app import run_in_process
from firmware_py.inject import check_injections, effect_of, late_starts, parse_injection
from firmware_py.run_request import RunRequest
from hal.bench import load_bench
from hal.errors import BenchError
from tests.command import micron
from tests.conftest import DEFAULT_BENCH


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    """The default bench with real buses, on ports that no machine has."""
    text = DEFAULT_BENCH.read_text()
    for bus, uri in (
        ("daq0", "serial:///dev/none"), ("i2c0", "linux-i2c:///dev/none"), ("i2c1", "linux-i2c:///dev/none1"),
        ("can0", "socketcan://none0"),
    ):  # fmt: skip
        text = text.replace(f"sim://{bus}", uri)
    for name in ("sensors", "piezo", "manipulator"):
        text = text.replace(f"calibration/{name}.toml", str(DEFAULT_BENCH.parent / "calibration" / f"{name}.toml"))
    path = tmp_path / "lab.toml"
    path.write_text(text)
    return path


def test_a_plan_is_read_as_it_is_written():
    found = parse_injection("i2c0@0x0C:nack=0.25,from_s=2,seed=7")
    assert (found.bus, found.only, found.plan.nack, found.plan.from_s, found.plan.seed) == ("i2c0", 12, 0.25, 2.0, 7)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("daq0", "not understood"),
        ("daq0:los=1", "'los=1' is not KEY=VALUE"),
        ("daq0:loss=2", "loss must be 0 to 1"),
        ("daq0:loss=nan", "loss must be 0 to 1"),
        ("daq0:delay_s=-1", "delay_s must be 0 or more"),
        ("daq0:loss=often", "'often' is not a number"),
        ("daq0:seed=inf", "seed must be a finite number"),
        ("daq0:delay_s=inf", "delay_s must be a finite number"),
        ("daq0:from_s=2,seed=3", "names no fault; add one of loss, "),
        ("i2c0@DAC:nack=1", "'DAC' is not an I2C address"),
    ],
)
def test_what_is_not_understood_is_named(text: str, says: str):
    with pytest.raises(BenchError, match=says):
        parse_injection(text)


def test_for_ever_is_a_time():
    assert parse_injection("daq0:loss=1,for_s=inf").plan.for_s == float("inf")


@pytest.mark.parametrize(
    ("texts", "says"),
    [
        (("i2c1@0x7F:nack=0.1",), "no device 0x7F on bus 'i2c1'; addresses are 0x48, 0x49"),
        (("daq0@0x0C:loss=0.1",), "no device 0x0C on bus 'daq0'; addresses are none, it is no I2C bus"),
        (("daq0:nack=0.1",), "nack does nothing on bus 'daq0', which is serial; it is for i2c"),
        (("i2c0:truncation=0.1",), "truncation does nothing on bus 'i2c0', which is i2c; it is for serial and can"),
        (("daq0:loss=0.1", "daq0:corruption=0.1"), "two plans for bus 'daq0'"),
    ],
)
def test_a_fault_that_would_do_nothing_is_refused(texts: tuple[str, ...], says: str):
    with pytest.raises(BenchError, match=says):
        check_injections(load_bench(DEFAULT_BENCH), [parse_injection(text) for text in texts], None)


def test_a_fault_that_begins_after_the_run_is_named() -> None:
    faults = [parse_injection(text) for text in ("daq0:loss=1,from_s=10", "can0:loss=1,from_s=12,bus_off_after_s=10.5")]
    assert [late.partition(" s counts")[0] for late in late_starts(faults, 10.0)] == [
        "--inject can0: from_s = 12",
        "--inject can0: bus_off_after_s = 10.5",
    ]
    assert not late_starts(faults, 12.0)


def test_a_run_says_before_it_begins_that_a_fault_comes_too_late(monkeypatch: pytest.MonkeyPatch) -> None:
    def ended(*_: object) -> None:
        raise typer.Exit(7)

    monkeypatch.setattr("tools.cli.run._run_emulated", ended)
    result = micron("run", "--virtual", "--seconds", "2", "--inject", "daq0:loss=1,from_s=3")
    assert result.exit_code == 7
    assert result.stderr.startswith("note: --inject daq0: from_s = 3 s counts from opening the bench")
    assert "more --seconds\n" in result.stderr


@pytest.mark.parametrize(
    ("text", "effect"),
    [
        ("daq0:loss=0.1", 1),
        ("can0:loss=0.1", 1),
        ("i2c0:nack=0.1", 4),
        ("i2c0@0x0C:nack=0.1", 4),
        ("i2c1@0x48:nack=1", 1),
        ("i2c1:nack=1", 1),
    ],
)
def test_what_may_move_outputs_has_the_effect_of_motion(text: str, effect: int):
    assert effect_of(load_bench(DEFAULT_BENCH).description, parse_injection(text)) == effect


def test_a_real_bus_needs_the_limit_an_emulated_one_does_not(lab: Path):
    on_dac, on_daq = [parse_injection("i2c0:nack=0.1")], [parse_injection("daq0:loss=0.1")]
    check_injections(load_bench(DEFAULT_BENCH), on_dac, None)
    real = load_bench(lab)
    with pytest.raises(BenchError, match=r"'i2c0' is real \(linux-i2c.* effect 4 .*--max-effect is 3"):
        check_injections(real, on_dac, 3)
    with pytest.raises(BenchError, match="no --max-effect was given"):
        check_injections(real, on_daq, None)
    check_injections(real, on_dac, 4)
    check_injections(real, on_daq, 1)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--inject", "daq0:loss=0.1"], "no --max-effect was given"),
        (["--inject", "i2c0:nack=0.1", "--max-effect", "1"], "give --max-effect 4"),
        (["--inject", "nowhere:loss=0.1", "--max-effect", "4"], "no bus 'nowhere'"),
        (["--max-effect", "4"], "belongs to --inject"),
    ],
)
def test_the_command_refuses_before_a_port_is_touched(lab: Path, arguments: list[str], says: str):
    result = micron("run", "--bench", lab, *arguments)
    assert result.exit_code == 2
    assert says in result.stderr
    assert result.stdout == ""


def test_the_firmware_itself_refuses_too(lab: Path):
    with pytest.raises(BenchError, match="is real"):
        run_in_process(RunRequest(lab, 1.0, inject=("daq0:loss=0.1",)))


def test_an_injected_fault_happens_is_counted_and_named():
    request = RunRequest(DEFAULT_BENCH, 0.5, pace="virtual", inject=("daq0:silent_after_s=1.0",))
    outcome, _ = run_in_process(request)
    assert outcome["injected"]["daq0"]["silenced"] > 0
    assert "daq: no new scan for 5 ms" in outcome["safe_state"]["reason"]
    assert outcome["safe_state"]["reached"]
