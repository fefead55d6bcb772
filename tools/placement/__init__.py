"""Where accelerometers sit and point: error variance, propositions, optimisation (document 004).

What lives here: configurations and their search. What must not: the 1 kHz kinematics (``firmware_py.sensing``).
"""
