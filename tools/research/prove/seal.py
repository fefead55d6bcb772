"""The sealed answers: written apart from the recordings, hash first, opened when every diagnosis is done."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from tools.research.prove.draw import Case


def answer(case: Case) -> dict[str, Any]:
    """Return what is known of a case, as plain JSON."""
    return {
        "kind": case.plan.kind,
        "twin": case.plan.twin,
        "severity": case.plan.severity,
        "excitation": case.scene.excitation,
        "rate_hz": 1.0 / case.scene.dt,
        "samples": case.scene.keep,
        "effects": [asdict(t) for t in case.truths],
        "noise_kind": case.noise_kind,
        "noise_rms": case.noise_rms,
        "noise_declared": case.declared,
        "parameters": case.scene.parameters,
        "given_is_true": case.given_is_true,
        "decoys": list(case.decoys),
    }


def keep_noise(case: Case, folder: Path, name: str) -> None:
    """The noise as it was drawn, so that a held-out figure can be compared on its own samples."""
    folder.mkdir(parents=True, exist_ok=True)
    values = {k: v.astype(np.float32) for k, v in case.noise.items()}
    np.savez(folder / f"{name}.npz", **values)  # pyright: ignore[reportArgumentType]


def noise_on(folder: Path, name: str, spans: Sequence[Sequence[int]]) -> dict[str, float]:
    """True noise rms per output on these sample spans (stop excluded)."""
    with np.load(folder / f"{name}.npz") as file:
        noise = {k: file[k].astype(float) for k in file.files}
    out: dict[str, float] = {}
    for k, v in noise.items():
        parts = [v[int(a) : int(b)] for a, b in spans]
        out[k] = float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))
    return out


def close(answers: dict[str, dict[str, Any]], folder: Path) -> str:
    """Write the answers; their SHA-256."""
    folder.mkdir(parents=True, exist_ok=True)
    data = json.dumps(answers, indent=1, sort_keys=True).encode()
    (folder / "answers.json").write_bytes(data)
    return hashlib.sha256(data).hexdigest()


def opened(folder: Path, digest: str) -> dict[str, dict[str, Any]]:
    """Read the answers back. ValueError when they are not the ones that were sealed."""
    data = (folder / "answers.json").read_bytes()
    if hashlib.sha256(data).hexdigest() != digest:
        raise ValueError(f"{folder / 'answers.json'}: not the answers that were sealed ({digest})")
    return json.loads(data)
