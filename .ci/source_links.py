"""mkdocs hook: a link from a page to a file of the source (``../hal/clock.py``) works in the site, too."""

from __future__ import annotations

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
LINK = re.compile(r"\]\(\.\./([\w/.-]+\.(?:py|toml|js))\)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Every linked source file becomes a text file of the site; a link to none stays, and strict mode names it."""
    for page in Path(config.docs_dir).glob("*.md"):
        for path in LINK.findall(page.read_text(encoding="utf-8")):
            name = f"source/{path}.txt"
            if (ROOT / path).is_file() and files.get_file_from_path(name) is None:
                files.append(File.generated(config, name, content=(ROOT / path).read_text(encoding="utf-8")))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    return LINK.sub(
        lambda m: f"](source/{m[1]}.txt)" if files.get_file_from_path(f"source/{m[1]}.txt") else m[0], markdown
    )
