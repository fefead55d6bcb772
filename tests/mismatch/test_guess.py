"""What a data file's columns are, guessed from names, units and values."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from tools.errors import RecordingError
from tools.mismatch.column_course import course_of
from tools.mismatch.guess import POINTS, guess, main
from tools.mismatch.guess_roles import guess_role, split_unit
from tools.mismatch.new import new_recording
from tools.mismatch.recording_load import load
from tools.mismatch.text_table import text_table


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("force_N", ("force", "N")), ("x [mm]", ("x", "mm")), ("speed (m/s)", ("speed", "m/s")), ("t_s", ("t", "s")),
        ("gyro_deg/s", ("gyro", "deg/s")), ("accel_1", ("accel_1", "")), ("plain", ("plain", "")),
        ("sensor_left", ("sensor_left", "")), ("T/degC", ("T", "degC")),
        ("speed_rad_s", ("speed", "rad/s")), ("a_m_s2", ("a", "m/s2")), ("sun_W_m2", ("sun", "W/m2")),
        ("wheel_l", ("wheel_l", "")), ("tank_ml", ("tank", "ml")), ("speed_in_s", ("speed", "in/s")),
        ("dilution_1_h", ("dilution", "1/h")), ("feed_g_l", ("feed", "g/l")), ("flow_l_min", ("flow", "l/min")),
        ("charge_A_h", ("charge", "Ah")), ("x_V_min", ("x_V_min", "")), ("pump_1_s", ("pump_1", "s")),
        ("clock_in_s", ("clock_in", "s")), ("heater_pct", ("heater", "%")), ("force_klbf", ("force", "klbf")),
        ("CO(GT)", ("CO(GT)", "")), ("field_mT", ("field", "mT")), ("p_hPa", ("p", "hPa")),
        ("speed_rps", ("speed", "rps")),
        ("force_N_l", ("force_N_l", "")), ("pump_1_l", ("pump_1_l", "")), ("flow_m3_h", ("flow", "m3/h")),
    ],
)  # fmt: skip
def test_units_are_read_from_names(name: str, parts: tuple[str, str]):
    assert split_unit(name) == parts


@pytest.mark.parametrize(
    ("name", "unit", "role"),
    [
        ("command", "V", "input"), ("displacement", "um", "output"), ("temperature", "degC", "context"),
        ("a", "N", "input"), ("b", "mm", "output"), ("q", "", ""),
    ],
)  # fmt: skip
def test_roles_come_from_names_then_units(name: str, unit: str, role: str):
    assert guess_role(name, unit) == role


def table(folder: Path, header: str, *columns: np.ndarray) -> Path:
    path = folder / "data.csv"
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=header, comments="")
    return path


def test_a_motor_axis(tmp_path: Path):
    t = np.arange(1000) / 200.0
    found = guess(table(tmp_path, "t_s,force_N,x_mm,temp_degC", t, np.sin(t), np.cos(t), 20 + t))
    assert found.time_column == "t_s"
    assert found.rate_hz == pytest.approx(200.0)
    assert found.kind == "mechanical_axis"
    assert [(c.role, c.signal, c.unit) for c in found.columns] == [
        ("time", "t", "s"), ("input", "force", "N"), ("output", "position", "mm"), ("context", "temperature", "degC"),
    ]  # fmt: skip
    x = found.columns[2]
    assert len(x.low) == POINTS
    assert min(x.low) == pytest.approx(np.cos(t).min())
    assert max(x.high) == pytest.approx(1.0)


def test_a_heated_block(tmp_path: Path):
    """The last of the temperatures answers; one that a name calls ambient stays context."""
    t = np.arange(300.0)
    found = guess(table(tmp_path, "t_s,heater_W,block_degC,ambient_degC", t, np.sin(t), 30 + np.cos(t), 20 + 0.1 * t))
    assert [c.role for c in found.columns] == ["time", "input", "output", "context"]
    assert "outputs are 'block_degC'" in found.assumed


def test_a_temperature_answers_where_nothing_else_could(tmp_path: Path):
    t = np.arange(300.0)
    header = "time (s),heater power (W),ambient (degC),block temperature (degC)"
    found = guess(table(tmp_path, header, t, np.sin(t), 20 + 0.1 * t, 30 + np.cos(t)))
    assert [c.role for c in found.columns] == ["time", "input", "context", "output"]
    assert "outputs are 'block temperature (degC)'" in found.assumed


N = 3000
K = np.arange(N)
RNG = np.random.default_rng(0)
NOISE = RNG.normal(size=(3, N))
DUTY = np.repeat(RNG.permutation(np.tile([0.2, 0.4, 0.5, 0.8], 5)), 150)


def lag(u: np.ndarray, keep: float) -> np.ndarray:
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], u), np.float64)


def roles_of(folder: Path, header: str, *columns: np.ndarray) -> tuple[dict[str, str], list[str]]:
    path = folder / "data.csv"
    np.savetxt(path, np.column_stack([0.01 * K, *columns]), delimiter=",", header=header, comments="", fmt="%.6g")
    found = guess(path)
    return {c.name: c.role for c in found.columns[1:]}, found.assumed


def test_a_staircase_drives_and_noisy_columns_answer_whatever_their_units(tmp_path: Path):
    current, voltage = 3 * lag(DUTY, 0.9) + 0.02 * NOISE[0], 12 * lag(DUTY, 0.97) + 0.03 * NOISE[1]
    roles, assumed = roles_of(tmp_path, "t_s,duty,iL_A,vout_V,sink_degC", DUTY, current, voltage, 20 + 1e-3 * K)
    assert roles == {"duty": "input", "iL_A": "output", "vout_V": "output", "sink_degC": "context"}
    assert assumed[:3] == ["inputs are 'duty'", "outputs are 'iL_A', 'vout_V'", "context is 'sink_degC'"]


@pytest.mark.parametrize("laser", [np.minimum(K // 500, 5), DUTY])
@pytest.mark.parametrize("angle", [np.abs(0.36 * K % 720 - 360), (0.377 * K) % 360, 90 * np.sin(0.01 * K)])
def test_a_staircase_and_a_sweep_drive_a_noisy_detector(tmp_path: Path, laser: np.ndarray, angle: np.ndarray):
    detected = laser * np.cos(np.radians(angle)) ** 2 + 0.01 * NOISE[0]
    roles, assumed = roles_of(tmp_path, "t_s,laser_mW,analyser_deg,detector_V", laser, angle, detected)
    assert roles == {"laser_mW": "input", "analyser_deg": "input", "detector_V": "output"}
    assert "inputs are 'laser_mW', 'analyser_deg'" in assumed
    assert "outputs are 'detector_V'" in assumed


def test_every_staircase_drives(tmp_path: Path):
    feed = np.repeat(np.tile([5.0, 20.0, 10.0], 4), 250)
    substrate, cells = 3 * lag(feed, 0.99) + 0.05 * NOISE[0], lag(DUTY, 0.99) + 0.01 * NOISE[1]
    roles, _ = roles_of(tmp_path, "time_h,dosing_l/min,feed_g/l,substrate_g/l,cells_g/l", DUTY, feed, substrate, cells)
    assert list(roles.values()) == ["input", "input", "output", "output"]


def test_without_names_and_units_a_noisy_column_answers(tmp_path: Path):
    roles, _ = roles_of(tmp_path, "t_s,a,b", lag(DUTY, 0.9) + 0.02 * NOISE[0], np.sin(0.01 * K))
    assert roles == {"a": "output", "b": "input"}


def test_an_encoder_that_is_smoother_than_the_current_still_answers(tmp_path: Path):
    current = np.sin(0.01 * K)
    roles, _ = roles_of(tmp_path, "t_s,iq_A,shaft_deg", current + 0.05 * NOISE[0], np.round(np.cumsum(current), 2))
    assert roles == {"iq_A": "input", "shaft_deg": "output"}


@pytest.mark.parametrize(
    ("values", "course"),
    [
        (DUTY, "held"), (1.0 * (K > 500), "held"), (np.repeat(np.arange(6.0), 500), "held"),
        (np.sin(0.01 * K), "smooth"), (np.round(np.sin(0.01 * K), 3), "smooth"), (0.36 * K % 360, "smooth"),
        (np.sin(0.01 * K).astype(np.float32), "smooth"), (np.round(50 * np.sin(0.002 * K)) * 0.044, "smooth"),
        (np.sin(0.01 * K) + 0.01 * NOISE[0], "noisy"), (0.36 * K + 0.05 * NOISE[0], "noisy"), (NOISE[0], "noisy"),
        (np.round(3 * np.sin(0.002 * K) + 0.2 * NOISE[0]), ""),
        (RNG.integers(0, 2, N) * 5.0, ""),
        (np.zeros(N), ""), (np.full(N, np.nan), ""), (np.arange(5.0), ""),
    ],
)  # fmt: skip
def test_the_course_of_a_column_is_told_by_its_values_in_any_unit(values: np.ndarray, course: str):
    """A reading that rounding hides, and a switch, are neither."""
    for scale in (1.0, 1e-9, 4.9e6):
        assert course_of(np.asarray(scale * values, np.float64)) == course


def test_columns_that_neither_drive_nor_answer_are_named_with_what_to_do(tmp_path: Path):
    t = np.arange(300.0)
    with pytest.raises(RecordingError, match=r"room \(degC\), supply \(V\); begin the name of one with 'input'"):
        guess(table(tmp_path, "time (s),room (degC),supply (V)", t, np.sin(t), np.cos(t)))


@pytest.mark.parametrize("simulated", ["sim_angle_deg", "angle_deg_simulated", "simulated_angle [rad]"])
def test_a_simulated_column_is_the_course_of_its_output(tmp_path: Path, simulated: str):
    """``micron mismatch simulate --out`` writes the second of these names."""
    t = np.arange(300) / 100.0
    data = table(tmp_path, f"t_s,torque_mNm,angle_deg,{simulated}", t, np.sin(t), np.cos(t), 0.9 * np.cos(t))
    made = new_recording(data, kind="columns")
    assert [(c.role, c.signal) for c in made.guess.columns[1:]] == [
        ("input", "torque"), ("output", "angle"), ("input", "simulated_angle"),
    ]  # fmt: skip
    assert made.guess.columns[3].unit == ("rad" if "[rad]" in simulated else "deg")
    assert not made.guess.unknown
    assert load(made.path).twin.kind == "columns"


@pytest.mark.parametrize(
    ("recorded", "simulated", "unit"),
    [
        ("vout_V", "vout_sim_V", "V"), ("out_V", "out_V_simulated", "V"), ("x_mm", "sim_x_mm", "mm"),
        ("x_mm", "x_um_model", "um"), ("Speed (rpm)", "Speed model (rad/s)", "rad/s"), ("x [mm]", "x (sim) [mm]", "mm"),
        ("y", "model_y", ""), ("plant.x_mm", "plant.sim.x_mm", "mm"),
    ],
)  # fmt: skip
def test_a_pair_of_a_recorded_and_a_simulated_column_is_found_without_a_word(
    tmp_path: Path, recorded: str, simulated: str, unit: str
):
    data = table(tmp_path, f"t_s,duty,{recorded},{simulated},coil_A", 0.01 * K, DUTY, NOISE[0], NOISE[1], NOISE[2])
    found = guess(data)
    assert found.kind == "columns"
    assert not found.unknown
    assert [c.role for c in found.columns] == ["time", "input", "output", "input", "context"]
    assert (found.columns[3].signal, found.columns[3].unit) == (f"simulated_{found.columns[2].signal}", unit)
    assert (
        f"the kind of twin is columns, because '{simulated}' is the simulated course of '{recorded}';"
        " for another repeat with --twin KIND"
    ) in found.assumed
    assert "column 'coil_A' is context: no column is its simulated course" in found.notes
    assert load(new_recording(data).path).twin.kind == "columns"


@pytest.mark.parametrize("other", ["model_mm", "sim_x_V", "y_sim_mm", "simple_x_mm"])
def test_a_name_with_another_stem_or_dimension_is_no_pair(tmp_path: Path, other: str):
    found = guess(table(tmp_path, f"t_s,force_N,x_mm,{other}", 0.01 * K, DUTY, NOISE[0], NOISE[1]))
    assert found.kind != "columns"


def test_an_output_without_a_simulated_course_is_asked_for(tmp_path: Path):
    t = np.arange(300) / 100.0
    data = table(tmp_path, "t_s,pump_V,level [mm],sim_height [mm]", t, np.sin(t), np.cos(t), np.cos(t))
    (text,) = new_recording(data, kind="columns").guess.unknown
    assert 'output \'level\': its column needs role = "input" and signal = "simulated_level"' in text


def test_a_twin_that_nothing_tells_is_asked_for_with_the_two_of_ones_own(tmp_path: Path):
    t = np.arange(300.0)
    found = guess(table(tmp_path, "t_s,pump [l/min],level [mm]", t, np.sin(t), np.cos(t)))
    assert "--twin ode (your equations as text, or a curve without states), --twin columns" in found.unknown[0]


def test_a_twin_that_units_alone_suggest_is_an_assumption(tmp_path: Path):
    t = np.arange(300.0)
    found = guess(table(tmp_path, "t_s,valve_V,stroke_mm", t, np.sin(t), np.cos(t)))
    assert found.kind == "piezo_stack"
    assert any("the kind of twin is piezo_stack, by its units alone" in text for text in found.assumed)


def test_a_supply_beside_an_accelerometer_is_context_and_its_axes_answer(tmp_path: Path):
    t = np.arange(200) / 100.0
    axes = [9.8 * np.sin(t), np.cos(t), np.sin(3 * t), 2.5 + 0.1 * np.sin(t), np.cos(t), np.sin(3 * t)]
    found = guess(
        table(tmp_path, "t_s,g_x_mps2,g_y_mps2,g_z_mps2,u_x_V,u_y_V,u_z_V,rail_V", t, *axes, 5.0 + 0.01 * np.sin(9 * t))
    )
    roles = {c.name: (c.role, c.signal) for c in found.columns}
    assert found.kind == "accelerometer"
    assert [roles[f"g_{a}_mps2"] for a in "xyz"] == [("input", f"specific_force_{a}") for a in "xyz"]
    assert [roles[f"u_{a}_V"] for a in "xyz"] == [("output", f"voltage_{a}") for a in "xyz"]
    assert roles["rail_V"][0] == "context"


@pytest.mark.parametrize("kind", ["ode", "state_space"])
def test_the_file_of_an_open_twin_has_its_tables(tmp_path: Path, kind: str):
    """With the examples of the file made valid, the recording loads."""
    t = np.arange(300) / 100.0
    data = table(tmp_path, "t_s,current_A,speed_rad_s", t, np.sin(t), np.cos(3 * t))
    made = new_recording(data, kind=kind)
    text = made.path.read_text()
    assert made.guess.unknown
    if kind == "ode":
        assert "in [twin.parameters]" in made.guess.unknown[0]
        text = text.replace("# speed =", "speed =").replace("# fixed =", "gain = 2.0\ntime_constant = 0.3\n# fixed =")
        made.path.write_text(text)
        assert load(made.path).unit == {"current": "A", "speed": "rad/s"}
    else:
        assert "# A = # needed" in text


def test_npz_and_names_without_units(tmp_path: Path):
    np.savez(tmp_path / "data.npz", u=np.arange(50.0), y=np.arange(50.0), words=np.array(["a"]))
    found = guess(tmp_path / "data.npz")
    assert [(c.name, c.role) for c in found.columns] == [("u", "input"), ("y", "output")]
    assert (found.kind, found.time_column, found.rate_hz) == ("", "", None)


@pytest.mark.parametrize(
    ("name", "content"), [("a.csv", b""), ("a.npz", b"PK\x03\x04"), ("a.csv", b"\xff\xfe\x00"), ("a.txt", b"1,2")]
)
def test_what_cannot_be_read_is_one_message(tmp_path: Path, name: str, content: bytes):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(RecordingError, match=name):
        guess(tmp_path / name)
    assert main([str(tmp_path / name)]) == 2


def test_the_command_prints_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    t = np.arange(100) / 10.0
    assert main([str(table(tmp_path, "t_s,command_V,z_um", t, t, t))]) == 0
    assert json.loads(capsys.readouterr().out)["kind"] == "piezo_stack"


def test_a_logger_file_with_dates_and_two_equal_names(tmp_path: Path):
    """TOA5: four rows above the samples; the names stand in the second, the units in the third."""
    head = '"TOA5","CR1000","rig"\n"TIMESTAMP","RECORD","block_degC","heater","batt","batt"\n"TS","RN","","W","V","V"\n'
    head += '"","","Avg","Smp","Min","Max"\n'
    rows = [
        f'"2026-01-01 {k // 60:02d}:{k % 60:02d}:00",{k},{20 + np.sin(k / 9):.3f},{(k // 20) % 2 * 5},12.3,12.4\n'
        for k in range(200)
    ]
    (tmp_path / "toa5.csv").write_text(head + "".join(rows))
    found = guess(tmp_path / "toa5.csv")
    assert found.rate_hz == pytest.approx(1 / 60)
    assert {c.name: c.role for c in found.columns} == {
        "TIMESTAMP": "time", "RECORD": "", "block_degC": "output", "heater": "input",
    }  # fmt: skip
    assert "column 'batt' is not used: more than one has this name" in found.notes


def test_a_date_in_another_form_is_told_the_one_that_is_read(tmp_path: Path):
    rows = "".join(f"10/03/2004;{k};{np.sin(k)};{np.cos(k)}\n" for k in range(80))
    (tmp_path / "a.csv").write_text(f"Date;t_s;u_V;y_mm\n{rows}")
    (note,) = (n for n in guess(tmp_path / "a.csv").notes if "Date" in n)
    assert note.endswith("a date is read as 2026-03-10 18:00:00")


@pytest.mark.parametrize(
    ("head", "cells"),
    [
        ("day,time", "2026-03-10,18:{:02}:00"),
        ("when", "2026-03-10 18:{:02}:00"),
        ("when", "2026-03-10T18:{:02}:00.0+01:00"),
        ("day,clock", "2026-03-10,18:{:02}+0100"),
    ],
)
def test_dates_of_loggers_are_the_time(tmp_path: Path, head: str, cells: str):
    rows = "".join(f"{cells.format(k)},{np.sin(k)},{np.cos(k)}\n" for k in range(60))
    (tmp_path / "a.csv").write_text(f"{head},u_V,y_mm\n{rows}")
    found = guess(tmp_path / "a.csv")
    assert found.time_column == head.split(",")[0]
    assert found.rate_hz == pytest.approx(1 / 60)
    begin = datetime(2026, 3, 10, 18, tzinfo=UTC).timestamp() - (3600.0 if "+01" in cells else 0.0)
    assert text_table(tmp_path / "a.csv").read([found.time_column])[found.time_column][0] == begin
    assert sum("time of day" in n for n in found.notes) == head.count(",")


@pytest.mark.parametrize("broken", ["2026-03-10,18:1", "2026-03-10,", "2026-13-10,18:10:00"])
def test_a_day_without_its_time_is_no_midnight(tmp_path: Path, broken: str):
    rows = [f"2026-03-10,18:{k:02}:00,{np.sin(k)},{np.cos(k)}" for k in range(60)]
    rows[10] = f"{broken},0.1,0.2"
    (tmp_path / "a.csv").write_text("\n".join(["day,time,u_V,y_mm", *rows]))
    with pytest.raises(RecordingError, match=r"line 12: column 'day': .* is no date like 2026-03-10 18:00:00"):
        text_table(tmp_path / "a.csv").read(["day"])


@pytest.mark.parametrize(("mark", "told"), [(-200.0, True), (-1.0, False), (3.0, False)])
def test_a_number_that_marks_missing_values_is_told(tmp_path: Path, mark: float, told: bool):
    t = np.arange(400) / 10.0
    y = np.where(np.arange(400) % 50 < 3, mark, 20 + np.sin(t))
    found = guess(table(tmp_path, "t_s,u_V,y_mm", t, np.sin(t), y))
    assert any("column 'y_mm' is -200 in 24 samples" in n for n in found.notes) == told


def test_what_is_in_degrees_is_the_temperature_beside_other_outputs(tmp_path: Path):
    t = np.arange(400) / 10.0
    columns = (t, np.sin(t), np.cos(t), 20 + t, 21 + t)
    found = guess(table(tmp_path, "t_s,u_V,y_mm,air_degC,room_degC", *columns))
    assert [c.signal for c in found.columns if c.role == "context"] == ["temperature", "room"]
