"""What people look at: figures computed from recordings and truth, tables, pictures, HTML.

What lives here: the report of a run and of the hands. What must not: estimation; a report reads frames and truth.
"""
