"""The documents stay short: words of prose in docs/, without tables, code and comments (issue 21, item 8)."""

from __future__ import annotations

from pathlib import Path

DOCS = Path(__file__).parents[3] / "docs"
MOST = 25_600


def prose_words(text: str) -> int:
    """Count the words outside of fenced code, tables and HTML comments."""
    words, is_code = 0, False
    for line in text.splitlines():
        if line.lstrip().startswith("```"):
            is_code = not is_code
        elif not is_code and not line.lstrip().startswith(("|", "<!--")):
            words += len(line.split())
    return words


def test_code_and_tables_are_not_counted():
    assert prose_words("# Two words\n```\nno\n```\n| no |\n<!-- no -->\nthree more here\n") == 6


def test_the_documents_stay_short():
    pages = {page: prose_words(page.read_text(encoding="utf-8")) for page in DOCS.rglob("*.md")}
    longest = sorted(pages, key=lambda page: -pages[page])[:5]
    assert sum(pages.values()) <= MOST, {page.name: pages[page] for page in longest}
