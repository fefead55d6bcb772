"""Places and orients accelerometers: error variance, propositions, optimisation (Latt 2011).

What lives here: configurations and their search. What must not: the 1 kHz kinematics (``firmware_py.sensing``).
"""
