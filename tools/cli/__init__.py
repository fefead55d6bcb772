"""The ``micron`` command: one module per command, thin over the libraries that do the work.

What lives here: options, exit codes, what is printed. What must not: computation; imports of heavy packages at the
top of a file, because every ``--help`` would pay for them.
"""
