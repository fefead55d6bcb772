"""``micron mismatch physics``: complete, with units and sources."""

import io
import json

from rich.console import Console

from tests.unit.mismatch_report.contract_check import NAMES
from tools.mismatch.report.vocabulary import entries, print_vocabulary, to_json


def test_every_name_of_the_contract_with_all_that_is_known():
    body = json.loads(json.dumps(to_json(entries()), allow_nan=False))
    assert tuple(p["name"] for p in body["physics"]) == NAMES
    for p in body["physics"]:
        for key in ("summary", "formula", "equations", "source", "excitation", "stages", "acts"):
            assert p[key], (p["name"], key)
        assert p["parameters"], p["name"]
        assert all(q["name"] and isinstance(q["unit"], str) and q["unit"] for q in p["parameters"]), p["name"]
        assert all(n in NAMES for n in p["confusable_with"])


def test_known_parameters_are_the_ones_of_reports():
    by = {e.name: dict(e.parameters) for e in entries()}
    assert by["creep"]["fraction_per_decade"] == "1"
    assert by["backlash"]["gap"] == "{in}"
    assert by["first_order_lag"] == {"time_constant_s": "s", "corner_hz": "Hz"}
    assert by["temperature_sensitivity"]["bias_per_K"] == "{out}/K"


def test_it_is_readable():
    out = io.StringIO()
    print_vocabulary(entries(), Console(file=out, width=100, highlight=False))
    text = out.getvalue()
    assert "creep  slow relaxation after a change of input" in text
    assert "y = x + Σⱼ cⱼ zⱼ" in text
    assert "needs       recorded temperature" in text
