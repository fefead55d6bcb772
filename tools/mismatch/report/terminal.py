"""Prints a report on a terminal."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from tools.mismatch.engine.report import FitSummary, PhysicsFound, Report, Together
from tools.mismatch.report import together as words_together
from tools.mismatch.report import wording
from tools.mismatch.report.equations import plain
from tools.mismatch.report.next_experiment import next_experiments
from tools.mismatch.report.wording import chance, number, percent, words
from tools.terminal import pairs_of

_COLOUR = {"agrees": "green", "recalibrate": "cyan", "missing_physics": "yellow", "unexplained": "magenta"}


def _table(*columns: str, left: int = 1) -> Table:
    t = Table(box=None, padding=(0, 2, 0, 0), header_style="bold")
    for i, name in enumerate(columns):
        t.add_column(name, justify="left" if i < left else "right", overflow="fold", no_wrap=i == 0)
    return t


def _section(title: str, body: RenderableType) -> RenderableType:
    return Group(Text(f"\n{title}", style="bold underline"), Padding(body, (0, 0, 0, 2)))


def _where(report: Report) -> RenderableType:
    location = report.location
    marked = wording.guilty_stages(report)
    chain = Text(" › ").join(
        Text(f"[{s}]" if s in marked else s, "bold red" if s in marked else "") for s in report.chain
    )
    return pairs_of(
        [
            ("outputs", ", ".join(location.outputs) or "none"),
            ("chain", chain),
            ("when", wording.windows(location)),
            ("regime", location.regime),
            ("follows", wording.follows(location)),
        ]
    )


def _physics(k: int, p: PhysicsFound, report: Report) -> RenderableType:
    head = Text.assemble(
        (f"{k}. {words(p.name)}", "bold yellow"),
        f" of {', '.join(p.outputs)}, at the {p.stage}; {wording.sure(report, p)}",
    )
    t = _table("parameter", "value", "95 % interval", "unit")
    t.columns[3].justify = "left"
    for name, v in p.parameters.items():
        value, lo, hi = wording.interval(v)
        t.add_row(Text(wording.label(name, v.unit)), value, f"{lo} .. {hi}", Text(v.unit if v.unit != "1" else ""))
    rows = [("equation", plain(p.equation)), ("residual", wording.before_after(p, report.fit)), ("source", p.source)]
    if inside := wording.place_before_output(p):
        rows.append(("place", inside))
    if p.note:
        rows.append(("place", f"{p.note}: this recording cannot tell"))
    if p.only_whole:
        rows.append(("size", wording.ONLY_WHOLE))
    if p.at_bound:
        rows.append(("caution", f"at the limit of what is searched: {', '.join(p.at_bound)}"))
    return Group(head, Padding(Group(t, pairs_of(rows)), (0, 0, 0, 3)))


def _fit(report: Report) -> Table:
    t = _table("output", "as given", "re-fitted", "with physics", "noise floor", "explained")
    f = report.fit
    for o in f.unit:
        factor, unit = wording.shown_in(f, o, f.recalibrated_rms[o])
        figures = (f.base_rms[o] * factor, f.recalibrated_rms[o] * factor, f.fitted_rms[o] * factor)
        floor = f"{wording.floor_of(f, o, factor)} ({f.noise_method.get(o, '')})"
        t.add_row(Text(f"{o} ({unit})"), *map(number, figures), floor, percent(wording.explained(f, o)))
    return t


def _base(report: Report) -> Table:
    t = _table("parameter", "as given", "re-fitted alone", "with physics", "95 % interval", "unit")
    t.columns[5].justify = "left"
    for b in wording.base_rows(report):
        value, lo, hi = wording.interval_of(b.with_effects, b.ci95)
        t.add_row(Text(b.name), f"{b.given:.5g}", f"{b.alone:.5g}", value, f"{lo} .. {hi}", Text(b.unit))
    return t


def _runners_up(report: Report) -> Table:
    t = _table("effect", "output", "held-out residual", "why not")
    t.columns[1].justify = t.columns[3].justify = "left"
    for a in report.alternatives:
        factor, unit = wording.shown_in(report.fit, a.output, a.residual_rms_after)
        t.add_row(
            words(a.name), Text(a.output), f"{number(a.residual_rms_after * factor)} {unit}", Text(words(a.why_not))
        )
    return t


def _limits(report: Report) -> Table:
    """Return the detection limits: all where nothing was found, because 'agrees' depends on them, else the range."""
    rows: list[tuple[str, str]] = []
    for o, of in report.detection_limit.items():
        known = sorted((v, n) for n, v in of.items() if v is not None)
        factor, unit = wording.shown_in(report.fit, o, report.fit.noise_floor_rms.get(o, 1.0))
        limits = [f"{words(n)} {number(v * factor)}" for v, n in known]
        if report.verdict in ("missing_physics", "unexplained") and len(limits) > 3:
            limits = [f"{limits[0]} .. {limits[-1]} (all in --json and --html)"]
        rows.append((f"{o} ({unit} rms)", ", ".join(limits) or "none"))
    return pairs_of(rows)


def _checks(report: Report) -> Table:
    c = report.checks
    white = {True: "white", False: "not white"}
    rows = [
        ("residual", f"{white[c.residual_white_before]} before, {white[c.residual_white_after]} after"),
        ("by chance", chance(c.false_alarm_p_value)),
    ]
    if c.memory_p_value < 1e-3:
        rows.append(("memory", f"history helps beyond the present ({chance(c.memory_p_value)}): a state is missing"))
    if report.vouched:
        rows.append(("sure", wording.vouched(report.vouched)))
    if report.hold:
        rows.append(("inputs", wording.hold(report)))
    rows += [("look at", m) for m in wording.cautions(report)]
    return pairs_of(rows)


def _together(together: Together, fit: FitSummary) -> RenderableType:
    rows = [("left out", f"{o}: {figures}") for o, figures in words_together.score_rows(together, fit)]
    rows += [("changes", line) for line in words_together.change_lines(together)]
    rows += [(p.name, words_together.range_text(p)) for p in together.parameters]
    return pairs_of(rows)


def render(report: Report) -> RenderableType:
    """Return the whole report."""
    colour = _COLOUR[report.verdict]
    parts: list[RenderableType] = [
        Panel(
            Text(report.summary),
            title=Text(wording.VERDICTS[report.verdict], f"bold {colour}"),
            title_align="left",
            border_style=colour,
        )
    ]
    if report.not_tried:
        parts.append(Padding(Text(report.not_tried, "italic"), (1, 0, 0, 2)))
    if report.meaning:
        parts.append(_section("What 'unexplained' means here", Text(wording.meaning(report))))
    if report.location.outputs:
        parts.append(_section("Where", _where(report)))
    if report.physics:
        named = Group(*(_physics(i + 1, p, report) for i, p in enumerate(report.physics)))
        parts.append(_section(wording.physics_title(report), named))
    parts.append(_section("Residual on data that no fit has seen (rms)", _fit(report)))
    if report.together is not None:
        title = f"Between {len(report.together.recordings)} recordings (each left out once, or in groups)"
        parts.append(_section(title, _together(report.together, report.fit)))
    if report.fit.base_parameters:
        parts.append(_section("Base parameters", _base(report)))
    if report.alternatives:
        parts.append(_section("Runners-up", _runners_up(report)))
    if report.withheld:
        of = [(words(w.name), f"{w.output}: {wording.why_withheld(w, report.fit)}") for w in report.withheld]
        parts.append(_section("Tried and not named", pairs_of(of)))
    if report.equivalent:
        lines = [f"{' = '.join(words(n) for n in e.names)}: {words(e.tell_apart_by)}" for e in report.equivalent]
        parts.append(_section("This recording cannot tell apart (what would)", Text("\n".join(lines))))
    parts.append(_section("Smallest effect that would have been named", _limits(report)))
    if report.cannot_show:
        rows = [(words(n), need) for n, need in report.cannot_show.items()]
        parts.append(_section("This recording cannot show at all (what would)", pairs_of(rows)))
    parts.append(_section("Checks", _checks(report)))
    parts.append(_section("Split", pairs_of(wording.data_parts(report))))
    rows = [(f"{i + 1}.", f"{e.what}: {e.why}") for i, e in enumerate(next_experiments(report))]
    parts.append(_section("Record next", pairs_of(rows)))
    parts.append(
        Text(f"\n{report.recording}, twin {report.twin}, seed {report.seed}, {report.seconds:.1f} s", style="dim")
    )
    return Group(*parts)


def print_report(report: Report, console: Console) -> None:
    """Print the report."""
    console.print(render(report))


def batch_report(rows: Sequence[dict[str, str]]) -> RenderableType:
    """Print a line per recording of a folder (see ``batch.Row.cells``), then those without a report and why."""
    t = _table("recording", "verdict", "physics", "worst output", "re-fit", "fitted", "noise", "s", left=4)
    t.padding = (0, 1, 0, 0)
    for column in t.columns:
        # text wraps between words and figures do not wrap: eight columns fit a terminal of eighty characters
        column.no_wrap = column.header not in ("physics", "worst output")
    t.columns[2].min_width = t.columns[3].min_width = 12
    failed: list[RenderableType] = []
    for row in rows:
        if row["error"]:
            failed.append(Text.assemble((f"{row['name']}: ", "bold red"), row["error"]))
            continue
        verdict = Text(words(row["verdict"]), _COLOUR[row["verdict"]])
        rest = (Text(row[k]) for k in ("physics", "output", "recalibrated", "fitted", "noise", "seconds"))
        t.add_row(Text(row["name"]), verdict, *rest)
    if failed:
        failed.insert(0, Text("\nWithout a report", style="bold underline"))
    return Group(*([t] if t.row_count else []), *failed)
