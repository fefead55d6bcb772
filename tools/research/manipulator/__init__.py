"""Workspace of the manipulator: extents, largest spheres, conditioning, picture.

What lives here: scans over the firmware's own kinematics. What must not: kinematics of its own.
"""
