"""Makes drawings that follow the theme of their page: matplotlib figures, equations, the chain of stages."""

from __future__ import annotations

import html
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any

# a colour that matplotlib writes out literally -> the page's variable for it
THEME: Mapping[str, str] = MappingProxyType(
    {
        "#010101": "var(--ink)",
        "#020202": "var(--muted)",
        "#030303": "var(--rule)",
        "#040404": "var(--before)",
        "#050505": "var(--after)",
        "#060606": "var(--measured)",
        "#070707": "var(--noise)",
        "#080808": "var(--held)",
        "#090909": "var(--given)",
    }
)
INK, MUTED, RULE, BEFORE, AFTER, MEASURED, NOISE, HELD, GIVEN = THEME


@contextmanager
def figure(name: str, size_in: tuple[float, float], **kwargs: Any) -> Iterator[tuple[Any, list[str]]]:
    """Yield a matplotlib figure; the list holds its SVG afterwards. ``name`` makes its ids unique on the page."""
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    out: list[str] = []
    style: dict[Any, Any] = {
        "svg.hashsalt": name,
        "svg.fonttype": "none",
        "font.family": "sans-serif",
        "font.size": 10,
        "axes.edgecolor": MUTED,
        "axes.labelcolor": INK,
        "axes.titlecolor": INK,
        "axes.titlesize": 10.5,
        "axes.titlelocation": "left",
        "axes.spines.top": False,
        "axes.spines.right": False,
        "text.color": INK,
        "xtick.color": MUTED,
        "ytick.color": MUTED,
        "grid.color": RULE,
        "grid.linewidth": 0.6,
        "axes.grid": True,
        "legend.frameon": False,
        "legend.labelcolor": INK,
        "path.simplify": True,
        "mathtext.fontset": "stix",
        "axes.formatter.useoffset": False,
        "axes.unicode_minus": True,
        **kwargs,
    }
    with mpl.rc_context(style):
        drawn = Figure(figsize=size_in)
        wide, tall = size_in
        # fixed margins: axes of all figures stand under one another, and no layout has to be solved
        drawn.subplots_adjust(0.72 / wide, 0.5 / tall, 1 - 0.22 / wide, 1 - 0.3 / tall, 0.13, 0.36)
        yield drawn, out
        FigureCanvasSVG(drawn)
        buffer = io.StringIO()
        drawn.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    out.append(themed(buffer.getvalue(), name))


def themed(svg: str, name: str) -> str:
    """Return an SVG document as an element of a page: with the page's colours, unique ids and any width."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.S)
    for colour, variable in THEME.items():
        svg = svg.replace(colour, variable)
    svg = re.sub(r' d="[^"]*"', _rounded, svg)
    svg = re.sub(r'\bid="', f'id="{name}-', svg)
    svg = re.sub(r'href="#', f'href="#{name}-', svg)
    svg = re.sub(r"url\(#", f"url(#{name}-", svg)
    return re.sub(r'^<svg([^>]*?) width="[^"]*"', r"<svg\1", re.sub(r'^(<svg[^>]*?) height="[^"]*"', r"\1", svg))


def _rounded(path: re.Match[str]) -> str:
    """Round the coordinates to a hundredth of a point."""
    return re.sub(r"-?\d+\.\d{3,}", lambda m: f"{float(m[0]):.2f}", path[0]).replace("\n", " ")


def equation(tex: str) -> str:
    """Return a typeset equation as tall as the text around it."""
    import matplotlib as mpl
    from matplotlib.font_manager import FontProperties
    from matplotlib.path import Path as Outline
    from matplotlib.textpath import TextPath

    from tools.mismatch.report.equations import mathtext, plain

    with mpl.rc_context({"mathtext.fontset": "stix"}):
        path = TextPath((0, 0), mathtext(tex), size=20, prop=FontProperties(family="STIXGeneral"))
    box = path.get_extents()
    letters = {
        Outline.MOVETO: "M",
        Outline.LINETO: "L",
        Outline.CURVE3: "Q",
        Outline.CURVE4: "C",
        Outline.CLOSEPOLY: "Z",
    }
    parts: list[str] = []
    for points, code in path.iter_segments(curves=True, simplify=False):
        flat = "" if code == Outline.CLOSEPOLY else " ".join(f"{v:.2f}" for v in points)
        parts.append(f"{letters[code]}{flat}")
    x0, y0, w, h = box.x0 - 1, box.y0 - 2, box.width + 2, box.height + 4
    label = html.escape(plain(tex))
    return (
        f'<svg class="equation" role="img" aria-label="{label}" style="width:{w * 0.85:.0f}px"'
        f' viewBox="{x0:.1f} {-y0 - h:.1f} {w:.1f} {h:.1f}"><title>{label}</title>'
        f'<path transform="scale(1,-1)" fill="var(--ink)" d="{"".join(parts)}"/></svg>'
    )


def chain(stages: Sequence[str], guilty: Mapping[str, str], ends: tuple[str, str]) -> str:
    """Draw the stages from input to output as boxes with arrows; ``guilty`` maps a stage to its fault."""
    wide, tall, gap, side, top = 128, 44, 30, 92, 10
    width = 2 * side + len(stages) * wide + (len(stages) + 1) * gap
    height = top + tall + (50 if guilty else 12)
    middle = top + tall / 2
    out = [
        f'<svg class="chain" role="img" viewBox="0 0 {width} {height}"><title>{html.escape(" > ".join(stages))}</title>'
    ]

    def text(x: float, y: float, words: str, kind: str, anchor: str = "middle") -> None:
        out.append(f'<text class="{kind}" x="{x:.0f}" y="{y:.0f}" text-anchor="{anchor}">{html.escape(words)}</text>')

    def arrow(x: float) -> None:
        out.append(f'<path class="arrow" d="M{x + 3:.0f} {middle}h{gap - 11}"/>')
        out.append(f'<path class="tip" d="M{x + gap - 9:.0f} {middle - 4}l7 4l-7 4z"/>')

    text(side, middle + 4, _short(ends[0]), "end", "end")
    arrow(side)
    x = side + gap
    for stage in stages:
        bad = guilty.get(stage)
        box, name = ("stage", "name") if bad is None else ("bad", "bad-name")
        out.append(f'<rect class="{box}" x="{x}" y="{top}" width="{wide}" height="{tall}" rx="7"/>')
        text(x + wide / 2, middle + 4, stage, name)
        if bad is not None:
            out.append(f'<path class="pointer" d="M{x + wide / 2} {top + tall + 17}v-13"/>')
            text(x + wide / 2, top + tall + 33, bad, "what")
        x += wide
        arrow(x)
        x += gap
    text(x, middle + 4, _short(ends[1]), "end", "start")
    return "".join((*out, "</svg>"))


def _short(words: str, most: int = 14) -> str:
    return words if len(words) <= most else words[: most - 1] + "…"
