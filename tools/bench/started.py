"""A bench page of one's own, for screenshots and measurements: started on a free port, ended with the block."""

from __future__ import annotations

import signal
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from hal.children import child_command, child_environment


@contextmanager
def started(*options: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Start ``micron bench`` with ``options``. Yield its process and the address that it printed, with the token."""
    server = subprocess.Popen(
        child_command("tools.cli.main", "bench", "--port", "0", *options),
        stderr=subprocess.PIPE,
        text=True,
        env={**child_environment(), "COLUMNS": "400"},  # the address in one line
    )
    try:
        assert server.stderr is not None
        address = next(word for line in server.stderr for word in line.split() if word.startswith("http"))
        threading.Thread(target=server.stderr.read, daemon=True).start()
        yield server, address
    finally:
        if server.poll() is None:
            server.send_signal(signal.SIGTERM)
            server.wait(60)
