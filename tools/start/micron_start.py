"""The installed scripts call this module: it and ``micron_pytest`` alone have names that nobody else has.

Other projects have folders ``tools`` and ``hal``, too. Where one of them lies before ours on the import path, ours is
put first; where one has been imported already, as in a user's tests, ours cannot be.
"""

from __future__ import annotations

import sys
from importlib.machinery import PathFinder
from pathlib import Path

PACKAGES = ("hal", "drivers", "sim_devices", "firmware_py", "tools", "benches")


def our_root() -> Path:
    """The folder that holds our packages: the source tree, or where the package was installed."""
    return next(folder for folder in Path(__file__).resolve().parents if (folder / "hal" / "children.py").exists())


def put_ours_first() -> None:
    """Make ``import tools`` and its like find ours. Raises ``ImportError`` where another has been imported."""
    root = our_root()
    for name in PACKAGES:
        known = sys.modules.get(name)
        if known is not None and root / name not in map(Path, known.__path__):
            raise ImportError(
                f"{next(iter(known.__path__))}: this package has the name of one of micron-bench and was imported "
                "before it; rename it, or start the emulated devices apart (micron emulate)"
            )
    specs = map(PathFinder.find_spec, PACKAGES)
    if any(spec is None or Path(str(spec.origin)).parent.parent != root for spec in specs):
        sys.path.insert(0, str(root))


def main() -> None:
    """The script ``micron``."""
    put_ours_first()
    from tools.cli.main import main as run

    run()
