"""Loads the learned constants of the decision. Only ``micron mismatch calibrate`` writes ``constants.json``.

``strangers.json`` counts the names above a half on machines that people who knew nothing of the engine simulated.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Any

from tools.mismatch.engine.report import Vouched

FILE = Path(__file__).with_name("constants.json")
STRANGERS = FILE.with_name("strangers.json")


@dataclass(frozen=True)
class Constants:
    """Holds the constants of a decision.

    ``samples``: independent samples that a held-out residual of noise counts for at most, and ``form_samples`` those of
    a form error (``Count``); ``per_name`` and ``per_parameter``: prices in nats; ``least_z``: least whitened held-out
    correlation of every name. ``cut`` (noise variances) and ``cut_share`` (of what was explained): what may be left and
    follow signals before the account is no account. ``sure_offset`` and ``sure_slope``: the map from the log odds of a
    name to stated ones, less ``sure_open`` where more than ``cut`` is left; ``most_sure``: the probability that is
    stated at most, by how many cases the map was learned on.
    """

    samples: float
    form_samples: float
    per_name: float
    per_parameter: float
    least_z: float
    cut: float
    cut_share: float
    sure_offset: float
    sure_slope: float
    sure_open: float
    most_sure: float

    @staticmethod
    def of(body: Mapping[str, Any]) -> Constants:
        """Return the constants of a parsed file. Raises KeyError if one is missing."""
        return Constants(**{f.name: float(body[f.name]) for f in fields(Constants)})

    def to_json(self) -> dict[str, float]:
        return {k: float(f"{v:.6g}") for k, v in asdict(self).items()}


START = Constants(300.0, 60.0, 7.0, 0.6, 3.0, 0.5, 0.05, 0.0, 1.0, 0.0, 1.0)
"""Start values of the learning, also used in the searches of its training fits: the middle of the ranges that a
prototype found on cases of another generator."""


@cache
def learned() -> Constants:
    """Return the constants in use."""
    return Constants.of(json.loads(FILE.read_text())["constants"])


@cache
def vouched(kind: str) -> Vouched | None:
    """Return what strangers' machines say of the names for a ``kind`` of twin that the corpus of the calibration lacks.

    None: the corpus has the kind.
    """
    body = json.loads(STRANGERS.read_text())
    if kind not in body["kinds"]:
        return None
    return Vouched(*(sum(int(s[k]) for s in body["sets"]) for k in ("names", "right")))


def constants_for(kind: str) -> Constants:
    """Return the constants in use for a ``kind`` of twin: strangers' machines limit what is stated of theirs."""
    c, known = learned(), vouched(kind)
    return c if known is None else replace(c, most_sure=min(c.most_sure, known.most))
