"""The artefacts in docs/results: lossless in both directions, and docs/results.md is made of them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tools.errors import InputError
from tools.research.results.artefact import from_markdown, load, read_page, to_markdown, write_result
from tools.research.results.page import MISSED, insert, main, page, read_all

ROOT = Path(__file__).parents[3]
FOLDER = ROOT / "docs" / "results"
ARTEFACTS = sorted(FOLDER.glob("*.json"))
ROWS = [["a", "1.00"]]
TEXT = """# A result

Made by `micron faults --seed 4711 --out docs/results/x.json`, revision 0bc30fc8e2c910114fce865ada5130282e60edce,
2026-11-22.

- first
  line: one
- second

| what | goal \\| limit |
|---|---:|
| a | 1.00 |

<!-- wires -->
## Part

A note.
<!-- end -->
"""


def test_the_results_page_is_up_to_date():
    made = page(read_all(FOLDER))
    assert (ROOT / "docs" / "results.md").read_text(encoding="utf-8") == made, (
        "python -m tools.research.results.page --out docs/results.md"
    )


def test_no_table_of_the_results_page_is_empty():
    """Criteria are no published figures: a table of both kinds once lost all its rows."""
    lines = (ROOT / "docs" / "results.md").read_text(encoding="utf-8").splitlines()
    heads = [n for n, line in enumerate(lines) if line.startswith("|---")]
    assert heads
    assert all(n + 1 < len(lines) and lines[n + 1].startswith("|") for n in heads)


def test_the_table_of_healed_benches_is_that_of_its_artefact():
    text = (ROOT / "docs" / "circle.md").read_text(encoding="utf-8")
    assert insert(text, load(FOLDER / "heal.json")) == text, (
        "python -m tools.research.results.page docs/results/heal.json --into docs/circle.md"
    )


def test_a_head_is_written_into_its_block_alone(tmp_path: Path):
    result = from_markdown("x", TEXT)
    made = insert("before\n<!-- x -->\nold\n<!-- end -->\nafter\n<!-- end -->\n", result)
    assert made.startswith("before\n<!-- x -->\nMade by")
    assert "| a | 1.00 |" in made
    assert "old" not in made
    assert "A note" not in made
    assert made.endswith("<!-- end -->\nafter\n<!-- end -->\n")
    with pytest.raises(InputError, match="no block from '<!-- x -->'"):
        insert("nothing", result)


@pytest.mark.parametrize("path", ARTEFACTS, ids=lambda path: path.stem)
def test_an_artefact_and_its_page_are_the_same_statement(path: Path):
    result = load(path)
    assert from_markdown(path.stem, to_markdown(result)) == result
    provenance = result["provenance"]
    assert provenance["commands"]
    assert provenance["revisions"]
    assert provenance["days"]


@pytest.mark.parametrize("path", ARTEFACTS, ids=lambda path: path.stem)
def test_every_published_figure_that_is_not_met_is_on_the_page(path: Path):
    made = page([load(path)])
    tables = [b for s in load(path)["sections"] for b in s["content"] if b.get("columns", [""])[-1] == "met"]
    for row in (row for table in tables for row in table["rows"] if row[-1] == MISSED):
        assert f"| {row[0]} | {row[1]} | {row[3]} | {row[4]} |" in made


def test_provenance_lists_and_tables_are_read():
    result = from_markdown("x", TEXT)
    assert result["provenance"] == {
        "commands": ["micron faults --seed 4711 --out docs/results/x.json"],
        "revisions": ["0bc30fc8e2c910114fce865ada5130282e60edce"],
        "days": ["2026-11-22"],
        "seeds": [4711],
    }
    head, part = result["sections"]
    assert head["content"][1] == {"list": ["first line: one", "second"]}
    assert head["content"][2] == {"columns": ["what", "goal \\| limit"], "right": [False, True], "rows": ROWS}
    assert part == {"level": 2, "title": "Part", "key": "wires", "content": [{"note": "A note."}]}


def test_the_ending_of_the_name_decides_the_form(tmp_path: Path):
    write_result(tmp_path / "x.json", TEXT)
    write_result(tmp_path / "x.md", TEXT)
    assert load(tmp_path / "x.json") == from_markdown("x", TEXT)
    assert (tmp_path / "x.md").read_text() == TEXT
    assert read_page(tmp_path / "x.json") == to_markdown(from_markdown("x", TEXT))


@pytest.mark.parametrize("text", ["{", "[]", '{"format": 2, "sections": []}', "{}"])
def test_another_file_is_no_result(tmp_path: Path, text: str):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(InputError, match="no result"):
        load(tmp_path / "a.json")
    with pytest.raises(InputError, match="begins with '# '"):
        from_markdown("a", "no title")


def test_the_command_prints_one_result_or_writes_the_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    write_result(tmp_path / "x.json", TEXT)
    for arguments in ([str(tmp_path / "x.json")], ["--folder", str(tmp_path), "--out", str(tmp_path / "all.md")]):
        monkeypatch.setattr("sys.argv", ["page", *arguments])
        assert main() == 0
    assert capsys.readouterr().out.startswith("# A result")
    assert "## A result\n" in (tmp_path / "all.md").read_text()
    assert json.loads((tmp_path / "x.json").read_text())["name"] == "x"
