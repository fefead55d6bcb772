"""The page: self-contained, well formed, complete, the same every time."""

import re
from dataclasses import replace
from html.parser import HTMLParser

import pytest

from tests.unit.mismatch_report.canned import all_verdicts, creep, missing_physics
from tools.mismatch.report.page import html_page
from tools.mismatch.report.svg import THEME, chain, equation

VOID = {"meta", "br", "img", "link", "hr", "input"}


class Reader(HTMLParser):
    """Balanced tags, ids, outside references, and the text that is seen."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.outside: list[str] = []
        self.text: list[str] = []
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list) -> None:
        if tag not in VOID:
            self.open.append(tag)
        for key, value in attrs:
            if key == "id":
                self.ids.append(value)
            elif key in ("src", "href", "xlink:href") and not value.startswith(("#", "data:")):
                self.outside.append(value)

    def handle_startendtag(self, tag: str, attrs: list) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        # table cells and rows are closed explicitly on this page
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not self.open or self.open[-1] != "style":
            self.text.append(data)

    @property
    def seen(self) -> str:
        return re.sub(r"\s+", " ", " ".join(self.text))


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    return {v: html_page(r) for v, r in all_verdicts().items()}


@pytest.mark.parametrize("verdict", ["agrees", "recalibrate", "missing_physics", "unexplained"])
def test_the_page_stands_alone(pages: dict[str, str], verdict: str):
    reader = Reader(pages[verdict])
    assert reader.open == []
    assert reader.outside == []
    assert "@import" not in pages[verdict]
    assert not re.search(r"url\((?!#)", pages[verdict])
    assert "<script" not in pages[verdict]
    assert len(reader.ids) == len(set(reader.ids)), "ids collide between figures"
    for target in re.findall(r'(?:href="#|url\(#)([^")]+)', pages[verdict]):
        assert target in reader.ids
    assert len(pages[verdict]) < 1_500_000


def test_everything_is_on_the_page(pages: dict[str, str]):
    seen = Reader(pages["missing_physics"]).seen
    for said in (
        "Missing physics",
        "0.41 falls to 0.023 um.",
        "command: recent history",
        "83 %",
        "Slow relaxation after a change of input, about logarithmic in time.",
        "fraction per decade",
        "0.0190 to 0.0236",
        "K. Kuhnen, 2003 <eq. 6> & others",
        "At the limit of what is searched:",
        "the whole recording",
        "held-out data where the recalibrated twin is worst",
        "residual: measured minus simulated",
        "against command less its recent mean: 83 %",
        "spectrum of the residual",
        "autocorrelation of the residual",
        "white: 95 % band",
        "gain_um_per_V",
        "leaves 8.3 times the residual of creep",
        "cannot tell creep from ac coupling",
        "Two steps of opposite sign",
        "exact limits in 12 samples",
        "2 to 3 s, 4 to 5 s",
        "resonance",
    ):
        assert said in seen, said


def test_the_guilty_stage_is_marked(pages: dict[str, str]):
    assert pages["missing_physics"].count('class="bad"') == 1
    assert re.search(r'class="bad-name"[^>]*>actuator<', pages["missing_physics"])
    assert re.search(r'class="what"[^>]*>creep<', pages["missing_physics"])
    assert re.search(r'class="bad-name"[^>]*>mechanics<', pages["unexplained"])
    assert re.search(r'class="what"[^>]*>unexplained<', pages["unexplained"])
    assert 'class="bad"' not in pages["agrees"]


def test_figures_take_the_theme_of_the_page(pages: dict[str, str]):
    for colour in THEME:
        assert colour not in pages["missing_physics"]
    figures = re.findall(r'<div class="plot">(.*?)</div>', pages["missing_physics"], flags=re.S)
    assert len(figures) == 5
    for figure in figures:
        assert not re.findall(r"(?:fill|stroke): #(?!ffffff)[0-9a-f]{6}", figure), (
            "a colour that dark mode cannot change"
        )


def test_the_same_report_makes_the_same_page(pages: dict[str, str]):
    assert html_page(missing_physics()) == pages["missing_physics"]


def test_names_from_outside_are_text():
    r = replace(
        missing_physics(),
        recording="/data/<script>alert(1)</script>/recording.toml",
        summary="Left in <b>a</b>.",
        physics=(replace(creep(), source="<img src=x>", note="<i>"),),
        pictures=None,
    )
    page = html_page(r)
    assert "<script" not in page
    assert "<img" not in page
    assert "Left in <b>a</b>." in Reader(page).seen


def test_without_pictures_the_words_stay():
    page = html_page(replace(missing_physics(), pictures=None))
    assert '<div class="plot">' not in page
    assert "fraction per decade" in Reader(page).seen


def test_a_hopeless_twin_does_not_hide_the_other_bars():
    fit = replace(missing_physics().fit, base_rms={"displacement": 1e9})
    page = html_page(replace(missing_physics(), fit=fit, pictures=None))
    assert "(off the scale)" in page
    widths = [float(w) for w in re.findall(r'<i style="width:([\d.]+)%"', page)]
    assert widths[0] == 100.0
    assert widths[1] == pytest.approx(25.0)


def test_an_equation_is_drawn_with_its_text_beside():
    drawn = equation(r"\tau \dot y + y = x")
    assert 'aria-label="τ y\u0307 + y = x"' in drawn
    assert len(re.findall("[MLQCZ]", re.search(r' d="([^"]*)"', drawn)[1])) > 50


def test_a_chain_names_its_ends_shortly():
    drawn = chain(("sensor",), {}, ("specific_force_x_long", "V"))
    assert "specific_forc…" in drawn
    assert drawn.count("<rect") == 1
