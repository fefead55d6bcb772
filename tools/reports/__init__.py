"""The report of a run: figures computed from recordings and truth, tables, pictures, HTML.

What lives here: figures of merit of the tip, the report of a run while it goes on and at its end.
What must not: estimation; a report reads frames and truth.
"""
