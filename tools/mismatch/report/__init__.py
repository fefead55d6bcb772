"""What people see of a diagnosis: terminal, page, vocabulary, and what to record next.

What lives here: the words, tables and pictures of a result. What must not: a decision; a report reads the engine's.
"""
