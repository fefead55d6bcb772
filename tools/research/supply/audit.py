"""Known vulnerabilities of what is installed and of all extras: ``python -m tools.research.supply.audit`` (pip-audit).

Exit status 1 when one of them has a version that repairs it; 0 when there are none, when no repair exists yet (they
are listed), or when the database cannot be reached or knows none of the packages (said, and not taken for a result).
Packages that the database does not know are counted as not audited.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

LIMIT_S = 180
CONSTRAINTS = Path(__file__).parents[3] / "constraints.txt"


class Finding(NamedTuple):
    """Describes a vulnerability of a package; ``repaired_in`` is empty when no version repairs it."""

    package: str
    version: str
    number: str
    repaired_in: tuple[str, ...]


def findings(report: Mapping[str, Any]) -> list[Finding]:
    """Return the findings in the JSON of pip-audit."""
    return [
        Finding(entry["name"], entry.get("version", "?"), problem["id"], tuple(problem.get("fix_versions", ())))
        for entry in report["dependencies"]
        for problem in entry.get("vulns", ())
    ]


def audited(report: Mapping[str, Any]) -> int:
    """Return the number of packages that the database knows."""
    return sum("skip_reason" not in entry for entry in report["dependencies"])


def statement(what: str, report: Mapping[str, Any]) -> str:
    """Return the line that says how many packages were audited; none audited is no result."""
    total, known = len(report["dependencies"]), audited(report)
    if total and not known:
        return f"{what}: audit skipped: the vulnerability database knows none of {total} packages; is PyPI reachable?"
    return f"{what}: {known} of {total} packages audited, {len(findings(report))} known vulnerabilities"


def verdict(found: Sequence[Finding]) -> int:
    """Return the exit status of the audit: 1 when there is something to do."""
    return int(any(finding.repaired_in for finding in found))


def audit(what: str, source: Sequence[str]) -> int:
    """Print what is known of the packages of ``source`` (arguments of pip-audit); the exit status."""
    command = [sys.executable, "-m", "pip_audit", *source, "--progress-spinner", "off", "-f", "json", "--timeout", "5"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    except subprocess.TimeoutExpired:
        print(f"{what}: audit skipped: the vulnerability database does not answer within {LIMIT_S} s")
        return 0
    try:
        report = json.loads(done.stdout)
    except ValueError:
        detail = " ".join(done.stderr.strip().splitlines()[-1:]) or "no answer"
        print(f"{what}: audit skipped: the vulnerability database cannot be asked ({detail})")
        return 0
    found = findings(report)
    for finding in found:
        repair = f"repaired in {', '.join(finding.repaired_in)}" if finding.repaired_in else "no repair yet"
        print(f"{finding.package} {finding.version}: {finding.number}, {repair}")
    print(statement(what, report))
    return verdict(found)


def main() -> int:
    """The environment, then the pins of all extras, most of which are not installed."""
    installed = audit("installed", ["--local", "--skip-editable"])
    pinned = audit("all extras", ["-r", str(CONSTRAINTS), "--disable-pip", "--no-deps"])
    return max(installed, pinned)


if __name__ == "__main__":
    sys.exit(main())
