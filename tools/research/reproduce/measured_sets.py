"""The measured recordings with published figures: official splits, what their authors know, what others reached, and
what the project set itself as a goal.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Published:
    """A figure to compare with, in the unit of the set."""

    figure: float
    what: str
    source: str


@dataclass(frozen=True)
class Goal:
    """A figure on the sealed test, in the unit of the set, under the right names.

    One of each group of ``needed`` must be named, nothing beyond them and ``allowed`` may be; empty: no name is asked
    for. ``relative_to_given``: ``figure`` is a share of the residual of the twin as given.
    """

    figure: float
    needed: tuple[tuple[str, ...], ...] = ()
    allowed: tuple[str, ...] = ()
    relative_to_given: bool = False

    def names_meet(self, names: list[str]) -> bool:
        """Return whether these are the right names: one of each group that is needed, and none that is not allowed."""
        found = set(names)
        everything = {n for group in self.needed for n in group} | set(self.allowed)
        return all(found & set(group) for group in self.needed) and (not self.needed or found <= everything)


@dataclass(frozen=True)
class MeasuredSet:
    """Describes an official split.

    ``fit`` and ``test``: descriptor and sample range (None: all). ``initialization``: number of samples at the start of
    the test that may set the state and are not scored. ``periods``: number of runs of a test of one steady period, of
    which the last is scored. ``test`` None: the tool's own held-out blocks of ``fit`` are the test.
    """

    name: str
    title: str
    fit: tuple[str, tuple[int, int] | None]
    test: tuple[str, tuple[int, int] | None] | None
    output: str
    unit: str
    factor: float
    initialization: int
    published: tuple[Published, ...]
    known: str
    goal: Goal | None = None
    periods: int = 1
    mean_free: bool = False
    """Whether the mean of the residual is taken off before it is scored, as the published figures do."""
    twin: Mapping[str, Any] | None = None
    """The ``[twin]`` table to start from, where the one beside the data has states without a meaning."""


_TWO_TANKS: Mapping[str, Any] = {
    "kind": "ode",
    "parameters": {
        "outflow_1": 0.019031512743901666,
        "outflow_2": 0.005967937006534422,
        "gain": 0.02752187404698971,
        "deficit": 0.04402655461136278,
        "states": {
            "upper": {"unit": "V", "start": 1.331340585462794},
            "lower": {"unit": "V", "start": 5.219806285135793},
        },
        "equations": {
            "upper": "gain * pump - outflow_1 * upper - deficit",
            "lower": "outflow_1 * upper - outflow_2 * lower",
        },
        "outputs": {"level": "lower"},
        "hold": "zero",
    },
}
"""The linear tanks of the data's own twin, number for number, with the two levels as named states; the pump voltage is
held between samples (Schoukens and Noel 2017, section 2)."""

_PAPER = "arXiv 2405.10779"

SETS = (
    MeasuredSet(
        "emps",
        "electro-mechanical positioning axis (EMPS)",
        ("emps/train.toml", None),
        ("emps/test.toml", None),
        "position",
        "mm",
        1e3,
        20,
        (Published(2.64, "dynoNet", f"quoted in {_PAPER}"), Published(5.53, "linear state space", _PAPER)),
        "Coulomb and unequal viscous friction on a free integrator; pulses on the test drive excite a flexibility."
        " Constants of its two records differ by 1 to 4 %; 0.1 N of a constant moves 12 mm (`micron reproduce emps`).",
        Goal(2.6, (("coulomb_friction", "stribeck_friction"),), ("resonance",)),
    ),
    *(
        MeasuredSet(
            f"silverbox {label}",
            f"second-order circuit with a hardening spring (Silverbox), {label}",
            ("silverbox/recording.toml", (40650, 105712)),
            ("silverbox/recording.toml", span),
            "output",
            "mV",
            1e3,
            50,
            (
                Published(best, "best of the benchmark table", _PAPER),
                Published(cubic, "linear model with y^2 and y^3", "README of the data, own fit"),
            ),
            "A spring that hardens; learned on multisines, the arrow goes to larger amplitudes.",
            Goal(goal, (("cubic_stiffness",),)),
        )
        for label, span, best, cubic, goal in (
            ("multisine", (105712, 127400), 0.26, 1.05, 0.30),
            ("arrow", (100, 40575), 0.60, 1.77, 0.60),
            ("arrow without extrapolation", (100, 32100), 0.259, 1.04, 0.30),
        )
    ),
    MeasuredSet(
        "cascaded_tanks",
        "pump and two tanks with overflow",
        ("cascaded_tanks/recording.toml", None),
        ("cascaded_tanks/test.toml", None),
        "level",
        "V",
        1.0,
        5,
        (
            Published(0.191, "grey box, best", "Worden 2018, quoted in meta.toml of the data"),
            Published(0.306, "CT-SUBNET", "quoted in meta.toml of the data"),
            Published(0.588, "linear, best", "quoted in meta.toml of the data"),
        ),
        "Outflow with the square root of the level; both tanks overflow.",
        Goal(0.20, (("square_root_outflow",), ("overflow",))),
        twin=_TWO_TANKS,
    ),
    MeasuredSet(
        "wiener_hammerstein",
        "a diode circuit between two filters (Wiener-Hammerstein)",
        ("wiener_hammerstein/recording.toml", None),
        ("wiener_hammerstein/test.toml", None),
        "node",
        "mV",
        1e3,
        50,
        (
            Published(0.241, "SUBNET", "quoted in meta.toml of the data"),
            Published(0.42, "PNLSS", "quoted in meta.toml of the data"),
            Published(43.4, "linear, best", "quoted in meta.toml of the data"),
        ),
        "A one-sided curve (diode) between two filters of third order.",
        Goal(0.5, (("static_nonlinearity", "one_sided_conduction", "diode"),)),
    ),
    MeasuredSet(
        "bouc_wen",
        "one hysteretic spring beside a linear one (Bouc-Wen)",
        ("bouc_wen/recording.toml", None),
        ("bouc_wen/test.toml", None),
        "output",
        "mm",
        1.0,
        0,
        (
            Published(0.0187, "PNLSS", "quoted in meta.toml of the data"),
            Published(0.0452, "dynoNet", "quoted in meta.toml of the data"),
            Published(0.163, "NFIR", "quoted in meta.toml of the data"),
        ),
        "A hysteretic restoring force inside the loop (simulated benchmark, noise in training only).",
        Goal(0.0187, (("hysteresis",),)),
        periods=2,
    ),
    *(
        MeasuredSet(
            f"coupled_electric_drives {label}",
            f"two motors, belt, pulley (CE8), uniform {label}",
            (f"coupled_electric_drives/uniform_{label}.toml", (0, 400)),
            (f"coupled_electric_drives/uniform_{label}.toml", (400, 500)),
            "speed",
            "V",
            1.0,
            4,
            published,
            "A sensor that cannot see the sign of the speed, behind a lightly damped third-order plant; 500 samples.",
            Goal(goal, (("static_nonlinearity", "sign_lost", "folded_sign"),)),
        )
        for label, goal, published in (
            (
                "low",
                0.09,
                (
                    Published(0.096, "recurrent network", "MDCHAMP/nonlinear_baselines"),
                    Published(0.115, "best published there", f"quoted in {_PAPER}"),
                ),
            ),
            (
                "high",
                0.07,
                (
                    Published(0.095, "FIR network", "MDCHAMP/nonlinear_baselines"),
                    Published(0.074, "best published there", f"quoted in {_PAPER}"),
                ),
            ),
        )
    ),
    MeasuredSet(
        "piezo_micromanipulator_dbo",
        "piezo micromanipulator",
        ("piezo_micromanipulator_dbo/train.toml", None),
        ("piezo_micromanipulator_dbo/test.toml", None),
        "displacement",
        "um",
        1.0,
        200,
        (
            Published(0.577, "left over with the authors' inverse model", "Aye and Ang 2018, recomputed"),
            Published(0.41, "ten plays", "issue 19"),
            Published(2.48, "best straight line on the test run", "README of the data"),
        ),
        "Stack hysteresis, one-sided curvature, some creep, one sample of delay.",
        Goal(
            0.25,
            (("hysteresis", "rate_dependent_hysteresis"), ("dead_time",)),
            ("static_nonlinearity",),
        ),
        mean_free=True,
    ),
    MeasuredSet(
        "f16_gvt",
        "aircraft wing with payload on a shaker (F-16)",
        ("f16_gvt/recording.toml", None),
        ("f16_gvt/test.toml", None),
        "",
        "m/s^2",
        1.0,
        1000,
        (),
        "Friction and clearance at the mount of the payload: the resonance near 7.3 Hz moves with the level.",
        Goal(
            0.5,
            (("coulomb_friction", "stribeck_friction", "backlash", "clearance", "amplitude_dependent_damping"),),
            (),
            True,
        ),
    ),
    MeasuredSet(
        "accelerometer_package_vs_reference",
        "low-cost accelerometer package beside a reference on a shaker",
        ("accelerometer_package_vs_reference/test_0_10.toml", None),
        None,
        "voltage_x",
        "mg",
        1e3,
        0,
        (
            Published(2.8, "best constant shift and gain", "README of the data, own fit"),
            Published(3.13, "the authors' LSTM (2.94 uncorrected)", "their file"),
        ),
        "Two loggers: dead time and clocks that run apart; beyond that little to gain.",
    ),
)
