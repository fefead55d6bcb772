"""Commands on a bench that names code of other packages run in a process of their own, so that its crash is a message.

The child is this same command again; it has the terminal, and its exit status is ours.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
from pathlib import Path

import typer

from hal.bench import load_bench, named_packages
from hal.children import SUPERVISED, child_command, child_environment
from hal.trust import NotTrusted, is_our_package
from tools.cli.common import Exit, print_error

MEMORY_BYTES = 8 << 30


def supervise(bench: Path) -> None:
    """Run this command again in a child and end with its status, if ``bench`` names code that is not ours.

    Returns where there is nothing to supervise: a bench of ours, or a process that is the child already.
    """
    if SUPERVISED in os.environ or not Path(sys.argv[0]).name.startswith(("micron", "main.py")):
        return
    try:
        named = named_packages(load_bench(bench).description)
    except NotTrusted:
        return  # the command decides, and comes here again
    foreign = [target for target in named if not is_our_package(target)]
    if not foreign:
        return
    reading, writing = os.pipe()
    environment = {**child_environment(), SUPERVISED: str(writing)}
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # the child has the habit
    try:
        child = subprocess.Popen(child_command("tools.cli.main", *sys.argv[1:]), env=environment, pass_fds=(writing,))
        os.close(writing)
        with os.fdopen(reading, "rb") as pipe:
            has_ended_itself = bool(pipe.read(1))
        status = child.wait()
    finally:
        signal.signal(signal.SIGINT, before)
    if has_ended_itself:
        raise typer.Exit(status if status >= 0 else Exit.INTERRUPTED)
    how = f"crashed ({signal.Signals(-status).name})" if status < 0 else f"ended the process with status {status}"
    print_error(f"{bench}: code that is not ours ({', '.join(foreign)}) {how}; repair it, or leave it out")
    raise typer.Exit(Exit.BAD_INPUT)


def begin_supervised() -> int | None:
    """Limit memory, end with the parent, and return the handle on which to say that the end is ours.

    None where nobody supervises.
    """
    handle = int(os.environ.get(SUPERVISED, "-1"))
    if handle < 0:
        return None
    os.environ[SUPERVISED] = "-1"  # for what this process starts itself
    os.set_inheritable(handle, False)
    if sys.platform == "linux":
        import resource

        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))
        ctypes.CDLL(None).prctl(1, signal.SIGTERM, 0, 0, 0)  # PR_SET_PDEATHSIG
    return handle
