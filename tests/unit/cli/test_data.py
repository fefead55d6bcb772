"""``micron data`` and a local server: fetched files are whole and as listed; without one, a message says what to do."""

from __future__ import annotations

import hashlib
import json
import re
import socket
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from typer.testing import Result

from tests.command import micron
from tools.data import registry
from tools.data.registry import public_sets
from tools.research.reports.data_page import PAGE, page

CONTENT = {"a.csv": b"t,x\n1,2\n", "b with blanks.mat": b"MATLAB" * 1000}
LIST = """
[rig]
title = "a rig"
licence = "MIT"
citation = "Somebody, 2020"
repository = "somebody/rig"
commit = "0123abc"
files = [
{files}
]
"""


class Quiet(SimpleHTTPRequestHandler):
    asked: list[str]

    def __init__(self, *arguments: Any, asked: list[str], **options: Any) -> None:
        self.asked = asked
        super().__init__(*arguments, **options)

    def do_GET(self) -> None:
        self.asked.append(self.path)
        super().do_GET()

    def log_message(self, format: str, *args: Any) -> None:
        pass


@pytest.fixture
def asked() -> list[str]:
    return []


@pytest.fixture
def server(tmp_path: Path, asked: list[str]) -> Iterator[str]:
    """A mirror on this machine that serves the files of the set ``rig``."""
    folder = tmp_path / "served" / "rig"
    folder.mkdir(parents=True)
    for name, content in CONTENT.items():
        (folder / name).write_bytes(content)
    handler = partial(Quiet, directory=str(folder.parent), asked=asked)
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as served:
        thread = threading.Thread(target=served.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{served.server_port}"
        served.shutdown()
        thread.join()


@pytest.fixture(autouse=True)
def listed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A list of one set; the cache is an empty folder."""
    files = ",\n".join(
        f'{{ path = "some/{name}", bytes = {len(content)}, sha256 = "{hashlib.sha256(content).hexdigest()}" }}'
        for name, content in CONTENT.items()
    )
    path = tmp_path / "public.toml"
    path.write_text(LIST.replace("{files}", files))
    for function in (registry.public_sets, registry.named):
        monkeypatch.setattr(function, "__defaults__", (path,))
    monkeypatch.setenv("MICRON_DATA", str(tmp_path / "cache"))
    return tmp_path / "cache"


def call(*words: str) -> Result:
    return micron("data", *words)


def test_what_is_fetched_is_whole_and_not_fetched_again(server: str, listed: Path, asked: list[str]):
    done = call("fetch", "rig", "--mirror", server)
    assert done.exit_code == 0, done.output
    for name, content in CONTENT.items():
        assert (listed / "rig" / name).read_bytes() == content
        assert str(listed / "rig" / name) in done.stdout
    assert asked == ["/rig/a.csv", "/rig/b%20with%20blanks.mat"]
    assert "cite: Somebody, 2020" in done.stderr
    assert call("fetch", "rig", "--mirror", server).exit_code == 0
    assert len(asked) == 2
    (listed / "rig" / "a.csv").write_bytes(b"damaged")
    assert call("fetch", "rig", "--mirror", server).exit_code == 0
    assert (listed / "rig" / "a.csv").read_bytes() == CONTENT["a.csv"]
    assert asked[2:] == ["/rig/a.csv"]


def test_another_file_at_its_place_is_not_kept(server: str, listed: Path, tmp_path: Path):
    (tmp_path / "served" / "rig" / "a.csv").write_bytes(b"t,x\n1,3\n")
    done = call("fetch", "rig", "--mirror", server)
    assert done.exit_code == 1
    assert "another checksum; nothing of it was kept" in done.stderr
    assert [p.name for p in (listed / "rig").iterdir()] == ["b with blanks.mat"]


def test_a_file_that_the_server_lacks(server: str, tmp_path: Path):
    (tmp_path / "served" / "rig" / "a.csv").unlink()
    done = call("fetch", "rig", "--mirror", server)
    assert done.exit_code == 1
    assert "the server answers 404" in done.stderr


def test_without_a_network_one_message_says_which_file_to_put_where(listed: Path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        mirror = f"http://127.0.0.1:{free.getsockname()[1]}"
    done = call("fetch", "rig", "--mirror", mirror)
    assert done.exit_code == 1
    said = done.stderr.replace("\n", " ")
    assert said.count("micron: ") == 1
    for name in ("a.csv", "b%20with%20blanks.mat"):
        assert f"{mirror}/rig/{name}" in said
    for name, content in CONTENT.items():
        assert f"as {listed / 'rig' / name}" in said
        (listed / "rig" / name).write_bytes(content)
    assert call("fetch", "rig", "--mirror", mirror).exit_code == 0, "what was put there is taken"


def test_the_list_says_what_is_here(listed: Path, tmp_path: Path):
    (listed / "rig").mkdir(parents=True)
    (listed / "rig" / "a.csv").write_bytes(CONTENT["a.csv"])
    done = call("list", "--json", str(tmp_path / "list.json"))
    assert done.exit_code == 0, done.output
    assert "1/2" in done.stdout
    assert "MIT" in done.stdout
    (found,) = json.loads((tmp_path / "list.json").read_text())["sets"]
    assert (found["name"], found["files_here"], found["citation"]) == ("rig", 1, "Somebody, 2020")
    assert found["files"][1]["url"] == (
        "https://raw.githubusercontent.com/somebody/rig/0123abc/some/b%20with%20blanks.mat"
    )


def test_names_that_are_not_listed_and_places_that_are_none(server: str):
    for words in (("fetch", "rigg"), ("fetch", "rig", "--mirror", "ftp://x")):
        done = call(*words)
        assert done.exit_code == 2
        assert done.stderr.startswith("micron: ")


def test_the_shipped_list_is_whole():
    sets = public_sets(registry.LIST)
    assert {"emps", "silverbox", "broad", "f16_gvt", "bouc_wen", "cascaded_tanks", "wiener_hammerstein"} <= set(sets)
    for found in sets.values():
        assert found.licence
        assert found.citation
        assert re.fullmatch(r"[0-9a-f]{40}", found.commit)
        assert len({f.name for f in found.files}) == len(found.files) > 0
        for file in found.files:
            assert re.fullmatch(r"[0-9a-f]{64}", file.sha256)
            assert file.bytes > 0


def test_the_page_is_current(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(registry.public_sets, "__defaults__", (registry.LIST,))
    root = Path(__file__).parents[3]
    assert (root / PAGE).read_text(encoding="utf-8") == page(), "its head names the command"
