"""Downloads files with a checksum: the cache holds a file whole and as listed, or not at all."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tools.data.registry import PublicFile, PublicSet
from tools.errors import InputError

SECONDS = 30.0
"""Longest silence of a server."""
_PART_BYTES = 1 << 20


@dataclass(frozen=True)
class Missing:
    """Describes a missing file: its source, its place in the cache, and the cause."""

    url: str
    path: Path
    why: str


def digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    found = hashlib.sha256()
    with path.open("rb") as file:
        while part := file.read(_PART_BYTES):
            found.update(part)
    return found.hexdigest()


def is_whole(path: Path, file: PublicFile) -> bool:
    """Return whether the file is there with the size and the checksum of the list."""
    return path.is_file() and path.stat().st_size == file.bytes and digest(path) == file.sha256


def fetch(
    wanted: PublicSet, cache: Path, mirror: str = "", say: Callable[[str], None] = lambda _: None
) -> tuple[list[Path], list[Missing]]:
    """Bring the files of a set into ``cache/NAME`` where they are not there already.

    Returns those that are there now, and those that could not be had. ``say`` is told of every download. Raises
    InputError without pooch, or where the cache cannot be written.
    """
    folder = cache / wanted.name
    present: list[Path] = []
    missing: list[Missing] = []
    for file in wanted.files:
        path = folder / file.name
        if is_whole(path, file):
            present.append(path)
            continue
        url = wanted.url(file, mirror)
        # after one file could not be reached the others are not tried: each would wait as long
        why = missing[-1].why if missing and missing[-1].why.startswith(_NO_WAY) else ""
        if not why:
            say(f"{url} ({file.bytes / 1e6:.1f} MB)")
            why = _download(url, path, file)
        if why:
            missing.append(Missing(url, path, why))
        else:
            present.append(path)
    return present, missing


_NO_WAY = "no way to the server"


def _download(url: str, path: Path, file: PublicFile) -> str:
    """Download one file; return why that failed, or nothing."""
    try:
        import pooch
        import requests
    except ImportError as error:
        raise InputError("micron data fetch needs pooch; install it with: pip install 'micron-bench[data]'") from error
    pooch.get_logger().setLevel(logging.WARNING)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        downloader: Any = pooch.HTTPDownloader(timeout=SECONDS)
        pooch.retrieve(url, f"sha256:{file.sha256}", path.name, path.parent, downloader=downloader)
    except requests.exceptions.HTTPError as error:
        return f"the server answers {getattr(error.response, 'status_code', 'with an error')}"
    except (requests.exceptions.ConnectionError, requests.exceptions.Timeout) as error:
        return f"{_NO_WAY} ({type(error).__name__})"
    except ValueError:
        return "what the server sends has another checksum; nothing of it was kept"
    except requests.exceptions.RequestException as error:
        return f"the download failed ({type(error).__name__})"
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror or error}); set MICRON_DATA to a folder that you may write to"
        ) from error
    return ""
