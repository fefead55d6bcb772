"""Which effect makes sense on which twin, under which excitation: the visibility rules.

An entry gives the maker, the excitations under which the effect is physically visible and separable
from a plain gain or delay, the shortest record, and whether one needs several axes or a context signal.
On top of this table ``draw.py`` measures visibility: a case is only kept when at least
``visible_share`` of the effect's rms is left after the base parameters are re-fitted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from tools.research.prove import forms_axis as ax
from tools.research.prove import forms_sensor as fs
from tools.research.prove import forms_time as ft
from tools.research.prove.forms_memory import Rng
from tools.research.prove.guests import FMU, INSTRUMENT, USER
from tools.research.prove.plants import Bound, Scene
from tools.research.prove.ports import shaped

FAST = ("sine", "sines", "multisine", "tremor", "chirp")
STEPPED = ("staircase", "sawtooth")
SCALAR_ALL = (*FAST, *STEPPED, "slow")
WIDE = ("sines", "multisine", "tremor", "chirp")
TURNING = ("rotary", "tumble")
SHAKING = ("shake3", "tremor3", "chirp3")
VECTOR_ALL = (*TURNING, *SHAKING, "slow3")
BODY = ("swing", "tremor6", "multisine6")


@dataclass(frozen=True)
class Entry:
    make: Callable[[Rng, Scene], Bound]
    under: tuple[str, ...]
    why: str
    least_s: float = 0.0
    needs_all_axes: bool = False
    context: str | None = None
    fast_only: bool = False


INSTRUMENT_DRIVE = ("hysteresis", "backlash", "saturation", "slew_limit", "dead_time")
INSTRUMENT_ANYTIME = (
    "mains_interference", "vibration", "spikes", "step_shift", "quantization", "clock_skew", "dropped_samples",
)  # fmt: skip


def _shape(name: str, where: str) -> Callable[[Rng, Scene], Bound]:
    return partial(shaped, name, where=where)


def _anytime(under: tuple[str, ...]) -> dict[str, Entry]:
    """Effects that do not need the input."""
    quick = tuple(u for u in under if not u.startswith("slow"))
    return {
        "thermal_drift": Entry(ft.thermal_drift, under, "a drift over 10-60 % of the record", 20.0),
        "mains_interference": Entry(ft.mains_interference, quick, "rate above 100 Hz", fast_only=True),
        "vibration": Entry(ft.vibration, quick, "a line above the excitation, below 0.45 rate", fast_only=True),
        "spikes": Entry(ft.spikes, quick, "at least four bursts of two samples or more"),
        "step_shift": Entry(ft.step_shift, under, "the level stays for a quarter of the record"),
        "random_walk": Entry(ft.random_walk, under, "one long record, drift without shape", 20.0),
        "quantization": Entry(ft.quantization, under, "steps well above the noise"),
        "clock_skew": Entry(ft.clock_skew, tuple(u for u in quick if u not in ("rotary",)), "fast input"),
        "dropped_samples": Entry(ft.dropped_samples, quick, "fast input"),
    }


def _one_signal(where: str) -> dict[str, Entry]:
    moving = (*WIDE, *STEPPED)
    # a dozen levels of a staircase cannot tell one curve from another
    many_levels = (*WIDE, "sawtooth", "sine")
    return {
        "hysteresis": Entry(
            _shape("hysteresis", where), (*moving, "slow", "sine"), "several amplitudes or speeds, else it is a phase"
        ),
        "rate_dependent_hysteresis": Entry(
            _shape("rate_dependent_hysteresis", where), ("sines", "chirp", "multisine", "sawtooth"), "several speeds"
        ),
        "creep": Entry(_shape("creep", where), ("staircase", "slow"), "levels held for at least a second", 15.0),
        "backlash": Entry(_shape("backlash", where), (*moving, "sine"), "reversals"),
        "dead_zone": Entry(_shape("dead_zone", where), many_levels, "the input crosses zero"),
        "saturation": Entry(_shape("saturation", where), (*many_levels, "slow"), "the input reaches the limit"),
        "static_nonlinearity": Entry(_shape("static_nonlinearity", where), (*many_levels, "slow"), "a range of inputs"),
        "slew_limit": Entry(
            _shape("slew_limit", where),
            ("sines", "chirp", "multisine", "staircase"),
            "fast and slow parts",
            fast_only=True,
        ),
        "first_order_lag": Entry(
            _shape("first_order_lag", where), (*WIDE, "staircase"), "several frequencies or steps", fast_only=True
        ),
        "ac_coupling": Entry(
            _shape("ac_coupling", where), ("staircase", "sawtooth", "tremor", "multisine"), "content near the corner"
        ),
        "resonance": Entry(
            _shape("resonance", where),
            ("staircase", "chirp", "multisine", "sines"),
            "steps or content near the mode",
            fast_only=True,
        ),
        "dead_time": Entry(
            _shape("dead_time", where), (*WIDE, "staircase", "sawtooth"), "several frequencies", fast_only=True
        ),
    }


def _temperature(under: tuple[str, ...]) -> dict[str, Entry]:
    why = "temperature recorded and moving"
    return {"temperature_sensitivity": Entry(fs.temperature_sensitivity, under, why, 20.0, context="temperature")}


def _supply(under: tuple[str, ...]) -> dict[str, Entry]:
    why = "supply recorded and moving"
    return {"supply_sensitivity": Entry(fs.supply_sensitivity, under, why, context="supply")}


def _vector_sensor() -> dict[str, Entry]:
    shakes = SHAKING
    return {
        **_anytime(VECTOR_ALL),
        **_temperature(VECTOR_ALL),
        **_supply(VECTOR_ALL),
        "cross_axis_nonlinearity": Entry(
            fs.cross_axis_nonlinearity, VECTOR_ALL, "several axes excited", needs_all_axes=True
        ),
        "scale_factor_variation": Entry(
            fs.scale_factor_variation, VECTOR_ALL, "several axes excited", needs_all_axes=True
        ),
        "saturation": Entry(_shape("saturation", "out"), VECTOR_ALL, "the input reaches the limit"),
        "static_nonlinearity": Entry(_shape("static_nonlinearity", "one_out"), VECTOR_ALL, "a range of inputs"),
        "first_order_lag": Entry(_shape("first_order_lag", "out"), shakes, "several frequencies", fast_only=True),
        "dead_time": Entry(_shape("dead_time", "out_all"), shakes, "several frequencies", fast_only=True),
        "channel_delay": Entry(
            ft.channel_delay, shakes, "several outputs, fast input", needs_all_axes=True, fast_only=True
        ),
        "dead_zone": Entry(_shape("dead_zone", "one_out"), (*TURNING, *SHAKING), "the input crosses zero"),
    }


def _table() -> dict[str, dict[str, Entry]]:
    piezo = {**_one_signal("drive"), **_anytime(SCALAR_ALL), **_temperature(SCALAR_ALL)}
    axis_under = ("sines", "multisine", "tremor", "chirp", "staircase", "sawtooth")
    inside = _one_signal("drive")
    axis = {
        **_anytime(axis_under),
        **_temperature(axis_under),
        **{k: inside[k] for k in ("saturation", "dead_zone", "first_order_lag", "dead_time", "slew_limit")},
        "resonance": Entry(
            _shape("resonance", "one_out"),
            ("staircase", "chirp", "multisine", "sines"),
            "steps or content near the mode",
            fast_only=True,
        ),
        "backlash": Entry(_shape("backlash", "one_out"), axis_under, "reversals"),
        "coulomb_friction": Entry(ax.coulomb_friction, axis_under, "motion with reversals"),
        "stribeck_friction": Entry(ax.stribeck_friction, axis_under, "slow and fast motion"),
        "cubic_stiffness": Entry(ax.cubic_stiffness, axis_under, "a range of positions"),
        "cogging": Entry(ax.cogging, axis_under, "travel over two pitches or more"),
        "hysteresis": Entry(ax.hysteresis, axis_under, "several amplitudes"),
    }
    ss_under = ("sines", "multisine", "tremor", "chirp", "staircase", "sawtooth")
    ss = {**_one_signal("either"), **_anytime(ss_under), **_temperature(ss_under)}
    acc = {
        **_vector_sensor(),
        "misalignment": Entry(fs.misalignment, VECTOR_ALL, "several axes excited", needs_all_axes=True),
        "ac_coupling": Entry(_shape("ac_coupling", "one_out"), ("rotary", "tremor3"), "slow and fast content"),
        "resonance": Entry(_shape("resonance", "one_out"), SHAKING, "content near the mode", fast_only=True),
    }
    mag = {
        **{k: e for k, e in _vector_sensor().items() if k != "supply_sensitivity"},  # no such context there
        "soft_iron": Entry(fs.soft_iron, (*TURNING, "slow3"), "the field turns", needs_all_axes=True),
        "current_coupling": Entry(
            fs.current_coupling, (*TURNING, "slow3"), "current recorded and moving", context="actuator_current"
        ),
        "hysteresis": Entry(_shape("hysteresis", "one_out"), (*TURNING, "slow3"), "turning points of several sizes"),
    }
    for name in ("first_order_lag", "dead_time", "channel_delay"):
        # a field turns slowly; these need a fast tumble to show
        mag[name] = Entry(mag[name].make, ("tumble",), "fast tumble", needs_all_axes=True, fast_only=True)
    cluster = {
        **_anytime(BODY),
        **_temperature(BODY),
        "centripetal_acceleration": Entry(fs.centripetal_acceleration, ("swing",), "fast turning, lever arms"),
        "sensor_position_error": Entry(fs.sensor_position_error, BODY, "angular acceleration"),
        "channel_delay": Entry(ft.channel_delay, BODY, "fast motion", fast_only=True),
        "dead_time": Entry(_shape("dead_time", "out_all"), BODY, "fast motion", fast_only=True),
        "first_order_lag": Entry(_shape("first_order_lag", "out_all"), BODY, "fast motion", fast_only=True),
        "saturation": Entry(_shape("saturation", "one_out"), BODY, "reaches the limit"),
        "misalignment": Entry(fs.misalignment_of_cluster, BODY, "gravity and motion on several axes"),
        "resonance": Entry(_shape("resonance", "one_out"), BODY, "content near the mode", fast_only=True),
    }
    cluster.pop("random_walk")
    # an opaque twin has inputs and outputs; two seconds of the bench hold no slow effect
    brief = {k: _anytime(ss_under)[k] for k in INSTRUMENT_ANYTIME}
    at_commands = {k: _one_signal("drive")[k] for k in INSTRUMENT_DRIVE}
    bench = {
        **at_commands,
        **brief,
        "static_nonlinearity": Entry(_shape("static_nonlinearity", "one_out"), WIDE, "a range of readings"),
        "first_order_lag": Entry(_shape("first_order_lag", "one_out"), WIDE, "several frequencies", fast_only=True),
        "channel_delay": Entry(ft.channel_delay, WIDE, "several outputs, fast input", fast_only=True),
    }
    return {
        "piezo_stack": piezo,
        "accelerometer": acc,
        "magnetometer": mag,
        "accelerometer_cluster": cluster,
        "mechanical_axis": axis,
        "state_space": ss,
        # power and commands of the bench have one sign: a dead zone is never crossed there, and moves the offset
        FMU: {k: e for k, e in ss.items() if k != "dead_zone"},
        USER: ss,
        INSTRUMENT: bench,
    }


TABLE = _table()
TWINS = tuple(TABLE)

# pairs that one recording cannot be expected to separate
RIVALS: tuple[frozenset[str], ...] = tuple(
    frozenset(g)
    for g in (
        ("hysteresis", "rate_dependent_hysteresis", "backlash", "coulomb_friction", "stribeck_friction", "dead_zone"),
        ("creep", "thermal_drift", "random_walk", "ac_coupling", "step_shift", "temperature_sensitivity"),
        ("dead_time", "first_order_lag", "channel_delay", "clock_skew", "dropped_samples", "resonance", "slew_limit"),
        ("misalignment", "soft_iron"),
        ("saturation", "static_nonlinearity", "cubic_stiffness", "quantization"),
        ("rate_dependent_hysteresis", "first_order_lag", "dead_time", "creep"),
        ("mains_interference", "vibration"),
        ("spikes", "step_shift"),
    )
)
