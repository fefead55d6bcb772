"""The commands of research, which ``tools.cli.main`` offers in a source tree beside those of the product."""

COMMANDS = {
    "hands": "tools.research.cli.hands:hands",
    "faults": "tools.research.cli.faults:faults",
    "soak": "tools.research.cli.soak:soak",
    "endoscope": "tools.research.cli.endoscope:endoscope",
    "reproduce": "tools.research.cli.reproduce:reproduce",
    "placement": "tools.research.cli.placement:placement",
    "manipulator": "tools.research.cli.manipulator:manipulator",
    "sensing": "tools.research.cli.sensing:app",
    "tremor": "tools.research.cli.tremor:app",
}
"""Name -> where it is."""

INSIDE = {
    "mismatch": {"prove": "tools.research.cli.prove:prove", "calibrate": "tools.research.cli.prove:calibrate"},
}
"""Commands inside a group of the product: group -> name -> where it is."""
