"""The closed loop without wires: the emulated world and the firmware's step as one compiled loop."""
