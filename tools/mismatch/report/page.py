"""Renders a report as a self-contained HTML page: everything inline, nothing fetched, readable in light and dark."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from sim_devices.physics.catalogue import EFFECTS
from tools.mismatch.engine.report import PhysicsFound, Report
from tools.mismatch.report import figures, series, svg, wording
from tools.mismatch.report import together as words_together
from tools.mismatch.report.equations import plain
from tools.mismatch.report.next_experiment import next_experiments
from tools.mismatch.report.wording import number, percent, words

BASE_EQUATIONS: Mapping[str, str] = MappingProxyType(
    {
        "piezo_stack": r"z = g\,u + z_0",
        "accelerometer": r"V_i = b_i + s_i f_i",
        "magnetometer": r"V_i = b_i + s_i B_i",
        "accelerometer_cluster": r"a = e \cdot (f + \alpha \times r)",
        "mechanical_axis": r"m\ddot x + c\dot x + k x = F + F_0",
        "state_space": r"\dot x = A x + B u,\quad y = C x + D u + y_0",
    }
)
"""Base physics of the contract (section 2), in TeX."""


def html_page(report: Report) -> str:
    """Return the page. Without ``report.pictures`` it has text and tables only."""
    from jinja2 import Environment, StrictUndefined

    source = Path(__file__).with_name("page.html.j2").read_text(encoding="utf-8")
    template = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    ).from_string(source)
    return template.render(
        report=report,
        verdict=wording.VERDICTS[report.verdict],
        name=_name(report),
        chain=_chain(report),
        windows=wording.windows(report.location),
        base_equation=_base_equation(report),
        effects=[_effect(report, p) for p in report.physics],
        bars=_bars(report),
        base=_base_rows(report),
        pictures=_pictures(report),
        between=_between(report),
        limits=_limits(report),
        experiments=next_experiments(report),
        split=wording.data_parts(report),
        cautions=wording.cautions(report),
        number=number,
        chance=wording.chance,
        percent=percent,
        words=words,
        scaled=wording.scaled,
        only_whole=wording.ONLY_WHOLE,
        why_withheld=wording.why_withheld,
        meaning=wording.meaning(report),
        physics_title=wording.physics_title(report),
        hold=wording.hold(report),
        vouched=wording.vouched(report.vouched) if report.vouched else "",
    )


def _name(report: Report) -> str:
    path = Path(report.recording)
    return path.parent.name if path.name == "recording.toml" else str(Path(path.parent.name) / path.stem)


def _chain(report: Report) -> str:
    guilty = dict.fromkeys(wording.guilty_stages(report), "")
    for stage in guilty:
        named = [words(p.name) for p in report.physics if p.stage == stage]
        guilty[stage] = " + ".join(dict.fromkeys(named)) or "unexplained"
    signals = list(report.pictures.signals) if report.pictures else []
    outputs = list(report.fit.unit)
    begin = signals[0] if len(signals) == 1 else "inputs"
    end = outputs[0] if len(outputs) == 1 else f"{len(outputs)} outputs"
    return svg.chain(report.chain, guilty, (begin, end))


def _base_equation(report: Report) -> str:
    tex = BASE_EQUATIONS.get(report.twin)
    return svg.equation(tex) if tex else ""


def _effect(report: Report, p: PhysicsFound) -> dict[str, Any]:
    factor, unit = wording.shown_in(report.fit, p.output, max(p.residual_rms_before, p.residual_rms_after))
    known = EFFECTS.get(p.name)
    return {
        "found": p,
        "inside": wording.place_before_output(p),
        "title": words(p.name),
        "summary": known.summary if known else "",
        "equation": svg.equation(p.equation),
        "parameters": [
            (wording.label(n, v.unit), *wording.interval(v), "" if v.unit == "1" else v.unit)
            for n, v in p.parameters.items()
        ],
        "before": number(p.residual_rms_before * factor),
        "after": number(p.residual_rms_after * factor),
        "unit": unit,
        "sure": wording.sure(report, p),
        "plain": plain(p.equation),
    }


def _bars(report: Report) -> list[dict[str, Any]]:
    """Return per output the four figures of the fit as bars, with one scale per output."""
    f = report.fit
    out: list[dict[str, Any]] = []
    for o in f.unit:
        values = [("as given", "given", f.base_rms[o]), ("recalibrated", "before", f.recalibrated_rms[o])]
        if report.physics:
            values.append(("with physics", "after", f.fitted_rms[o]))
        values.append((f"noise floor ({f.noise_method.get(o, '')})", "noise", f.noise_floor_rms[o]))
        finite = [v for _, _, v in values if math.isfinite(v)]
        longest = max(finite, default=1.0) or 1.0
        # one hopeless figure (an unstable twin) must not hide the others
        second = sorted(finite)[-2] if len(finite) > 1 else longest
        top = min(longest, 4 * second) or 1.0
        factor, unit = wording.shown_in(f, o, second)
        rows = [
            (label, kind, number(v * factor), min(100.0, 100 * v / top) if math.isfinite(v) else 100.0, not v <= top)
            for label, kind, v in values
        ]
        share = percent(wording.explained(f, o)) if report.physics else "-"
        out.append({"output": o, "unit": unit, "rows": rows, "explained": share})
    return out


def _base_rows(report: Report) -> list[tuple[str, ...]]:
    out: list[tuple[str, ...]] = []
    for b in wording.base_rows(report):
        value, lo, hi = wording.interval_of(b.with_effects, b.ci95)
        out.append(
            (b.name, f"{b.given:.5g}", f"{b.alone:.5g}", value, f"{lo} to {hi}", "" if b.unit == "1" else b.unit)
        )
    return out


def _pictures(report: Report) -> list[dict[str, str]]:
    p = report.pictures
    if p is None or p.t.size < 16:
        return []
    return [
        {
            "output": o,
            "overlay": figures.overlay(report, p, o, f"overlay{i}"),
            "residual": figures.residual(report, p, o, f"residual{i}"),
            "follows": figures.follows(report, p, o, f"follows{i}"),
            "spectra": figures.spectra(report, p, o, f"spectra{i}"),
            "autocorrelation": figures.autocorrelations(report, p, o, f"acf{i}"),
        }
        for i, o in enumerate(series.drawn_outputs(report))
    ]


def _between(report: Report) -> dict[str, Any] | None:
    """Return the section on several recordings, None for one recording."""
    together = report.together
    if together is None:
        return None
    return {
        "count": len(together.recordings),
        "changes": words_together.change_lines(together),
        "scores": words_together.score_rows(together, report.fit),
        "plots": [figures.between(together, p, f"between{i}") for i, p in enumerate(together.parameters)],
    }


def _limits(report: Report) -> dict[str, Any]:
    """Return the detection limits as a table: a row per effect, a column per output; smallest limit first."""
    outputs = list(report.detection_limit)
    names = dict.fromkeys(n for of in report.detection_limit.values() for n in of)
    units = {o: wording.shown_in(report.fit, o, report.fit.noise_floor_rms.get(o, 1.0)) for o in outputs}

    def limit_text(o: str, n: str) -> str:
        v = report.detection_limit[o].get(n)
        return "-" if v is None else number(v * units[o][0])

    first = outputs[0] if outputs else ""
    order = sorted(names, key=lambda n: report.detection_limit[first].get(n) or math.inf)
    return {
        "outputs": [(o, units[o][1]) for o in outputs],
        "rows": [(words(n), [limit_text(o, n) for o in outputs]) for n in order],
    }
