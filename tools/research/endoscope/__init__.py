"""The targeting experiment of Erat 2018: a synthetic or a real user, reports, tables.

What lives here: the user model, what is computed of a game, and published filters to compare with.
What must not: the mapping itself (``firmware_py.endoscope``).
"""
