"""The measured recordings with published figures: official splits, what their authors know, what others reached."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Published:
    """A figure to compare with, in the unit of the set."""

    figure: float
    what: str
    source: str


@dataclass(frozen=True)
class RealSet:
    """One official split: fit part and test part joined in one descriptor, as the contract's [split] wants it."""

    name: str
    title: str
    fit: str
    test: str | tuple[int, int] | None
    output: str
    unit: str
    factor: float
    initialization: int
    published: tuple[Published, ...]
    known: str
    # the chief physics by its authors, in words of the vocabulary (any of these is right); empty where nobody knows
    found: tuple[str, ...] = ()
    # what they know beside it
    beside: tuple[str, ...] = ()
    # looked up by hand after the tool had spoken
    remark: str = ""


SETS = (
    RealSet(
        "emps",
        "electro-mechanical positioning axis (EMPS)",
        "emps/train.toml",
        "emps/test.toml",
        "position",
        "mm",
        1e3,
        20,
        (
            Published(2.64, "dynoNet", "quoted in arXiv 2405.10779"),
            Published(5.53, "linear state space", "arXiv 2405.10779"),
        ),
        "Coulomb and unequal viscous friction on a free integrator; pulses on the test drive excite a flexibility.",
        ("coulomb_friction", "stribeck_friction"),
        ("resonance",),
        "In short stretches, each started afresh, friction takes two thirds of the residual; in the one free run of "
        "the official test a quarter. Any wrong force adds up in a free integrator: with Coulomb friction alone the "
        "model left 2.1 mm on the run that it was fitted on (8.4 without friction), and 0.86 mm on the test run when "
        "fitted there, with 5 % more friction. 0.1 N on the force, 0.4 % of the friction, moves the end of the test "
        "run by 6 mm. The position in the file is smooth: the nanometres that the tool reads as its noise are no "
        "encoder's, so that all that is left counts as real: hence 'unexplained'.",
    ),
    *(
        RealSet(
            f"silverbox {label}",
            f"second-order circuit with a hardening spring (Silverbox), {label}",
            "silverbox/recording.toml",
            span,
            "output",
            "mV",
            1e3,
            50,
            (
                Published(best, "best of the benchmark table", "arXiv 2405.10779"),
                Published(cubic, "linear model with y^2 and y^3", "README of the data, own fit"),
            ),
            "A spring that hardens; learned on multisines, the arrow goes to larger amplitudes.",
            ("cubic_stiffness", "static_nonlinearity"),
            (),
            "What is left beside the cubic spring is several times the floor and a part of it follows the rate: others "
            "take it with models that name no physics, the tool of 89530632 with a resonance on two of the three runs "
            "(0.40 mV; 0.89 with the spring alone), which nobody knows to be there.",
        )
        for label, span, best, cubic in (
            ("multisine", (105712, 127400), 0.26, 1.05),
            ("arrow", (100, 40575), 0.60, 1.77),
            ("arrow without extrapolation", (100, 32100), 0.259, 1.04),
        )
    ),
    RealSet(
        "piezo_micromanipulator_dbo",
        "piezo micromanipulator",
        "piezo_micromanipulator_dbo/train.toml",
        "piezo_micromanipulator_dbo/test.toml",
        "displacement",
        "um",
        1.0,
        0,
        (
            Published(0.577, "left over with the authors' inverse model", "Aye and Ang 2018, recomputed"),
            Published(2.48, "best straight line on the test run", "README of the data"),
        ),
        "Stack hysteresis, one-sided curvature, some creep, one sample of delay.",
        ("hysteresis", "rate_dependent_hysteresis"),
        ("static_nonlinearity", "creep", "dead_time"),
        "The level shifted by 0.7 um between the two files; without its mean the residual is 0.69 um. The fit run is a "
        "sine of one amplitude, so neither a delay nor a lag can be told from a part of the loop: the tools of "
        "3bb2d824 and 89530632 named the lag, those before, between and after them the loop.",
    ),
    RealSet(
        "coupled_electric_drives low",
        "two motors, belt, pulley (CE8), uniform low",
        "coupled_electric_drives/uniform_low.toml",
        (400, 500),
        "speed",
        "V",
        1.0,
        4,
        (
            Published(0.096, "recurrent network", "MDCHAMP/nonlinear_baselines"),
            Published(0.115, "best published there", "quoted in arXiv 2405.10779"),
        ),
        "A sensor that cannot see the sign of the speed, behind a lightly damped third-order plant; 500 samples.",
        ("static_nonlinearity",),
        (),
        "The curve is named, the place is not its authors': they know the fold to be at the sensor. The test part is "
        "100 samples, so a third digit means nothing.",
    ),
    RealSet(
        "coupled_electric_drives high",
        "two motors, belt, pulley (CE8), uniform high",
        "coupled_electric_drives/uniform_high.toml",
        (400, 500),
        "speed",
        "V",
        1.0,
        4,
        (
            Published(0.095, "FIR network", "MDCHAMP/nonlinear_baselines"),
            Published(0.074, "best published there", "quoted in arXiv 2405.10779"),
        ),
        "The same at larger amplitude; the gain is far from proportional to the amplitude.",
        ("static_nonlinearity",),
        (),
        "As before: the curve is named, the place is not its authors'.",
    ),
    RealSet(
        "accelerometer_package_vs_reference",
        "low-cost accelerometer package beside a reference on a shaker",
        "accelerometer_package_vs_reference/test_0_10.toml",
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
        ("dead_time",),
        ("clock_skew",),
        "Little to gain after the lag. What is left follows time, as clocks that run apart would make it, but the tool "
        "accepts no skew. The published figures are of whole sweeps with one shift each, ours of held-out blocks.",
    ),
)
