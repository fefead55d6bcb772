"""Known vulnerabilities of the installed packages, by pip-audit: ``python -m tools.supply.audit``.

Exit status 1 when one of them has a version that repairs it; 0 when there are none, when no repair exists yet (they
are listed), or when the database cannot be reached (said, and not taken for a result).
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

LIMIT_S = 60


class Finding(NamedTuple):
    """One vulnerability of one package; ``repaired_in`` is empty when no version repairs it."""

    package: str
    version: str
    number: str
    repaired_in: tuple[str, ...]


def findings(report: Mapping[str, Any]) -> list[Finding]:
    """From the JSON of pip-audit."""
    return [
        Finding(entry["name"], entry.get("version", "?"), problem["id"], tuple(problem.get("fix_versions", ())))
        for entry in report["dependencies"]
        for problem in entry.get("vulns", ())
    ]


def verdict(found: Sequence[Finding]) -> int:
    """What the audit ends with: 1 when there is something to do."""
    return int(any(finding.repaired_in for finding in found))


def main() -> int:
    command = [
        sys.executable,
        "-m",
        "pip_audit",
        "--local",
        "--skip-editable",
        "--progress-spinner",
        "off",
        "-f",
        "json",
    ]
    try:
        done = subprocess.run(
            [*command, "--timeout", "5"], capture_output=True, text=True, timeout=LIMIT_S, check=False
        )
    except subprocess.TimeoutExpired:
        print(f"audit skipped: the vulnerability database does not answer within {LIMIT_S} s")
        return 0
    try:
        report = json.loads(done.stdout)
    except ValueError:
        detail = " ".join(done.stderr.strip().splitlines()[-1:]) or "no answer"
        print(f"audit skipped: the vulnerability database cannot be asked ({detail})")
        return 0
    found = findings(report)
    for finding in found:
        repair = f"repaired in {', '.join(finding.repaired_in)}" if finding.repaired_in else "no repair yet"
        print(f"{finding.package} {finding.version}: {finding.number}, {repair}")
    print(f"{len(report['dependencies'])} packages, {len(found)} known vulnerabilities")
    return verdict(found)


if __name__ == "__main__":
    sys.exit(main())
