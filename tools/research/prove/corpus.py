"""Three corpora of generated cases, kept apart by their seeds: one to learn constants on, one to look at, one to score.

A case is (corpus, number). Cases come in blocks of forty, each block a balanced list of plans drawn from its own seed,
so that a corpus grows without changing the cases it has.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, get_args

from tools.research.prove import guests
from tools.research.prove.plans import plans
from tools.research.prove.proof import draw_one

Name = Literal["calibrate", "develop", "sealed"]
NAMES: tuple[Name, ...] = get_args(Name)
BLOCK = 40
"""Cases that are drawn from one seed."""
_ROOT = Path(__file__).resolve().parents[3]


@dataclass(frozen=True)
class Corpus:
    """Seeds ``first`` to ``last`` (inclusive) belong to this corpus and to no other.

    ``open``: cases may be listed and their recordings kept. Of a corpus that is not open, scores are all that is shown.
    """

    name: Name
    first: int
    last: int
    open: bool

    def seed_of(self, number: int, start: int = 0) -> int:
        """Seed of the block of case ``number``; ``start`` is the corpus's first block. ValueError beyond the range."""
        if number < 0 or start < 0:
            raise ValueError(f"corpus {self.name}: case {number} from block {start}; neither may be negative")
        seed = self.first + start + number // BLOCK
        if seed > self.last:
            raise ValueError(f"corpus {self.name}: case {number} is beyond its last seed {self.last}")
        return seed


CORPORA = MappingProxyType(
    {
        "calibrate": Corpus("calibrate", 1_100_000_000, 1_199_999_999, True),
        "develop": Corpus("develop", 1_200_000_000, 1_299_999_999, True),
        "sealed": Corpus("sealed", 1_300_000_000, 1_399_999_999, False),
    }
)
"""The seed ranges. The clock's seeds of a plain proof are below 1_000_000_007 and belong to none of them."""


def first_block(corpus: Corpus, revision: str) -> int:
    """First block of a corpus: 0 for an open one; for a sealed one it follows from the revision's hash."""
    if corpus.open:
        return 0
    blocks = (corpus.last - corpus.first) // 2
    return int.from_bytes(hashlib.sha256(revision.encode()).digest()[:8], "big") % blocks


@dataclass(frozen=True)
class Drawn:
    """Holds a case on disk: ``recording`` (the descriptor), ``answer``, and the folder of its sealed part."""

    case: str
    recording: Path
    answer: dict[str, Any]
    sealed: Path

    @property
    def name(self) -> str:
        return self.recording.parent.name


def digest_of(*sources: str) -> str:
    """SHA-256 over sources and folders of them (paths in the repository): what a kept result depends on."""
    digest = hashlib.sha256()
    paths = [_ROOT / s for s in sources]
    files = (f for p in paths for f in ((p,) if p.is_file() else p.rglob("*")) if f.suffix in (".py", ".json"))
    for file in sorted(files):
        digest.update(str(file.relative_to(_ROOT)).encode())
        digest.update(file.read_bytes())
    return digest.hexdigest()


DRAWING = tuple(
    f"tools/research/prove/{name}.py"
    for name in (
        "catalog", "disk", "draw", "excite", "forms_axis", "forms_memory", "forms_sensor", "forms_time",
        "forms_unknown", "guests", "kernels", "noise", "plans", "plants", "plants_bench", "ports", "scenes",
    )
)  # fmt: skip


def generator_digest() -> str:
    """Digest of what draws the cases."""
    return digest_of(*DRAWING)


def draw_case(corpus: Corpus, number: int, folder: Path, max_samples: int, start: int = 0) -> Drawn | None:
    """Case ``number`` below ``folder``, drawn unless it is there; None when no scene shows what its plan asks for.

    Raises ValueError for a number beyond the corpus's seeds.
    """
    seed, index = corpus.seed_of(number, start), number % BLOCK
    block = folder / f"{corpus.name}-{max_samples}-{generator_digest()[:8]}" / f"b{seed - corpus.first:06d}"
    kept = block / "sealed" / f"r{index:03d}.json"
    if kept.is_file():
        body = json.loads(kept.read_text())
        return None if body is None else _drawn(number, block, body)
    plan = plans(seed, BLOCK)[index]
    if plan.twin == guests.FMU and not guests.fmu_possible():
        return None  # not remembered: the extra may be installed later
    made = draw_one((seed, index, plan, block / "recordings", max_samples, None))
    kept.parent.mkdir(parents=True, exist_ok=True)
    body = None if made is None else {"answer": made[1], "recording": str(Path(made[2]).relative_to(block))}
    if body is not None:
        body = json.loads(json.dumps(body))  # as it will be read back
    kept.write_text(json.dumps(body, indent=1, sort_keys=True))
    return None if body is None else _drawn(number, block, body)


def _drawn(number: int, block: Path, body: dict[str, Any]) -> Drawn:
    return Drawn(f"c{number:05d}", block / body["recording"], body["answer"], block / "sealed")


def answers_digest(answers: Sequence[dict[str, Any]]) -> str:
    """SHA-256 of a list of answers: names the corpus that something was learned on."""
    return hashlib.sha256(json.dumps(answers, sort_keys=True).encode()).hexdigest()
