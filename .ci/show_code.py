"""Puts the code of named files into the pages: ``python .ci/show_code.py``. A test asks that nothing would change.

A fenced block below a comment ``<!-- file: PATH -->`` (from the project's folder) shows that file, so that a plain git
host shows it, too.
"""

from __future__ import annotations

import re
from pathlib import Path
from textwrap import indent

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"^( *)<!-- file: (\S+) -->\n( *```[^\n]*)\n.*?^ *```$", re.MULTILINE | re.DOTALL)


def with_code(text: str) -> str:
    """Return a page's text with every shown file as it is now. Raises ``OSError`` when one is missing."""

    def block(match: re.Match[str]) -> str:
        code = (ROOT / match[2]).read_text(encoding="utf-8").rstrip("\n")
        return f"{match[1]}<!-- file: {match[2]} -->\n{match[3]}\n{indent(code, match[1])}\n{match[1]}```"

    return BLOCK.sub(block, text)


if __name__ == "__main__":
    for page in (ROOT / "docs").rglob("*.md"):
        page.write_text(with_code(page.read_text(encoding="utf-8")), encoding="utf-8")
