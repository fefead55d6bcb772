"""The commands run with one thread per linear algebra call, which has to be said before numpy is loaded."""

from __future__ import annotations

import subprocess
import sys

from hal.children import child_environment

PROGRAM = """
import os, sys
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.pop(name, None)
os.environ.update(%s)
import tools.cli.main as cli
assert "numpy" not in sys.modules
sys.argv = ["micron", "--version"]
try:
    cli.main()
except SystemExit:
    pass
print(os.environ["OMP_NUM_THREADS"], os.environ["OPENBLAS_NUM_THREADS"])
"""


def threads(chosen: dict[str, str]) -> str:
    program = PROGRAM % chosen
    done = subprocess.run(
        [sys.executable, "-P", "-c", program], env=child_environment(), capture_output=True, text=True, check=True
    )
    return done.stdout.splitlines()[-1]


def test_one_thread_unless_the_user_chose_otherwise() -> None:
    assert threads({}) == "1 1"
    assert threads({"OMP_NUM_THREADS": "3"}) == "3 1"
