"""Prints the results of ``micron mismatch plan``."""

from __future__ import annotations

from rich.console import Console

from tools.mismatch.plan.plan import Designed, Prospect, words
from tools.mismatch.plan.separable import THRESHOLD
from tools.terminal import table_of


def print_prospect(p: Prospect, say: Console) -> None:
    """Print tables of the visible effects and of those that cannot be distinguished."""
    rec = p.where.template
    output = next(iter(p.sigma))
    noise, unit = p.sigma[output], rec.unit[output]
    box = next(iter(p.limits.values()))
    say.print(
        f"{p.found.samples} samples of {p.found.input}, about {box.centre:.4g} +- {box.amplitude:.4g} {box.unit}, "
        f"{box.band_hz[0]:.3g} to {box.band_hz[1]:.3g} Hz; noise {noise:.3g} {unit}.",
        highlight=False,
        soft_wrap=True,
    )
    title = f"smallest effect that shows ({THRESHOLD:g} sd)"
    table = table_of(title, "effect", "at", f"rms ({unit})", left=2, box=None)
    for s in p.found.visible:
        table.add_row(words((s.name,)), s.place, f"{s.smallest_rms * noise:.3g}")
    say.print(table)
    if not p.found.groups:
        say.print(f"Effects of {p.found.size:g} noise rms can all be told apart here.", soft_wrap=True)
    for group in p.found.groups:
        say.print(f"Cannot tell apart at {p.found.size:g} noise rms: {words(group)}.", highlight=False, soft_wrap=True)
    for s in p.found.splitters:
        at = f" would split them from {s.size:.2g} noise rms on" if s.size is not None else " (not simulated)"
        say.print(f"  {words(s.names)}: {s.what}{at}", highlight=False, soft_wrap=True)
    if p.found.imitated:
        pairs = "; ".join(f"{words((a,))} by {words((b,))}" for a, b in p.found.imitated)
        say.print(f"Imitated on every input tried: {pairs}.", highlight=False, soft_wrap=True)
    if p.found.not_moved:
        say.print(f"Not shown by this input: {words(p.found.not_moved)}.", highlight=False, soft_wrap=True)
    for signal, names in p.channels.items():
        say.print(f"With a channel '{signal}': {words(names)} could be named.", highlight=False, soft_wrap=True)
    for group, sensors in p.places.items():
        helps = f"measure {' or '.join(sensors)}" if sensors else "no single sensor helps"
        say.print(f"Structure cannot split {', '.join(group)}: {helps}.", highlight=False, soft_wrap=True)


def print_plan(d: Designed, say: Console) -> None:
    """Return the input to record and the effects that it will separate."""
    say.print(f"Equivalent so far: {words(d.group)}.", highlight=False, soft_wrap=True)
    say.print(f"Planned input: {d.plan.description} ({d.plan.evaluations} inputs tried).", highlight=False)
    for signal, box in d.plan.limits.items():
        say.print(
            f"  {signal}: {box.centre:.4g} +- {box.amplitude:.4g} {box.unit}, at most {box.rate_per_s:.4g} {box.unit}/s"
            f", {box.band_hz[0]:.3g} to {box.band_hz[1]:.3g} Hz, {box.duration_s:.4g} s",
            highlight=False,
            soft_wrap=True,
        )
    for pair, sd in d.plan.pairs.items():
        say.print(f"  {pair.replace('_', ' ')}: {sd:.1f} standard deviations", highlight=False)
    say.print(
        f"Expected separation {d.plan.separation:.1f} sd; random multisine of equal energy "
        f"{d.plan.random_separation:.1f} sd (median of five).",
        highlight=False,
        soft_wrap=True,
    )
