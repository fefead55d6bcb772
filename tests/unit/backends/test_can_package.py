"""python-can is imported without what it would bring along."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import sys
from drivers.dbc import load_database
load_database()
from hal.backends.python_can import open_virtual
assert "can" in sys.modules and "asammdf" not in sys.modules and "pandas" not in sys.modules
import asammdf
assert asammdf.MDF
"""


def test_the_frames_table_and_a_bus_bring_no_pandas_and_asammdf_stays_importable() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
