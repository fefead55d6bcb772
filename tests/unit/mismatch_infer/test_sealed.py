"""The end of a recording that nothing reads before everything is decided."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.unit.mismatch_engine.cases import recording, wave
from tools.mismatch.infer import diagnose
from tools.mismatch.infer.constants import START
from tools.mismatch.infer.sealed import SHARE, seal
from tools.mismatch.recording import Recording, Split

N = 3000
KEPT = N - round(SHARE * N)


def _clipped(n: int = N) -> Recording:
    u = 40.0 * wave(np.random.default_rng(4), n)
    y = 0.12 * np.clip(u, -22.0, 25.0) + 0.01 * np.random.default_rng(5).standard_normal(n)
    return recording("piezo_stack", {"command": u}, {"displacement": y}, {"gain_um_per_V": 0.12, "offset_um": 0.0})


def test_what_happens_in_the_sealed_end_changes_its_own_score_and_nothing_else() -> None:
    real = _clipped()
    (name,) = real.outputs
    strange = real.outputs[name].copy()
    strange[KEPT:] += 3.0
    reports = [diagnose(r, jobs=1, constants=START) for r in (real, replace(real, outputs={name: strange}))]
    true, told = (r.fit.sealed for r in reports)
    assert true is not None
    assert told is not None
    assert true.span == told.span == (KEPT, N)
    # the noise, once the clipping is in the model; and the shift beside it
    assert true.fitted_rms[name] == pytest.approx(0.01, rel=0.1)
    assert true.recalibrated_rms[name] > 5 * true.fitted_rms[name]
    assert told.fitted_rms[name] == pytest.approx(np.hypot(3.0, 0.01), rel=0.01)
    blind = [replace(r, seconds=0.0, pictures=None, fit=replace(r.fit, sealed=None)).to_json() for r in reports]
    assert blind[0] == blind[1]


def test_what_cannot_be_sealed_says_why() -> None:
    short = _clipped(1500)
    kept, why = seal(short)
    assert kept is short
    assert why == "short"
    own = replace(_clipped(), split=Split(fit=(0, 2000), test=(2000, 3000)))
    kept, why = seal(own)
    assert kept is own
    assert why == "own_split"
