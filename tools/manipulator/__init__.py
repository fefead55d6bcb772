"""Workspace of the manipulator: extents, largest spheres, conditioning, picture."""
