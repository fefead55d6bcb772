"""The second instrument: inertial sensors or a motion card steer an endoscope's view.

What lives here: its wiring, loop, mapping of attitude to the view, targets and report, on the same HAL, scheduler and
attitude filters. What must not: a second implementation of any of these.
"""
