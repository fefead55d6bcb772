"""Bench files that ship with the package: which devices there are and what is emulated."""
