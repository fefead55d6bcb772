"""Describes every key of ``recording.toml`` and of each twin's parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True)
class Key:
    """Describes a key: ``value`` is its type or range, ``default`` its value if it is missing ("" if required)."""

    name: str
    value: str
    help: str
    default: str = ""


TOP = (
    Key("format", "1", "version of this format"),
    Key("title", "text", "heading of the report", "the file's name"),
    Key("data", "file name", "the data: csv, tsv, txt, npz, mat, mcap, parquet, netCDF (.nc) or ASAM MDF (.mf4)"),
    Key("rate_hz", "number > 0", "uniform sampling rate", "from time_column"),
    Key(
        "time_column",
        "column name",
        "time stamps, in s unless name or file state a unit (t_ms); for recordings without rate_hz",
        "none",
    ),
    Key("twin", "table", "the simulation that the recording is compared with"),
    Key("channels", "list of tables", "one per column that is used"),
    Key(
        "segments",
        "list of samples",
        "samples where the second and later runs begin, and states start afresh: [1000] makes runs of samples 0 to 999"
        " and 1000 to the end; 0 is not in the list",
        "one run",
    ),
    Key(
        "conditions",
        "table",
        "what it was made under: numbers, texts, dates; compared by 'diagnose --together'",
        "none",
    ),
    Key("split", "table", "which samples may be fitted and which are the test", "the tool splits by itself"),
)
CHANNEL = (
    Key("column", "text", "name in the data file"),
    Key("role", "input, output, context", "drives the twin, is compared with it, or was recorded beside"),
    Key("signal", "text", "the twin's own name for it (below)"),
    Key("unit", "text", "SI or another of its dimension (mV, um, deg/s, G, mg, ...)", "the file's, else the twin's"),
    Key(
        "noise_rms",
        "number > 0",
        "rms noise of the instrument that measured an output or input, in unit",
        "of an output: estimated; of an input: none",
    ),
    Key("resolution", "number > 0", "of an output: smallest step of the readings, in unit", "found in the data"),
    Key("tolerance", "number > 0", "of an output: smaller differences do not matter to you, in unit", "none"),
)
SPLIT = (
    Key("fit", "[start, stop] or file name", "samples (stop excluded) or the recording that may be fitted", "the rest"),
    Key("test", "[start, stop] or file name", "samples or the recording that no fit may see", "the rest"),
    Key("test_NAME", "as test", "further tests of a benchmark; they are checked and not used", "none"),
    Key("initialization", "number of samples", "at the start of a test: may set the state, are not scored", "0"),
)
TWIN = (
    Key("kind", "text", "one of the kinds below"),
    Key("parameters", "table", "what you believe of the twin; below, per kind", "estimated where possible"),
    Key("effects", "list of tables", "effects of a corrected twin; written by 'micron mismatch apply'", "none"),
    Key(
        "file",
        "file name",
        "a file with a [twin] table, instead of all the keys above; relative to the recording",
        "none",
    ),
)
HOLD = Key(
    "hold",
    "linear, zero, smooth",
    "between samples the input runs straight, is held, or has nothing above half the rate; or a table by input",
    "inferred, else linear",
)
HOLD_OF_EACH = Key(
    "hold", "linear, zero", "between samples the inputs run straight or are held; or a table by input", HOLD.default
)
HOLD_OR_STRAIGHT = Key("hold", "linear, zero", "between samples the inputs run straight or are held", HOLD.default)
_PER_OUTPUT = "number, list or table by output"
_AXES = "number, list or table by output (x, y, z)"

PARAMETERS: Mapping[str, tuple[Key, ...]] = MappingProxyType(
    {
        "piezo_stack": (
            Key("gain_um_per_V", _PER_OUTPUT, "displacement per volt", "least squares"),
            Key("offset_um", _PER_OUTPUT, "displacement at 0 V", "least squares"),
            HOLD_OR_STRAIGHT,
        ),
        "accelerometer": (
            Key("bias_V", _AXES, "output at 0 g", "least squares"),
            Key("scale_V_per_g", _AXES, "volts per g", "least squares"),
            HOLD_OR_STRAIGHT,
        ),
        "magnetometer": (
            Key("bias_V", _AXES, "output in no field", "least squares"),
            Key("scale_V_per_uT", _AXES, "volts per microtesla", "least squares"),
            HOLD_OR_STRAIGHT,
        ),
        "accelerometer_cluster": (
            Key("positions_m", 'table { "1" = [x, y, z] }', "place of each sensor from the body origin", "the origin"),
            Key("bias", "table by output", "m/s^2; written by apply", "0"),
            Key("scale", "table by output", "written by apply", "1"),
        ),
        "mechanical_axis": (
            Key("mass", "number > 0", "kg, or kg m^2 of a rotation", "regression"),
            Key("damping", "number", "N s/m, or N m s/rad", "regression"),
            Key("stiffness", "number", "N/m, or N m/rad; an axis without the key has no spring", "0"),
            Key("offset_force", "number", "added to the force", "0"),
            HOLD,
        ),
        "state_space": (
            Key("A", "rows of numbers", "x' = A x + B u, or x[k+1] where discrete"),
            Key("B", "rows of numbers", "one column per input, in the order of the channels"),
            Key("C", "rows of numbers", "one row per output, in the order of the channels"),
            Key("D", "rows of numbers", "y = C x + D u + y0", "0"),
            Key("x0", "list of numbers", "state at the first sample, taken as given", "set by the first samples"),
            Key("first", "table of A, B, C, D", "a filter in front, one input and output; written by apply", "none"),
            Key(
                "y0",
                "list of numbers",
                "offset of each output, re-fitted: the ambient temperature, if the states are differences from it",
                "0",
            ),
            HOLD,
            Key("discrete", "true, false", "A and B are those of the difference equation", "false"),
            Key(
                "states",
                "table by state",
                'name = "unit" of each state, in the order of the rows of A: forces are then tried inside',
                "none",
            ),
        ),
        "columns": (
            Key(
                "offset",
                _PER_OUTPUT,
                "added to the column of simulated output, the input simulated_NAME of output NAME",
                "0",
            ),
            Key("scale", _PER_OUTPUT, "times the column", "1"),
        ),
        "instrument": (
            Key("bench", "file name", "bench description of the emulated instrument, relative to the recording"),
            Key("hand", "rest, bench", "where no motion was recorded: at rest, or moved by the bench's hand", "rest"),
            Key("start_s", "0 to 3600", "how long that world had run at the first sample", "0"),
        ),
        "ode": (
            Key(
                "states",
                "table by state",
                "a unit, or a table: unit (an output of that name is converted to it), start, min, max; start (0 if"
                " left out) is a first guess at which the equations are finite: the first samples override it, also"
                " where you give it, as far as the outputs show the state",
                "none: outputs are a curve of the inputs",
            ),
            Key(
                "equations",
                "table of texts",
                "the derivative of each state in terms of states, inputs and parameters",
                "none, if there is no state",
            ),
            Key("outputs", "table of texts", "each output in the same terms", "the state of that name"),
            Key(
                "offsets",
                "table of numbers",
                "what each output shows at zero; re-fitted, unless fixed lists OUTPUT_offset",
                "0",
            ),
            Key(
                "function",
                "file.py:name",
                "derivatives(t, states, inputs, parameters) in place of equations; each is a mapping by name, and so is"
                " the result",
                "none",
            ),
            Key(
                "units",
                "table by name; may stand as [twin.units]",
                "of each parameter; of an input or output that the equations want in another unit than its column's",
                "none",
            ),
            Key("fixed", "list of names", "parameters that are not re-fitted", "none"),
            HOLD_OF_EACH,
            Key("any other name", "number", "a parameter of the equations; may be re-fitted"),
        ),
        "fmu": (
            Key("path", "file name", "the FMU beside the recording: co-simulation (FMI 2, 3), model exchange (2)"),
            HOLD_OR_STRAIGHT,
            Key("any parameter of the FMU", "number", "your value; may be re-fitted", "the FMU's"),
        ),
    }
)
"""Keys of ``[twin.parameters]`` per kind. Kinds of installed packages define their own."""


def names(keys: Sequence[Key]) -> tuple[str, ...]:
    """Return the names of keys, in order."""
    return tuple(key.name for key in keys)
