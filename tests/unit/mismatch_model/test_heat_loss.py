"""Radiation and natural convection of a heated plate, against an adaptive solver."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_model.ode_systems import CHANNELS, RATE_HZ, command, recorded
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_sites import sites
from tools.mismatch.simulate_start import prepare
from tools.mismatch.simulate_view import View
from tools.mismatch.twins.make import make

LOSS = EFFECTS["nonlinear_heat_loss"]
FORMS = (LOSS, *LOSS.variants)


def plate(unit: str, start: float) -> str:
    return f"""
[twin]
kind = "ode"
[twin.states]
plate = {{ unit = "{unit}", start = {start} }}
[twin.equations]
plate = "heat * command - loss * (plate - {start})"
[twin.parameters]
heat = 60.0
loss = 0.2
fixed = ["plate_offset"]
"""


def heated(folder: Path, unit: str, form: int):
    """(recording, settled parameters of the effect) of a plate that radiates (0) or convects (1)."""
    u = 1.0 + 0.8 * command()
    t = np.arange(u.size) / RATE_HZ
    zero = {"degC": -273.15, "K": 0.0}[unit]
    start = zero + 293.15
    high = {0: lambda x: 2e-9 * ((x - zero) ** 4 - (start - zero) ** 4), 1: lambda x: 0.3 * max(x - start, 0.0) ** 1.25}

    def slope(now: float, x: np.ndarray) -> list[float]:
        return [60 * np.interp(now, t, u) - 0.2 * (x[0] - start) - high[form](x[0])]

    y = solve_ivp(slope, (0, t[-1]), [start], t_eval=t, rtol=1e-10, atol=1e-10, max_step=0.5 / RATE_HZ).y[0]
    channels = CHANNELS.replace('"angle"', '"plate"').replace('"rad"', f'"{unit}"')
    return recorded(folder, plate(unit, start), u, y, channels), (2e-9,) if form == 0 else (start, 0.3)


@pytest.mark.parametrize("unit", ["degC", "K"])
@pytest.mark.parametrize("form", [0, 1])
def test_a_plate_loses_heat_as_the_law_says(form: int, unit: str, tmp_path: Path) -> None:
    recording, truth = heated(tmp_path, unit, form)
    twin, view = make(recording), View.whole(recording)
    base = Model(twin)
    place = next(p for p in sites(twin, recording, LOSS) if p.effect.equation == FORMS[form].equation)
    place = prepare(base, view, base.start(recording), place)
    # the loss to surroundings at the lowest temperature; here the first one
    settings = {**place.settings, "range": (float(recording.outputs["plate"][0]), place.settings["range"][1])}
    model = Model(twin, [replace(place, settings=settings)])
    theta = model.start(recording)
    a, b = model.slices(0)
    theta[a.start : b.stop] = truth
    moved = float(np.std(base.residual(view, base.start(recording))["plate"]))
    assert float(np.max(np.abs(model.residual(view, theta)["plate"]))) < 1e-4 * moved


def test_a_temperature_has_no_rim_and_a_level_does_not_radiate(tmp_path: Path) -> None:
    recording, _ = heated(tmp_path, "degC", 0)
    twin = make(recording)
    assert sites(twin, recording, EFFECTS["overflow"]) == []
    assert sites(twin, recording, EFFECTS["square_root_outflow"]) == []
    assert {p.target for p in sites(twin, recording, LOSS)} == {"plate"}
    tank = plate("m", 0.0)
    channels = CHANNELS.replace('"angle"', '"plate"').replace('"rad"', '"m"')
    level = recorded(tmp_path / "tank", tank, recording.inputs["command"], recording.outputs["plate"], channels)
    assert sites(make(level), level, LOSS) == []
    assert {p.target for p in sites(make(level), level, EFFECTS["overflow"])} == {"plate"}
