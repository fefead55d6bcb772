"""Attitude filters of the instrument that results compare with: plug-ins of the group ``micron.attitude``.

What lives here: filters without an advantage over ``error-state``. What must not: what a bench needs.
"""
