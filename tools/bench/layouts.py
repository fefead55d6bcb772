"""Named layouts of the page (view, channels, traces, trigger), kept as files beside the bench file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.routing import BaseRoute, Route

from tools.bench.recorder import is_own_file
from tools.bench.requests import body, clear, text
from tools.errors import InputError
from tools.output import write_text_atomic

SUFFIX = ".layout.json"
KIND = "micron bench layout"
FORMAT = 1
MOST_BYTES = 65_536
MOST_LAYOUTS = 200
_FORBIDDEN = frozenset('/\\:*?"<>|')


def checked_layout(value: Any) -> dict[str, Any]:
    """Return the layout in ``value`` without keys that no page writes. ``InputError`` says what is wrong with it."""
    if not isinstance(value, dict) or value.get("kind") != KIND:
        raise InputError("this is not a layout of the bench page: the page writes one with 'To a file'")
    if value.get("format") != FORMAT:
        raise InputError(f"this layout has format {value.get('format')!r}; this page reads format {FORMAT}")
    view, settings = value.get("view"), value.get("settings")
    if not isinstance(view, str) or not isinstance(settings, dict):
        raise InputError("this layout has no view or no settings; save it again")
    if not all(isinstance(part, dict) for part in settings.values()):
        raise InputError("the settings of a view in this layout are not an object; save it again")
    return {"kind": KIND, "format": FORMAT, "view": view, "settings": settings}


def checked_name(name: str) -> str:
    """Return the name of a layout, which becomes a file name. ``InputError`` says what is allowed."""
    name = name.strip()
    if not name or len(name) > 80 or name.startswith(".") or not name.isprintable() or _FORBIDDEN & set(name):
        raise InputError(f'{name!r} is not a name for a layout: 1 to 80 characters, none of / \\ : * ? " < > |')
    return name


class Layouts:
    """Keeps layouts in ``folder``, one file each. The first layout makes the folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def path(self, name: str) -> Path:
        return self.folder / (checked_name(name) + SUFFIX)

    def list(self) -> list[str]:
        """Return the names, in alphabetical order."""
        files = (p for p in self.folder.glob(f"*{SUFFIX}") if is_own_file(p))
        return sorted((p.name.removesuffix(SUFFIX) for p in files), key=str.lower)[:MOST_LAYOUTS]

    def read(self, name: str) -> dict[str, Any]:
        """Return one layout. ``InputError`` when there is none of that name, or the file holds something else."""
        path = self.path(name)
        if not is_own_file(path):
            raise InputError(f"there is no layout {name!r} in {self.folder}")
        try:
            if path.stat().st_size > MOST_BYTES:
                raise InputError(f"{path} is larger than {MOST_BYTES} bytes: it is not a layout")
            return checked_layout(json.loads(path.read_text(encoding="utf-8")))
        except (ValueError, OSError, RecursionError) as error:
            raise InputError(f"{path} cannot be read as a layout ({error})") from error

    def save(self, name: str, layout: Any) -> str:
        """Write a layout, also over one of the same name. ``InputError`` or ``OutputError`` when that cannot be."""
        path = self.path(name)
        if path.is_symlink():
            raise InputError(f"{path} is a symbolic link; choose another name")
        content = json.dumps(checked_layout(layout), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
        try:
            self.folder.mkdir(exist_ok=True)
        except OSError as error:
            raise InputError(
                f"{self.folder} cannot be made ({error.strerror}); use 'To a file' to keep the layout elsewhere"
            ) from error
        write_text_atomic(path, content)
        return path.name.removesuffix(SUFFIX)

    def delete(self, name: str) -> None:
        """Remove a layout. ``InputError`` when there is none of that name."""
        if not is_own_file(self.path(name)):
            raise InputError(f"there is no layout {name!r} in {self.folder}")
        self.path(name).unlink()


def layout_routes(layouts: Layouts) -> list[BaseRoute]:
    async def names(_: Request) -> Any:
        return {"layouts": layouts.list(), "folder": str(layouts.folder)}

    async def read(request: Request) -> Any:
        return layouts.read(request.path_params["name"])

    async def save(request: Request) -> Any:
        table = await body(request)
        return {"name": layouts.save(text(table, "name", longest=200), table.get("layout"))}

    async def delete(request: Request) -> Any:
        layouts.delete(request.path_params["name"])

    return [
        Route("/api/layouts", clear(names)),
        Route("/api/layouts", clear(save), methods=["POST"]),
        Route("/api/layouts/{name}", clear(read)),
        Route("/api/layouts/{name}/delete", clear(delete), methods=["POST"]),
    ]
