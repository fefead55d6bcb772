"""The user's decisions about what other people's folders may do here: run a program, name a file outside the folder.

A folder that somebody else wrote may name a program (an FMU, a Python twin, an emulation provider, a plug-in). Nothing
of it runs before the user has decided so. A decision about a file holds for its content, a decision about an installed
package for its name and place; both are kept in a file of the user. ``docs/security.md`` says how to decide.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from hal.children import ROOT
from hal.errors import BenchError

OURS = ("hal", "drivers", "firmware_py", "sim_devices", "tools")
OUR_FOLDERS = ("benches", "examples", "tests")
"""Folders of a source tree whose files came with the program itself."""

Act = Literal["run", "name"]
"""Action that a decision allows: a program may run, or a file may be named from outside its folder."""


class NotTrusted(BenchError):
    """Something needs a decision of the user first. ``subject`` is what ``micron trust`` takes, ``option`` the option
    by which a command decides on its own.
    """

    def __init__(self, message: str, subject: Path, option: str) -> None:
        super().__init__(message)
        self.subject = subject
        self.option = option


@dataclass(frozen=True)
class Decision:
    """Holds a line of the user's file. ``key`` is a digest (``run``) or a path (``name``), ``label`` is for people."""

    act: Act
    key: str
    label: str
    day: str


def decisions_file() -> Path:
    """Return the file of decisions, in the state folder of the user (XDG)."""
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "micron-bench" / "trust.jsonl"


def decisions() -> Iterator[Decision]:
    """Yield every decision on file. A line that cannot be read decides nothing."""
    try:
        lines = decisions_file().read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return
    for line in lines:
        try:
            entry = json.loads(line)
            yield Decision(entry["act"], entry["key"], entry["label"], entry["day"])
        except (ValueError, KeyError, TypeError):
            continue


def is_decided(act: Act, key: str) -> bool:
    """Return whether the user has allowed this."""
    return any(d.act == act and d.key == key for d in decisions())


def decide(act: Act, key: str, label: str) -> None:
    """Put a decision on file. ``BenchError`` when the file cannot be written."""
    if is_decided(act, key):
        return
    file = decisions_file()
    line = json.dumps({"act": act, "key": key, "label": label, "day": time.strftime("%Y-%m-%d")})
    try:
        file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        handle = os.open(file, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        with os.fdopen(handle, "a", encoding="utf-8") as out:
            out.write(line + "\n")
    except OSError as error:
        raise BenchError(f"{file}: the decision cannot be kept ({error.strerror}); set XDG_STATE_HOME") from error


def forget_all() -> int:
    """Drop every decision and return how many there were."""
    count = sum(1 for _ in decisions())
    decisions_file().unlink(missing_ok=True)
    return count


def is_ours(path: Path) -> bool:
    """Return whether ``path`` came with this program: an example, a bench or a test of a source tree."""
    is_tree = (ROOT / "pyproject.toml").exists()
    return is_tree and any(path.resolve().is_relative_to(ROOT / folder) for folder in OUR_FOLDERS)


def digest_of(data: bytes) -> str:
    """Return the key of a program by its content."""
    return hashlib.sha256(data).hexdigest()


def trust_program(path: Path) -> None:
    """Record that this file may run: the user's decision, or a program that this one has just written."""
    decide("run", digest_of(path.read_bytes()), str(path.resolve()))


def trusted_program(path: Path, named_by: Path) -> bytes:
    """Return the content of a program that may run. ``NotTrusted`` when that is not decided; ``OSError`` unread.

    What runs must be these bytes, not what the file holds later.
    """
    data = path.read_bytes()
    if not is_ours(path) and not is_decided("run", digest_of(data)):
        raise NotTrusted(
            f"{named_by}: names the program {path}, which nobody here has trusted yet; nothing of it was run",
            named_by,
            "--trust",
        )
    return data


def package_of(target: str) -> tuple[str, Path | None]:
    """Return the key of the package behind ``module:object``, and where it is. Nothing is imported."""
    top = target.partition(":")[0].partition(".")[0]
    try:
        spec = importlib.util.find_spec(top) if top else None
    except (ImportError, ValueError):
        spec = None
    place = None if spec is None else spec.origin or next(iter(spec.submodule_search_locations or ()), None)
    return f"package {top} at {place}", None if place is None else Path(place)


def trust_package(target: str) -> None:
    """Record that the installed package behind ``module:object`` may run here."""
    key, _ = package_of(target)
    decide("run", key, target)


def is_our_package(target: str) -> bool:
    """Return whether ``module:object`` came with this program, or there is no such package."""
    _, place = package_of(target)
    if place is None:
        return True
    top = target.partition(":")[0].partition(".")[0]
    return (top in OURS and place.resolve().is_relative_to(ROOT)) or is_ours(place)


def is_trusted_package(target: str) -> bool:
    """Return whether ``module:object`` is ours or may run."""
    return is_our_package(target) or is_decided("run", package_of(target)[0])


def require_package(target: str, named_by: Path) -> None:
    """Raise ``NotTrusted`` unless the package behind ``module:object`` may run."""
    if not is_trusted_package(target):
        raise NotTrusted(
            f"{named_by}: names '{target}', code of a package that nobody here has trusted yet; nothing of it was run",
            named_by,
            "--trust",
        )


def allow_name(path: Path) -> None:
    """Record that this file may be named by descriptions that lie in other folders."""
    decide("name", str(path.resolve()), str(path.resolve()))


def path_inside(named_by: Path, name: str) -> Path:
    """Return the file that a description names, relative to the folder of the description.

    ``NotTrusted`` when it lies outside that folder (by ``..``, as an absolute path, or behind a link), unless it came
    with this program or the user has allowed it.
    """
    if "\0" in name:
        raise BenchError(f"{named_by}: {name!r} is no path; name a file")
    folder = named_by.resolve().parent
    path = (folder / name).resolve()
    if path.is_relative_to(folder) or is_ours(path) or is_decided("name", str(path)):
        return path
    raise NotTrusted(
        f"{named_by}: names '{name}', which lies outside its folder ({path}); nothing was read there",
        named_by,
        "--allow-outside",
    )
