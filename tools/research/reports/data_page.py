"""``docs/data.md``: the public recordings, their licences and origins, from the list that ``micron data`` reads.

``python -m tools.research.reports.data_page --out docs/data.md`` writes the page; a test compares.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from tools.data.registry import PublicSet, public_sets

PAGE = Path("docs/data.md")
_HEAD = """# Public recordings

Made by `python -m tools.research.reports.data_page --out docs/data.md`; do not edit. These recordings are other
people's. None is part of this project. Keep to the licence of each, and cite what its authors ask for.

```
micron data list                # names, sizes, licences, what is here already
micron data fetch emps          # to the cache, with a checksum (extra `data`)
```

Files are kept in `~/.cache/micron-bench/data/NAME` (or under `XDG_CACHE_HOME`, or in the folder that `MICRON_DATA`
names), as their repository has them at one commit. A file whose SHA-256 is not the listed one is not kept. Without a
network, one message says which file to put where; `--mirror URL` takes `URL/NAME/FILE` from a server of your own.

`.csv` and `.mat` files among them are described by `micron mismatch new FILE` ([your own data](own-data.md)). The
folders that the tests use (`shared_data`) hold the same measurements re-packed, one array per column, with a
`recording.toml` each; `micron data` does not make them.

The checksums were computed from stored copies of the repositories; the downloads themselves were tried against a local
server only. One of the 49 recordings of `tremor_duke_adxl345` (`older_2hz_t1`, from an older commit) is not listed.

| name | what | licence | size | from |
|---|---|---|---|---|
"""


def page() -> str:
    """Return the text of the page."""
    sets = public_sets().values()
    rows = "\n".join(_row(s) for s in sets)
    citations = "\n".join(f"- `{s.name}`: {s.citation}" for s in sets)
    return f"{_HEAD}{rows}\n\n## Citations that the originators ask for\n\n{citations}\n"


def _row(s: PublicSet) -> str:
    origin = f"[{s.repository.split('/')[-1][:40]}](https://github.com/{s.repository}/tree/{s.commit})"
    size = f"{s.bytes / 1e6:.1f} MB" if s.bytes >= 1e5 else f"{s.bytes / 1e3:.0f} kB"
    files = "1 file" if len(s.files) == 1 else f"{len(s.files)} files"
    return f"| `{s.name}` | {s.title} | {s.licence} | {files}, {size} | {origin} |"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tools.research.reports.data_page", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE")
    parser.parse_args().out.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
