"""The list of public recordings: ``public.toml`` beside this file."""

from __future__ import annotations

import os
import tomllib
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from urllib.parse import quote

from tools.errors import InputError

LIST = Path(__file__).with_name("public.toml")
HOST = "https://raw.githubusercontent.com"


@dataclass(frozen=True)
class PublicFile:
    """Describes one file of a set: its ``path`` in the repository and the ``sha256`` of the file at the set's
    commit."""

    path: str
    bytes: int
    sha256: str

    @property
    def name(self) -> str:
        """Return its name in the cache."""
        return PurePosixPath(self.path).name


@dataclass(frozen=True)
class PublicSet:
    """Recordings of one origin, as a public repository holds them at one commit."""

    name: str
    title: str
    licence: str
    citation: str
    repository: str
    commit: str
    files: tuple[PublicFile, ...]

    @property
    def bytes(self) -> int:
        """Return the size of all files, in bytes."""
        return sum(file.bytes for file in self.files)

    def url(self, file: PublicFile, mirror: str = "") -> str:
        """Return where a file is: in its repository, or on a mirror as ``MIRROR/NAME/FILE``."""
        if mirror:
            return f"{mirror.rstrip('/')}/{quote(self.name)}/{quote(file.name)}"
        return f"{HOST}/{self.repository}/{self.commit}/{quote(file.path)}"


def public_sets(path: Path = LIST) -> dict[str, PublicSet]:
    """Return all sets by name."""
    found: dict[str, PublicSet] = {}
    for name, entry in tomllib.loads(path.read_text(encoding="utf-8")).items():
        files = tuple(PublicFile(**file) for file in entry.pop("files"))
        found[name] = PublicSet(name=name, files=files, **entry)
    return found


def named(names: list[str], path: Path = LIST) -> list[PublicSet]:
    """Return the sets of these names. Raises InputError for a name that is not listed."""
    known = public_sets(path)
    for name in names:
        if name not in known:
            raise InputError(f"no public recording is called '{name}'; there are: {', '.join(known)}")
    return [known[name] for name in dict.fromkeys(names)]


def cache_folder() -> Path:
    """Return where files are kept: ``MICRON_DATA``, else the user's cache folder (XDG)."""
    if own := os.environ.get("MICRON_DATA"):
        return Path(own)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "micron-bench" / "data"
