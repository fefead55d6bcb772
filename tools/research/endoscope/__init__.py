"""The targeting experiment of Erat 2018: a synthetic or a real user, reports, tables.

What lives here: the user model and what is computed of a game. What must not: the mapping itself
(``firmware_py.endoscope``).
"""
