"""The ``micron`` command: one module per command, thin over the libraries that do the work."""
