"""The commands of research, which ``tools.cli.main`` offers in a source tree beside those of the product."""

COMMANDS = {
    "hands": (
        "tools.research.cli.hands:hands",
        "Run the instrument in every recorded hand, with each estimator, in virtual time, beside the limits.",
    ),
    "faults": (
        "tools.research.cli.faults:faults",
        "Break the emulated instrument in every way of the catalogue, and print what it did.",
    ),
    "soak": (
        "tools.research.cli.soak:soak",
        "Run the closed loop for hours in virtual time and report memory, tremor and every counter by eighths.",
    ),
    "endoscope": (
        "tools.research.cli.endoscope:endoscope",
        "Let a synthetic user steer the endoscope's field of view with the motion card (Erat 2018, chapter 6).",
    ),
    "reproduce": (
        "tools.research.cli.reproduce:reproduce",
        "Compute published figures again and print them beside ours.",
    ),
    "placement": (
        "tools.research.cli.placement:placement",
        "Find places of accelerometers with the least angular (or tip) noise, beside those of Latt 2011.",
    ),
    "manipulator": (
        "tools.research.cli.manipulator:manipulator",
        "Compute extents, largest sphere, singularity and conditioning of the bench's manipulator.",
    ),
    "sensing": ("tools.research.cli.sensing:app", "Compute error budgets of the sensing stage on emulated sensors."),
    "tremor": ("tools.research.cli.tremor:app", "Inspect recorded hands, train on them, and evaluate estimators."),
}
"""Name -> where it is, and its line in the list."""

INSIDE = {
    "mismatch": {"prove": "tools.research.cli.prove:prove", "calibrate": "tools.research.cli.prove:calibrate"},
}
"""Commands inside a group of the product: group -> name -> where it is."""
