"""Makes the page of the firmware's table: ``python -m tools.research.reports.findings_page docs/findings.md``."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from firmware_py.run.findings import Finding
from firmware_py.run.safety import SafetyLimits

HEAD = """# Findings: what holds, what latches

Made by `python -m tools.research.reports.findings_page docs/findings.md` from the table in
[`firmware_py/run/findings.py`](../firmware_py/run/findings.py), which the firmware itself obeys.

**Recoverable**: the outputs ramp to neutral within 20 ms and hold there. When scans have flowed and the self-test has
passed for `hold_ms` without interruption, the amplifier is armed again (it reads neutral back) and compensation fades
in from neutral. The run's JSON lists every hold (`holds`), the recording has its begin and end as events, and its rows
carry the bit `HELD`. **Latched**: the outputs ramp to neutral and stay there; the run ends.

| `[firmware.safety]` | default | meaning |
|---|---|---|
| `hold_ms` | {hold_ms:g} | how long all must have been good before the outputs move again |
| `hold_limit_ms` | {hold_limit_ms:g} | a hold that has not become good for so long latches |
| `holds_per_minute` | {holds_per_minute} | one hold more within a minute latches; 0: every finding latches |
| `rearm` | "{rearm}" | "operator": a hold whose cause has passed waits for a person |

With `rearm = "operator"` a person ends the hold by the page's button (order `rearm`) or by the signal SIGUSR1 to the
firmware's process; asked for earlier than the cause has passed, nothing happens, and the recording notes it. A run does
not end within a hold whose cause has not passed: it waits for the end of the hold, or latches with it.

The class says where the cause is: this host, the link, the device, or the operator. In real time with every bus
emulated (`--realtime`, `--compiled`) holds of the class "host" do not count towards `holds_per_minute`.

| finding | class | answer | message | why |
|---|---|---|---|---|
"""


def markdown() -> str:
    """The whole page."""
    limits = SafetyLimits()
    rows: list[str] = []
    for finding in Finding:
        entry = finding.value
        answer = "ends the run" if entry.normal else "holds" if entry.recoverable else "latches"
        says = re.sub(r"\{(\w+)[^}]*\}", r"*\1*", entry.says)
        rows.append(f"| {entry.title} | {entry.cause.value} | {answer} | {says} | {entry.why} |")
    return HEAD.format(**limits.model_dump()) + "\n".join(rows) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m tools.research.reports.findings_page", description=__doc__)
    parser.add_argument("page", type=Path, help="file to write")
    parser.parse_args().page.write_text(markdown(), encoding="utf-8")
