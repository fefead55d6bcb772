"""Research: what reproduces papers, measures the bench and the engine, and makes the pages of results.

What lives here: programs of the source tree; the wheel contains neither this folder nor its commands.
What must not: anything that the rest of ``tools`` imports (import-linter); a user of the instrument needs none of it.
"""
