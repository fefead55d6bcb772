"""Find the programs and outside files that a folder, recording, twin file or bench names. None of them is run."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from hal import plugins
from hal.bench import BenchDescription, named_files, named_packages
from hal.errors import BenchError
from hal.trust import (
    allow_name,
    digest_of,
    is_decided,
    is_our_package,
    is_ours,
    is_trusted_package,
    package_of,
    trust_package,
    trust_program,
)
from hal.validation import validate_table
from tools.errors import InputError

MOST_FILES = 1000


@dataclass(frozen=True)
class Program:
    """Describes a program that ``named_by`` names: a ``file``, or the object ``target`` of an installed package."""

    named_by: Path
    file: Path | None = None
    target: str = ""

    def __str__(self) -> str:
        return str(self.file) if self.file is not None else f"package code {self.target}"

    @property
    def is_ours(self) -> bool:
        """True for installed code that came with this program, about which there is nothing to decide."""
        return bool(self.target) and package_of(self.target)[1] is not None and is_our_package(self.target)

    @property
    def is_trusted(self) -> bool:
        """True when the user has let it run already."""
        if self.file is None:
            return is_trusted_package(self.target)
        return is_ours(self.file) or is_decided("run", digest_of(self.file.read_bytes()))

    def trust(self) -> None:
        """Record the user's decision that it may run."""
        if self.file is None:
            trust_package(self.target)
        else:
            trust_program(self.file)


@dataclass(frozen=True)
class OutsideFile:
    """Describes a file that ``named_by`` names and that lies outside its folder."""

    named_by: Path
    file: Path

    def __str__(self) -> str:
        return str(self.file)

    @property
    def is_trusted(self) -> bool:
        """True when the user has let it be named already."""
        return is_ours(self.file) or is_decided("name", str(self.file))

    def trust(self) -> None:
        """Record the user's decision that it may be named."""
        allow_name(self.file)


Named = Program | OutsideFile


def named_in(path: Path) -> list[Named]:
    """Return what ``path`` names, each once: a program (.py, .fmu), a recording, a twin file, a bench, or a folder.

    Raises InputError when there is nothing at ``path``. What cannot be read is left to the command that uses it.
    """
    if not path.exists():
        raise InputError(f"{path}: there is no such file or folder; name a recording, twin, bench, .py or .fmu")
    found: dict[str, Named] = {}
    seen: set[Path] = set()
    todo = [path]
    while todo:
        at = todo.pop(0)
        if at.resolve() in seen or len(seen) > MOST_FILES:
            continue
        seen.add(at.resolve())
        if at.is_dir():
            own = at / "recording.toml"
            todo += [own] if own.is_file() else sorted(at.rglob("*.toml"))[:MOST_FILES]
        elif at.suffix.lower() in (".py", ".fmu"):
            found.setdefault(str(at.resolve()), Program(at, at))
        elif at.suffix.lower() == ".toml":
            for item in _named_by(at):
                found.setdefault(f"{type(item).__name__} {item}", item)
                file = item.file
                # a further description may name programs of its own
                if file is not None and file.suffix == ".toml" and isinstance(item, OutsideFile):
                    todo.append(file)
            todo += _descriptions(at)
    return list(found.values())


def _table(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError):
        return {}


def _twin(path: Path, table: Mapping[str, Any]) -> dict[str, Any]:
    twin = table.get("twin")
    return cast(dict[str, Any], twin) if isinstance(twin, dict) else {}


def _texts(*values: object) -> Iterator[str]:
    for value in values:
        if isinstance(value, str) and value and "\0" not in value:
            yield value


def _files(path: Path, table: Mapping[str, Any]) -> list[str]:
    """Return the files that a description names, programs too."""
    twin = _twin(path, table)
    numbers = twin.get("parameters")
    inside: dict[str, Any] = cast(dict[str, Any], numbers) if isinstance(numbers, dict) else {}
    split = table.get("split")
    parts: dict[str, Any] = cast(dict[str, Any], split) if isinstance(split, dict) else {}
    function = str(twin.get("function", inside.get("function", ""))).rpartition(":")[0]
    kind = twin.get("kind")
    own = [inside.get("path") if kind == "fmu" else None, inside.get("bench") if kind == "instrument" else None]
    later = (v for v in parts.values() if isinstance(v, str))
    data = table.get("data") if "channels" in table else None
    bench = _bench(path, table)
    return [*_texts(data, twin.get("file"), function, *own, *later), *(named_files(bench) if bench else ())]


def _bench(path: Path, table: Mapping[str, Any]) -> BenchDescription | None:
    if "channels" in table or "twin" in table or not {"bus", "device", "emulation"} & set(table):
        return None
    try:
        return validate_table(BenchDescription, dict(table), str(path))
    except BenchError:
        return None


def _descriptions(path: Path) -> list[Path]:
    """Return the further descriptions that one names: twin files, splits, the bench of an instrument twin."""
    names = [name for name in _files(path, _table(path)) if name.endswith(".toml")]
    return [p for name in names if (p := path.parent / name).is_file()]


def _named_by(path: Path) -> Iterator[Named]:
    table = _table(path)
    folder = path.resolve().parent
    for name in _files(path, table):
        file = (folder / name).resolve()
        if not file.is_relative_to(folder):
            yield OutsideFile(path, file)
        if file.suffix.lower() in (".py", ".fmu") and file.is_file():
            yield Program(path, file)
    kind = _twin(path, table).get("kind")
    entry = plugins.find_entry(plugins.TWINS, kind) if isinstance(kind, str) else None
    targets = [entry.value] if entry is not None else []
    bench = _bench(path, table)
    for target in [*targets, *(named_packages(bench) if bench else ())]:
        yield Program(path, target=target)
