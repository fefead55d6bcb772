"""The proof for people: rich tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from tools.research.prove.proof import ProofResult

LINES = (
    ("named_severity_4_up", "right name first, severity 4 and above", 0.95, True),
    ("named_severity_2", "right name first, severity 2", 0.80, True),
    ("named_in_equivalence_group", "... or within the stated equivalence group", None, True),
    ("extra_names", "single cases with a name too many", None, False),
    ("pairs_both_named", "pairs, both named", 0.80, True),
    ("false_alarms", "false alarms on controls", 0.02, False),
    ("controls_verdict_right", "controls, verdict exactly right", None, True),
    ("unknown_unexplained", "outside the vocabulary: 'unexplained'", None, True),
    ("unknown_with_right_signal", "... with the right signal", 0.80, True),
    ("output_right", "output located", None, True),
    ("stage_right", "stage located", None, True),
    ("depends_right", "what it follows", None, True),
    ("explained_90_percent", "held out: 90 % of the explainable explained", 0.90, True),
    ("below_noise", "held-out figures below the true noise", 0.0, False),
    ("ci_coverage", "95 % intervals that hold the true value", None, True),
    ("errors", "crashed or refused", 0.0, False),
)


def _totals(s: dict[str, Any]) -> Table:
    t = Table(title="Blind self-proof", title_justify="left")
    for name in ("measure", "count", "share", "goal", ""):
        t.add_column(name, justify="left" if name == "measure" else "right")
    for key, text, goal, more in LINES:
        got, of = s[key]
        share = got / of if of else None
        verdict = Text()
        if goal is not None and share is not None:
            met = share >= goal if more else share <= goal
            verdict = Text("met", "green") if met else Text("missed", "red")
        target = "" if goal is None else f"{'>=' if more else '<='} {100 * goal:.0f} %"
        t.add_row(text, f"{got}/{of}", "" if share is None else f"{100 * share:.0f} %", target, verdict)
    return t


def _confusion(s: dict[str, Any]) -> Table:
    t = Table(title="Single effects: named by class and severity; what else was said", title_justify="left")
    for name in ("effect", "2", "4", "10", "30", "said instead"):
        t.add_column(name)
    for name in sorted(s["by_class"]):
        cells = s["by_class"][name]
        other = {k: v for k, v in s["confusion"][name].items() if k != name}
        t.add_row(
            name,
            *(f"{cells[k][0]}/{cells[k][1]}" if k in cells else "" for k in ("2", "4", "10", "30")),
            ", ".join(f"{k} {v}" for k, v in sorted(other.items(), key=lambda kv: -kv[1])),
        )
    return t


def render(result: ProofResult) -> RenderableType:
    """Totals, classes, failures."""
    s = result.summary
    weak = ", ".join(f"{k} {v[0]}/{v[1]}" for k, v in sorted(s["weak_classes"].items())) or "none"
    foot = (
        f"seed {result.seed}, {s['cases']} cases, {result.seconds:.0f} s; CPU of diagnoses {s['cpu_s_total']:.0f} s "
        f"(median {s['cpu_s_median'] or 0:.1f} s, longest {s['cpu_s_max'] or 0:.1f} s)\nweak classes: {weak}\n"
        f"recordings and reports: {result.folder}"
    )
    return Group(_totals(s), _confusion(s), foot)


def failures(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a line per case that went wrong: the truth and the answer."""
    out: list[str] = []
    for r in rows:
        if r["ok"] and not r.get("extra"):
            continue
        if r["kind"] in ("agrees", "recalibrate") and not r["false_alarm"]:
            continue
        word = "EXTRA" if r["ok"] else "WRONG"
        true = "+".join(r["true"]) or r["kind"]
        named = "+".join(r["said"]) or "-"
        ratio = "" if r["ratio"] is None else f" held-out/noise {r['ratio']:.2f}"
        error = f" {r['error']}" if r["error"] else ""
        follows = f" follows {','.join(r['follows'])}" if r["kind"] == "unknown" else ""
        out.append(
            f"{word} {r['case']} {r['twin']} {true} ({'+'.join(r['form']) or '-'}) severity {r['severity']:g} "
            f"{r['excitation']} noise {r['noise_kind']}: {r['verdict']} {named}{follows}{ratio}{error}"
        )
    return out


def show(result: ProofResult, console: Console) -> None:
    console.print(render(result))
    for line in failures(result.rows):
        console.print(line, soft_wrap=True, markup=False, highlight=False)
