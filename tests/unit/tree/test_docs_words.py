"""The pages of ``docs`` that people write stay below 20,000 words (issue 21, item 8)."""

from __future__ import annotations

from pathlib import Path

DOCS = Path(__file__).parents[3] / "docs"
LIMIT = 20_000
GENERATED = {"data.md", "findings.md", "first-results.md", "licences.md", "results.md"}
"""Pages that a command writes from artefacts, from the code or from installed packages. None of their words count."""
WITHOUT_TABLES = {"own-data.md", "references.md"}
"""Pages whose tables do not count: the keys of a recording come from the loader, and the corrections of the source
documents are data with one row per equation. Their prose counts."""


def count_words(text: str, with_tables: bool = True) -> int:
    """Count the words outside of fenced code and HTML comments."""
    words, is_code = 0, False
    for line in text.splitlines():
        start = line.lstrip()
        if start.startswith("```"):
            is_code = not is_code
        elif not is_code and not start.startswith("<!--") and (with_tables or not start.startswith("|")):
            words += len(line.replace("|", " ").split())
    return words


def count_page(page: Path) -> int:
    """Count the words of one page that people wrote. Tables count, except on the pages of ``WITHOUT_TABLES``."""
    if page.name in GENERATED or page.parent.name == "reference":
        return 0
    return count_words(page.read_text(encoding="utf-8"), with_tables=page.name not in WITHOUT_TABLES)


def test_code_and_comments_do_not_count():
    text = "# Two words\n```\nno\n```\n| two words |\n<!-- no -->\nthree more here\n"
    assert count_words(text) == 8
    assert count_words(text, with_tables=False) == 6


def test_generated_pages_do_not_count():
    assert count_page(DOCS / "results.md") == 0
    references = DOCS / "references.md"
    assert 0 < count_page(references) < count_words(references.read_text(encoding="utf-8")) / 4


def test_the_pages_stay_below_20_000_words():
    counts = {page.name: count_page(page) for page in DOCS.rglob("*.md")}
    assert sum(counts.values()) < LIMIT, sorted(counts.items(), key=lambda item: -item[1])[:8]
