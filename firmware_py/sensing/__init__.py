"""Computes the motion of the body and the acceleration of the tip from counts. Sensing ends here, estimation begins.

What lives here: calibration applied, differential kinematics, attitude filters, translation, the compiled ``stage``;
the same code live, in replay and in batch. What must not: tremor, identification of parameters (``tools.calibrate``).
"""
