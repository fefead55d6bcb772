"""Pages about the firmware: the closed loop in recorded hands beside its limits, and the table of findings.

What lives here: the runs over recorded hands and the pages made of them. What must not: the report of one run
(``tools.reports``).
"""
