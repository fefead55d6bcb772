"""Shows a diagnosis to people: terminal, page, vocabulary, and the next recording worth making.

What lives here: the words, tables and pictures of a result. What must not: a decision; a report reads the engine's.
"""
