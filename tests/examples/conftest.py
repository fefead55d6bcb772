"""Each folder here is somebody's package; its tests run as if it were installed beside this one."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

import pytest


def describe(folder: Path, into: Path) -> Path:
    """Write the metadata that ``pip install -e .`` makes in ``folder``, and return where they are."""
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    name, version = project["name"].replace("-", "_"), project["version"]
    info = into / "installed" / f"{name}-{version}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {version}\n")
    groups = project["entry-points"].items()
    lines = [f"[{group}]\n" + "\n".join(f"{k} = {v}" for k, v in entries.items()) for group, entries in groups]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
    return info.parent


def install(folder: Path, into: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Modules and entry points are found, as after ``pip install -e .``."""
    monkeypatch.syspath_prepend(str(describe(folder, into)))
    monkeypatch.syspath_prepend(str(folder))


@pytest.fixture(autouse=True)
def installed(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The package that a test stands in, installed."""
    folder = request.path.parent
    if not (folder / "pyproject.toml").exists():  # nothing to install
        yield folder
        return
    install(folder, tmp_path, monkeypatch)
    yield folder
    for module in folder.glob("*.py"):
        sys.modules.pop(module.stem, None)
