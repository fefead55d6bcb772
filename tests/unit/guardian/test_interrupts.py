"""The end of a run in a process of its own: interrupts are counted, and none of them takes the outcome away."""

from __future__ import annotations

import subprocess

from hal.children import child_command, child_environment

PROGRAM = """
import signal
from firmware_py.run_request import count_interrupts
with count_interrupts() as interrupts:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGINT):
        signal.raise_signal(number)
    print(interrupts())
signal.raise_signal(signal.SIGINT)
print("outcome")
"""


def test_interrupts_are_counted_and_then_too_late():
    interpreter = child_command("x")[0]
    done = subprocess.run([interpreter, "-c", PROGRAM], capture_output=True, text=True, env=child_environment())
    assert (done.returncode, done.stdout, done.stderr) == (0, "3\noutcome\n", "")
