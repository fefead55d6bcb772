"""Proposes the next recording: one that settles the questions which this one left open."""

from __future__ import annotations

from dataclasses import dataclass

from sim_devices.physics.catalogue import EFFECTS
from tools.mismatch.engine.report import DependsOn, Report
from tools.mismatch.report.wording import label, number, percent, poorly_known, words


@dataclass(frozen=True)
class Experiment:
    """Proposes ``what`` to record, and says ``why``: the question that it answers."""

    what: str
    why: str


_FOLLOWS = {
    "value": "step {s} through its whole range while everything else rests, up and down",
    "square": "step {s} through its whole range while everything else rests, up and down",
    "rate": "the same path of {s} at three speeds ten times apart",
    "sign of rate": "slow triangles of {s} at three amplitudes",
    "acceleration": "the same path of {s} at three speeds, then steps",
    "running extremum": "triangles of {s} that grow and then shrink in amplitude, at two speeds",
    "recent history": "a step of {s} and a long hold, then the step back and a long hold",
    "amplitude": "one frequency of {s} at five amplitudes, small to large",
    "frequency": "a chirp of {s} at constant amplitude",
    "cross product": "change {s} in steps while the input repeats the same path",
    "time itself": "the same input twice, the second time after an hour of running; record the temperature beside",
}


def next_experiments(report: Report) -> list[Experiment]:
    """Return the experiments, the most useful first; never empty."""
    found = [
        Experiment(words(e.tell_apart_by), f"tells apart {', '.join(words(n) for n in e.names)}")
        for e in report.equivalent
    ]
    if report.one_way is not None:
        way = report.one_way
        found.append(
            Experiment(
                f"a reversal of {number(way.reversal)} {way.unit} or more of {way.output}",
                "it only ever moved one way, so friction and an offset of the force are the same",
            )
        )
    if report.verdict == "unexplained":
        found += _unexplained(report)
    found += _poorly_known(report)
    estimated = [o for o, m in report.fit.noise_method.items() if m == "spectrum"]
    if estimated:
        found.append(
            Experiment(
                "a thousand samples with the input at rest, and noise_rms in the recording",
                f"the noise floor of {', '.join(estimated)} was estimated, not declared",
            )
        )
    if report.verdict in ("agrees", "recalibrate"):
        unseen = [(name, need) for name, need in report.cannot_show.items() if not need.startswith("none")]
        found += [Experiment(need, f"shows {words(name)}, which this recording cannot") for name, need in unseen[:3]]
    if not found or report.verdict == "missing_physics":
        found.append(
            Experiment(
                "another waveform and another day, with the corrected twin (micron mismatch apply)",
                "confirms that what was found belongs to the system and not to this recording",
            )
        )
    return list({e.what: e for e in reversed(found)}.values())[::-1]


def _unexplained(report: Report) -> list[Experiment]:
    out = [_follow(d, report) for d in report.location.depends_on[:2]]
    return out or [
        Experiment(
            "the same input twice, and every signal near the instrument as a context channel",
            "tells what repeats from what comes from outside: it follows no recorded signal",
        )
    ]


def _follow(d: DependsOn, report: Report) -> Experiment:
    what = _FOLLOWS.get(d.feature, "excite {s} alone, over its whole range").format(s=d.signal)
    if d.signal in report.fit.unit:  # nobody sets an output
        what = f"by way of the inputs, {what}"
    return Experiment(what, f"draws the curve of what follows {d.signal} ({d.feature})")


def _poorly_known(report: Report) -> list[Experiment]:
    out: list[Experiment] = []
    for p in report.physics:
        effect = EFFECTS.get(p.name)
        wide = {n: w for n, v in p.parameters.items() if (w := poorly_known(v)) is not None}
        if effect is None or not wide:
            continue
        name, share = max(wide.items(), key=lambda item: item[1])
        known = f"within {percent(share)}" if share < 1 else "in order of magnitude, not even in sign"
        what = label(name, p.parameters[name].unit)
        out.append(Experiment(effect.excitation, f"{words(p.name)}: {what} is only known {known}"))
    return out
