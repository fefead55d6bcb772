"""Results: what a command measured, kept as a JSON artefact in ``docs/results`` and shown by ``docs/results.md``.

What lives here: the form of an artefact and the page that is made of all. Not here: measuring anything.

``artefact`` converts between the page that a command makes (Markdown) and the artefact; ``page`` makes the one page of
all artefacts. No command writes into ``docs/`` unless it is told to with ``--out``.
"""
