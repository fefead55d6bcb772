"""Names of the places in ``E727.words``, apart from the driver: a change of the driver compiles no loop anew."""

from __future__ import annotations

ASK_ERROR_EVERY = 20
"""Number of commands from one ``ERR?`` to the next."""
DUE_NS, PERIOD_NS, COMMANDS, SUPERSEDED, LATE, WORDS = range(6)
"""Places in ``E727.words``: when the next command may go out, the time between two, and three counters."""
