"""Pages of ``docs``: the closed loop in recorded hands, the table of findings, public recordings, data of one's own.

What lives here: the runs over recorded hands and the pages made of them and of the product's tables.
What must not: the report of one run (``tools.reports``).
"""
