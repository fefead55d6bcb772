"""``docs/own-data.md``: from a csv to a diagnosis, then every key and every twin, from the tables that the loader uses.

``python -m tools.research.reports.own_data_page --out docs/own-data.md`` writes the page; a test compares.
"""

from __future__ import annotations

import argparse
import os
import re
import tempfile
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import get_args

from sim_devices.physics.catalogue import EFFECTS
from tools.guest.equations import FUNCTIONS, NUMPY_FUNCTIONS, Builder, EquationError
from tools.mismatch import key_tables as keys
from tools.mismatch import units
from tools.mismatch.engine.reduce import LONG
from tools.mismatch.engine.report import Verdict
from tools.mismatch.engine.unexplained import about
from tools.mismatch.infer.sealed import LEAST, SHARE
from tools.mismatch.keys import Key
from tools.mismatch.new import new_recording
from tools.mismatch.recording_columns import SUFFIXES
from tools.mismatch.recording_load import MIN_SAMPLES
from tools.mismatch.recording_units import SI
from tools.mismatch.report.vocabulary import entries
from tools.mismatch.text_table import SUFFIXES as TEXT
from tools.mismatch.twins.program import parse
from tools.mismatch.twins.vocabulary import CONTEXT_UNITS, KINDS

_GUIDE = """# Your own data

Made by `python -m tools.research.reports.own_data_page --out docs/own-data.md`; do not edit. The tests run the
first part.

A recording is a folder with your data file and a `recording.toml`, which describes its columns and names the simulation
that it is compared with. The example is a motor axis: force in, position out, `data.csv` with a header row.

``` { .python title="what stands for your measurement here" }
import numpy as np

t = np.arange(3000) / 200.0
force = 8 * np.sin(2 * np.pi * 0.7 * t) + 5 * np.sin(2 * np.pi * 0.23 * t + 1) + 3 * np.sin(2 * np.pi * 1.9 * t)
x = v = 0.0
rows = []
for k in range(t.size):
    rows.append((t[k], force[k], 1e3 * x))
    for _ in range(50):
        net = force[k] - 6.0 * v - 120.0 * x
        friction = 2.0 if abs(net) > 2.0 or abs(v) > 1e-4 else abs(net)
        before, v = v, v + (net - friction * np.sign(v if abs(v) > 1e-4 else net)) / 2.0 / 200 / 50
        v = 0.0 if before * v < 0 and abs(net) < 2.0 else v
        x += (before + v) / 2 / 200 / 50
table = np.array(rows)
table[:, 2] += np.random.default_rng(1).normal(0, 0.02, t.size)
np.savetxt("data.csv", table, delimiter=",", header="t_s,force_N,x_mm", comments="")
```

The five commands. Between the first and the second write what you know into `recording.toml` (section 1 has the lines
for this example). Without it the mass that the regression finds here is negative, and `apply` refuses it.

``` { .bash title="five commands" }
micron mismatch new data.csv
micron mismatch diagnose . --html report.html --json report.json
micron mismatch apply . report.json --out twin.toml
micron mismatch apply . report.json --out twin.py
micron mismatch simulate twin.py . --out simulated.csv
```

## 1. Say what the columns are

`micron mismatch new data.csv` guesses the time, roles, units and the twin from names and values, draws the columns in
`recording.png`, and writes `recording.toml`:

``` { .toml title="recording.toml" }
{written}```

The command reads text tables (any delimiter, decimal comma, header or none, a row of units),
{endings}.
What it could not know it writes into the file as a comment. A column `t`
without a unit is read as seconds; `--rate HZ` corrects it, or stands for a missing one. `t_ms`, `t_min`,
`t_h` and dates (`2026-03-10 18:00:00`, or the day and the time in two columns) are read as they say.

Where time steps are uneven or values are missing, the command names the line and writes nothing;
`--cut` resamples the columns to even steps at their usual rate (`--resample HZ`: another) and cuts them at gaps.
`recording.npz` then holds the runs one after another, `segments` in `recording.toml` names the samples at which the
later ones begin, as it does of runs that you stack, and one diagnosis covers all.

{samples}

{units}

Write the parameters that you believe before you ask what is missing:

``` { .toml title="in recording.toml" }
mass = 2.1
damping = 5.0
stiffness = 120.0
hold = "zero"
noise_rms = 0.02
```

`hold = "zero"` says that a computer held the force over each sample. Without it the verdict here is `unexplained`,
although friction is named. `noise_rms` is the rms of all noise of the readings, hum and slow noise included; the
residual tells its spectrum. A wrong one is the usual cause of a wrong verdict: leave it out if you do not know it.
Where inputs of a `mechanical_axis`, a `state_space` or an `ode` differ, give each its own:
`hold = { command = "zero", temperature = "linear" }`.

Your own equations are text, or a Python function. An output that has the name of a state is converted to the state's
unit; one with an equation of its own has the unit of its column (for a column in mm write millimetres). The engine
tries [what can be named](#what-can-be-named) at inputs and outputs, at every state, and between two bodies that a
spring joins:

``` { .toml title="a fan, in place of the [twin] above" }
[twin]
kind = "ode"

[twin.states]
speed = "rad/s"          # or { unit = "rad/s", start = 0.0 }, where the search for its start begins

[twin.equations]         # the derivative of each state, per second
speed = "(torque_per_A * current - bearing * speed) / inertia"

[twin.parameters]        # re-fitted, but for those in fixed
torque_per_A = 0.045
bearing = 8e-4
inertia = 1.8e-3
fixed = ["inertia"]      # the data show only ratios of the three, so one must be known
hold = "zero"
```

The keys of a kind stand in `[twin.parameters]` or, as `states` and `equations` here, in `[twin]`. A curve has no
states: give `outputs = { flow = "a * sqrt(pressure)" }` and `a` alone.

{equations}

``` { .python title='fan.py: function = "fan.py:derivatives" in [twin.parameters], in place of [twin.equations]' }
import numpy as np

def derivatives(t, states, inputs, parameters):
    drag = parameters["bearing"] * np.maximum(states["speed"], 0.0)
    return {"speed": (parameters["torque_per_A"] * inputs["current"] - drag) / parameters["inertia"]}
```

The function is called once, with symbols, and becomes equations. `math.sin`, Python's `max` and an `if` need numbers
and fail. The file runs after `micron trust .`; `simulate --trust` and `diagnose --trust` trust it, too. A program
that simulates by itself is [a twin of your own](adding/twin.md).

{si}
Units of other dimensions stay as recorded, and so do degC and % (12 % is 12); an `ode` leaves degC as it is, too. Its
poles, the numerators from each input
to each output and `y0` are re-fitted, because the data do not tell one choice of states from another.
Equations of an `ode` are read
in the units of the columns unless `units` says otherwise: after `units = { current = "A", bearing = "N m s" }` the fan
above may record its current in mA, and the report has a unit for `bearing`. If only the other reading fits, it is
taken, with a note. The equation of an encoder's output holds its counts:
`outputs = { angle = "shaft * 4096 / (2 * pi)" }`. Its `noise_rms`, if given, includes the rounding (0.29 counts). A
`mechanical_axis` with the input `torque` turns; with `force` it slides.

A `columns` twin is a column of simulated output. It is an input, and `simulated_` stands before the output's name;
`new` finds `sim_x_mm`, `x_model_mm` and `x_mm_simulated`. Only scale and offset are re-fitted: a wrong time constant
appears as an effect.

``` { .toml title="columns" }
[[channels]]
column = "x_mm"
role = "output"
signal = "position"
unit = "mm"

[[channels]]
column = "x_mm_simulated"
role = "input"
signal = "simulated_position"
unit = "mm"
```

`micron mismatch simulate .` runs the twin that the recording describes and prints what was read (samples, rate, units,
holds, notes) and the residual; `--picture FILE` draws it, `--data FILE` takes another run (the same columns). A wrong
unit or sign shows here, before the diagnosis. An input without `hold` runs straight here; `diagnose` infers its course.
The first command of a version compiles for a minute or more.

Name the commanded value as input where there is one. A measured input has noise. An effect that smooths this noise (a
lag, a resonance) then predicts better, although the machine has no such effect. State the input's `noise_rms`, and the
engine uses the input's expected course and counts the rest of its noise as noise of the output.

## 2. Diagnose, correct, run again

`micron mismatch diagnose` reports where recording and twin differ and which physics is missing. Its verdict is
{verdicts}
([how to read it](mismatch.md#reading-a-report)); the last says that something real is left which no effect explains.
`--held-out 0.3` hides that share of each of a few stretches from the fit, so a slow drift lies in fitted and hidden
samples alike. `apply` writes the corrected twin in the format of the file's ending:

{formats}

`micron mismatch simulate` runs a `.toml`, a `.py` or an `.fmu` again. In Python one call does, in the units of the data
file:

``` { .python title="run again" }
from tools.mismatch.export.run import simulate_file

position_mm = simulate_file("twin.toml", ".")["position"]
```

`twin.py` needs only numpy, and nothing of this package:

``` { .python title="elsewhere" }
import numpy as np
from twin import PARAMETERS, simulate

data = np.genfromtxt("data.csv", delimiter=",", names=True)
position_mm = simulate({"force": data["force_N"]})["position"]
heavier = simulate({"force": data["force_N"]}, parameters={"mass": 3.0})["position"]
```

Its parameter `start` is the state at the first sample of this recording; set it for another recording. An FMU takes its
inputs at the end of a communication step, so set the values at its end before each step.

## 3. Does it hold on the next recording?

In another recording, put `file = "twin.toml"` in place of everything in its `[twin]` table, and diagnose that
recording. If an effect is missing there, the first recording did not excite it.
"""


def page() -> str:
    """The text of the page."""
    from tools.mismatch.export.write import FORMATS

    formats = "\n".join(f"- `{ending}`: {what}" for ending, what in FORMATS.items())
    endings = ", ".join(f"`{s}`" for s in SUFFIXES if s not in TEXT)
    guide = _GUIDE.replace("{formats}", formats).replace("{endings}", endings).replace("{written}", written())
    known = f"Units are products and powers of these symbols, with SI prefixes: {units.listed()}; 1 is no unit."
    guide = guide.replace("{units}", _wrapped(f"{known} {_GRAM}")).replace("{samples}", _wrapped(_samples()))
    si = f"Matrices of a `state_space` are read in SI: {', '.join(SI)}."
    guide = guide.replace("{equations}", "\n".join(_equations())).replace("{si}", _wrapped(si))
    guide = guide.replace("{verdicts}", _one_of(f"`{v}`" for v in get_args(Verdict)))
    lines = [guide, "## Every key of `recording.toml`", ""]
    for heading, table in keys.tables():
        lines += [f"### {heading}", "", *_rows(table), ""]
    lines += ["## Every kind of twin", ""]
    for kind, words in KINDS.items():
        lines += [f"### `{kind}`", ""]
        for role, patterns in (("inputs", words.inputs), ("outputs", words.outputs)):
            listed = ", ".join(f"`{_signals(p)}` ({' or '.join(units) or 'any unit'})" for p, units in patterns)
            lines.append(f"- {role}: {listed or 'any names, any units'}")
        lines += ["", *_rows(keys.of_kind(kind)), ""]
    lines += [
        "Packages may add kinds ([a twin of your own](adding/twin.md)).",
        "",
        "## Context signals with a fixed unit",
        "",
        "An effect that needs a signal can be found only where that is recorded, as input or context.",
        "",
        "| signal | unit | effects that need it |",
        "|---|---|---|",
        *(f"| `{s}` | {' or '.join(u)} | {_needing(s)} |" for s, u in CONTEXT_UNITS.items()),
        "| any other name | any | none, but each parameter of an `ode` may be found to follow it |",
        "",
        "## What can be named",
        "",
        "`micron mismatch physics` prints formulas, parameters, sources and what shows each.",
        "",
        "| name | physics | acts | only in | needs a recorded |",
        "|---|---|---|---|---|",
        *(
            f"| `{e.name}` | {_cell(e.summary)} | {_cell(e.acts)} | {_code(e.twins)} | {' or '.join(e.needs)} |"
            for e in entries()
        ),
        "",
    ]
    return "\n".join(lines)


_GRAM = "`g` is gravity, except in g/l, g/m^3 and g/mol; a mass is in kg or gram."


def _samples() -> str:
    """Return how long a recording should be, with the limits that the loader and the engine have."""
    return (
        f"{MIN_SAMPLES} samples are needed, and some thousands are sensible. From {round(LEAST / SHARE)} on the last"
        f" tenth is scored once; above {LONG} the search begins on reduced copies. Record the temperature as a"
        " context channel, else no effect of it is found."
    )


def _equations() -> Iterator[str]:
    """Yield the table of what equations may hold, asked of the parser itself."""
    yield "| | in text | in a Python function |"
    yield "|---|---|---|"
    yield f"| functions | {_code(FUNCTIONS)} | {_code(f'np.{n}' for n in NUMPY_FUNCTIONS)} |"
    able = [text for text in _FORMS if is_allowed(text)]
    yield f"| operators | {_code(able)} | the same, but for `if` |"
    refused = _code(text for text in _FORMS if text not in able)
    yield f"| not allowed | {refused} | `math`, `scipy`, `if`, `max`, `min` |"
    yield "| names | states, inputs, context, parameters, other equations, `t` (s), `pi` | by its four arguments |"


_FORMS = (
    *("a + b", "a - b", "a * b", "a / b", "a ** b", "-a", "a < b", "a <= b", "a > b", "a >= b", "a if b else c"),
    *("a ^ b", "a // b", "a % b", "a == b", "a != b", "a < b < c", "a and b", "a or b", "not a", "a[0]", "e"),
)
"""Forms of Python that a person may try in an equation."""


def is_allowed(text: str) -> bool:
    """Return True if the parser of equations reads ``text`` in the variables a, b and c."""
    try:
        parse(Builder(("a", "b", "c")), {"x": text}, ["x"])
    except EquationError:
        return False
    return True


def _code(texts: Iterable[str]) -> str:
    return ", ".join(f"`{text}`" for text in texts)


def _one_of(words: Iterable[str]) -> str:
    *most, last = words
    return f"{', '.join(most)} or {last}"


def _needing(signal: str) -> str:
    """Return the effects that need a recorded signal."""
    return _code(name for name, effect in EFFECTS.items() if signal in about(effect)) or "none"


def _wrapped(text: str) -> str:
    return "\n".join(textwrap.wrap(text, 120, break_long_words=False, break_on_hyphens=False))


def written() -> str:
    """Return the output of ``micron mismatch new`` for the data of the page."""
    source = re.findall(r"^``` \{ \.python[^\n]*\n(.*?)^```", _GUIDE, flags=re.S | re.M)[0]
    with tempfile.TemporaryDirectory() as name:
        before = Path.cwd()
        os.chdir(name)
        try:
            exec(source, {})
        finally:
            os.chdir(before)
        new_recording(Path(name) / "data.csv")
        return (Path(name) / "recording.toml").read_text(encoding="utf-8")


def _rows(table: Sequence[Key]) -> Iterator[str]:
    if not table:
        yield "No keys are listed for this kind."
        return
    yield "| key | value | meaning | if left out |"
    yield "|---|---|---|---|"
    for k in table:
        yield f"| `{k.name}` | {_cell(k.value)} | {_cell(k.help)} | {_cell(k.default) or '**needed**'} |"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _signals(pattern: str) -> str:
    """A pattern of signal names as a person would write it."""
    return pattern.replace(r"\w*", "PLACE")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE")
    parser.parse_args().out.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
