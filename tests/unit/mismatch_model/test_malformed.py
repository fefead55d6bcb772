"""Recordings that people get wrong: each ends with one clear line that names file and key or line, or is understood."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.recording_text import channel
from tests.unit.mismatch_model.test_loader import GOOD
from tools.errors import RecordingError
from tools.mismatch.engine.join import joined
from tools.mismatch.engine.pose import ranges_of
from tools.mismatch.recording_load import load
from tools.mismatch.twins.make import make

PLANT = (
    """
format = 1
data = "data.csv"
rate_hz = 1000.0
[twin]
kind = "{kind}"
[twin.parameters]
{parameters}
"""
    + channel("command_mV", "input", "{input}", "{unit}")
    + channel("z", "output", "position", "m")
)


def space(parameters: str) -> str:
    return PLANT.format(kind="state_space", parameters=parameters, input="u", unit="V")


def axis(parameters: str) -> str:
    return PLANT.format(kind="mechanical_axis", parameters=parameters, input="force", unit="N")


def equation(text: str) -> str:
    parameters = f'states = {{ z = "m" }}\nequations = {{ z = "{text}" }}\nlag = 0.1'
    return (
        PLANT.format(kind="ode", parameters="", input="u", unit="V")
        .replace("[twin.parameters]", parameters.replace("lag = 0.1", "[twin.parameters]\nlag = 0.1"), 1)
        .replace('signal = "position"', 'signal = "z"')
    )


def effect(lines: str) -> str:
    return GOOD.replace("[[channels]]", f"[[twin.effects]]\n{lines}\n[[channels]]", 1)


def write(folder: Path, text: str, data: str | bytes | None = None) -> Path:
    (folder / "recording.toml").write_text(text)
    k = np.arange(400)
    rows = np.column_stack([k * 1e-3, 100 * np.sin(k / 9) * k, 12.5 * np.cos(k / 9) * k, 298 + np.sin(k)])
    if data is None:
        lines = ["t_s,command_mV,z,temp", *(",".join(f"{v:.6g}" for v in row) for row in rows)]
        data = "\n".join(lines) + "\n"
    (folder / "data.csv").write_bytes(data if isinstance(data, bytes) else data.encode())
    return folder


def numbers(n: int, z: str = "{k}", command: str = "{k}") -> str:
    rows = (f"{command},{z},{{k}}".format(k=k % 7 + k) for k in range(n))
    return "\n".join(["command_mV,z,temp", *rows]) + "\n"


SPLIT = GOOD + "\n[split]\n"
_DECIMAL_COMMA = numbers(90, "{k}.5").replace(",", ";").replace("\n4;4.5", "\n4,5;4.5")
BAD: dict[str, tuple[str, str | bytes | None, str]] = {
    "empty descriptor": ("", None, r"format must be 1, and the file has none"),
    "empty data": (GOOD, b"", r"data\.csv: no column 'command_mV'; the file has: none"),
    "header alone": (GOOD, "command_mV,z,temp\n", r"data\.csv: no line of numbers below the header"),
    "empty lines alone": (GOOD, "command_mV,z,temp\n\n  \n", r"data\.csv: no line of numbers below the header"),
    "one sample": (GOOD, numbers(1), r"data\.csv: 1 samples; at least 50"),
    "UTF-16": (GOOD, "command_mV,z,temp\n1,2,3\n".encode("utf-16"), r"data\.csv: not a UTF-8 text file"),
    "a picture": (GOOD, bytes(range(256)) * 20, r"data\.csv: not a UTF-8 text file"),
    "infinite": (GOOD, numbers(90).replace("\n9,9,9\n", "\n9,inf,9\n"), r"column 'z' sample \d+ \(line \d+\): inf"),
    "decimal comma": (GOOD, _DECIMAL_COMMA, "line 4: .*'4,5' is not a number"),
    "absurd size": (GOOD, numbers(90, command="{k}e300"), "column 'command_mV' reaches .* the unit"),
    "rate as text": (GOOD.replace("1000.0", '"1 kHz"'), None, "rate_hz must be a finite number, got '1 kHz'"),
    "rate nan": (GOOD.replace("1000.0", "nan"), None, "rate_hz must be a finite number"),
    "rate true": (GOOD.replace("1000.0", "true"), None, "rate_hz must be a finite number, got True"),
    "channels as a table": (GOOD.split("[[channels]]")[0] + "[channels]\na = 1\n", None, r"must be a list"),
    "no data key": (GOOD.replace('data = "data.csv"', ""), None, "'data' must name the data file"),
    "data is a number": (GOOD.replace('"data.csv"', "3"), None, "'data' must name the data file"),
    "data is a folder": (GOOD.replace('"data.csv"', '"."'), None, "this is a folder; name the data file in it"),
    "parameter as text": (GOOD.replace("0.125", '"big"'), None, "gain_um_per_V must be a finite number, got 'big'"),
    "parameter nan": (GOOD.replace("0.125", "nan"), None, "gain_um_per_V must be a finite number, got nan"),
    "too many values": (GOOD.replace("0.125", "[1, 2]"), None, "gain_um_per_V has 2 entries"),
    "misspelt parameter": (GOOD.replace("gain_um", "gian_um"), None, "'gian_um_per_V' is not a parameter"),
    "two kinds": (GOOD.replace('"piezo_stack"', '["piezo_stack"]'), None, r"no \[twin\] with a 'kind'"),
    "noise true": (GOOD.replace("70.0", "true"), None, r"\[\[channels\]\] 2 \('z'\): noise_rms must be"),
    "unknown key": ('place = "lab"\n' + GOOD, None, r"key 'place' is unknown; leave it out\. Known keys: format, "),
    "misspelt key": ('time_colum = "t_s"\n' + GOOD, None, "key 'time_colum' is unknown; write 'time_column', or leave"),
    "misspelt key of a channel": (
        GOOD.replace("noise_rms", "noise_rsm"),
        None,
        r"\[\[channels\]\] 2: key 'noise_rsm' is unknown; write 'noise_rms'",
    ),
    "parameter in both tables": (
        GOOD.replace('"piezo_stack"', '"piezo_stack"\ngain_um_per_V = 2.0'),
        None,
        r"'gain_um_per_V' stands in \[twin\] and in \[twin.parameters\]; leave one of them out",
    ),
    "misspelt key of the split": (
        SPLIT + "tets = [300, 400]",
        None,
        r"\[split\] key 'tets' is unknown; write 'test', or leave it out\. Known keys: fit, test, init",
    ),
    "further test outside": (SPLIT + "test_more = [300, 4000]", None, r"\[split\] test_more: \[300, 4000\] must rise"),
    "misspelt key of an effect": (
        effect('name = "creep"\ntraget = "displacement"'),
        None,
        r"\[\[twin.effects\]\] 1: key 'traget' is unknown; write 'target'",
    ),
    "empty range": (SPLIT + "fit = [10, 10]", None, r"\[split\] fit: \[10, 10\] must rise"),
    "range reversed": (SPLIT + "fit = [300, 10]", None, r"\[split\] fit: \[300, 10\]"),
    "ranges in seconds": (SPLIT + "fit = [0.0, 0.5]", None, r"\[split\] fit must be"),
    "ranges overlap": (SPLIT + "fit = [0, 300]\ntest = [200, 400]", None, r"test \[200, 400\] share"),
    "range too short": (SPLIT + "fit = [0, 390]\ntest = [390, 394]", None, r"\[split\] test: 4 samples to go by"),
    "nothing to score": (SPLIT + "test = [300, 400]\ninitialization = 100", None, r"\[split\] test: 0 samples"),
    "initialization as text": (SPLIT + 'initialization = "4"', None, r"\[split\] initialization must be a number"),
    "other is gone": (SPLIT + 'test = "gone.toml"', None, r"gone\.toml: no such recording"),
    "other is itself": (SPLIT + 'test = "recording.toml"', None, "names this recording itself"),
    "other has another twin": (SPLIT + 'test = "other.toml"', None, r"names .*other\.toml, which has other inputs"),
    "A missing": (space("B = [[1.0]]"), None, r"\[twin.parameters\] A is missing"),
    "A not square": (space("A = [[1.0, 2.0]]\nB = [[1.0]]\nC = [[1.0]]"), None, "it must be square"),
    "A ragged": (space("A = [[1.0, 2.0], [3.0]]"), None, "rows of equal length"),
    "B of wrong shape": (space("A = [[-1.0]]\nB = [[1.0, 2.0]]\nC = [[1.0]]"), None, "expected 1 x 1"),
    "A with a hole": (space("A = [[-1.0, nan], [0.0, -2.0]]"), None, "A: row 1, column 2 is nan"),
    "x0 of wrong size": (space("A = [[-1.0]]\nB = [[1.0]]\nC = [[1.0]]\nx0 = [1.0, 2.0]"), None, "expected 1 x 1"),
    "unknown symbol": (equation("(u - kk * z) / lag"), None, "'kk' is no state, .*; known: t, z, u, lag, z_offset$"),
    "open bracket": (equation("(u - z / lag"), None, r"'\(u - z / lag' cannot be read \('\(' was never closed\)$"),
    "infinite at once": (equation("u / (lag - lag)"), None, "state 'z' is .* with your own parameters"),
    "unknown hold": (space('A = [[-1.0]]\nB = [[1.0]]\nC = [[1.0]]\nhold = "first"'), None, "hold must be"),
    "mass zero": (axis("mass = 0.0"), None, "mass must be positive"),
    "stiffness as text": (axis('mass = 1.0\nstiffness = "soft"'), None, "stiffness must be a finite"),
    "effect unknown": (effect('name = "flux"'), None, r"\[\[twin.effects\]\] 1: name 'flux' is not in"),
    "effect at no place": (effect('name = "creep"\nsite = "moon"\ntarget = "displacement"'), None, "site must be"),
    "effect without figures": (
        effect('name = "creep"\ntarget = "displacement"\nparameters = { c1 = 1.0 }'),
        None,
        "parameters rest, c2, c3 missing",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_one_clear_line(tmp_path: Path, case: str) -> None:
    text, data, words = BAD[case]
    folder = write(tmp_path, text, data)
    (folder / "other.toml").write_text(space("A = [[-5.0]]\nB = [[5.0]]\nC = [[1.0]]"))
    with pytest.raises(RecordingError, match=words) as caught:
        make(joined(load(folder))[0])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("split", "expected"),
    [
        ("fit = [0, 300]", ((0, 300), (300, 400))),
        ("test = [300, 400]", ((0, 300), (300, 400))),
        ("test = [0, 100]", ((100, 400), (0, 100))),
        ("test = [0, 400]", None),
        ('fit = "a.toml to z.toml"\ntest = [0, 400]', None),
    ],
)
def test_half_a_split_is_completed(tmp_path: Path, split: str, expected: object) -> None:
    assert ranges_of(joined(load(write(tmp_path, SPLIT + split)))[0]) == expected
