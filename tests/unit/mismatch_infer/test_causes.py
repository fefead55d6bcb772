"""A rest that the past of what moves predicts is no noise, whatever its colour, and noise that is fed back is."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from sim_devices.physics.catalogue import EFFECTS
from sim_devices.physics.effect import Array
from tests.unit.mismatch_engine.cases import recording, swung
from tools.mismatch.engine.dependence import Dependence
from tools.mismatch.engine.pose import prepared
from tools.mismatch.infer import causes, decide, diagnose
from tools.mismatch.infer.causes import caused_by
from tools.mismatch.infer.decide import followed_by
from tools.mismatch.placed import Placed
from tools.mismatch.recording import Recording

RATE_HZ = 200.0
BODY: dict[str, object] = {"A": [[0.0, 1.0], [-900.0, -4.0]], "C": [[1.0, 0.0]], "hold": "zero"}


def cause(rec: Recording) -> str | None:
    """The signal whose past predicts what the twin leaves."""
    problem, _, base = prepared(rec, 0.3, 0, False)
    found = caused_by(problem, base, "x")
    return None if found is None else found.signal


@pytest.mark.parametrize("carried", [True, False])
def test_what_an_input_does_by_a_path_of_its_own_is_no_noise_and_ringing_noise_is(carried: bool) -> None:
    rng = np.random.default_rng(8)
    u, other, noise = rng.standard_normal((3, 6000))
    y = swung(u, RATE_HZ)
    left = swung(other if carried else noise, RATE_HZ, 75.0, 1.0)
    left *= 0.3 * np.std(y) / np.std(left)
    y = y + left + 0.02 * np.std(left) * rng.standard_normal(u.size)
    parameters = {**BODY, "B": [[0.0, 0.0], [1.0, 0.0]]}
    rec = recording("state_space", {"u": u, "other": other}, {"x": y}, parameters, rate_hz=RATE_HZ)
    assert cause(rec) == ("other" if carried else None)
    report = diagnose(rec, jobs=1, effects=[EFFECTS[n] for n in ("dead_time", "first_order_lag")])
    assert report.physics == ()
    assert (report.verdict == "unexplained") is carried


def ringing() -> Recording:
    """A body beside noise that rings as it does."""
    rng = np.random.default_rng(8)
    u, _, noise = rng.standard_normal((3, 6000))
    y, left = swung(u, RATE_HZ), swung(noise, RATE_HZ, 75.0, 1.0)
    left *= 0.3 * np.std(y) / np.std(left)
    y = y + left + 0.02 * np.std(left) * rng.standard_normal(u.size)
    return recording("state_space", {"u": u}, {"x": y}, {**BODY, "B": [[0.0], [1.0]]}, rate_hz=RATE_HZ)


@pytest.mark.parametrize("p_value", [1e-9, 1e-4])
def test_a_rest_is_no_noise_whose_walk_follows_a_signal(p_value: float, monkeypatch: pytest.MonkeyPatch) -> None:
    walk, base = SimpleNamespace(key=1), SimpleNamespace(key=0)
    placed = Placed(EFFECTS["random_walk"], "output", "x", "environment", ("x",))
    follows = {1: (placed, Dependence("u", "value", p_value, 0.3, False))}
    ranked = SimpleNamespace(every_ranked=lambda: [walk, base], base=base, dependent=lambda s: follows.get(s.key))
    found = followed_by(ranked)  # type: ignore[arg-type]
    monkeypatch.setattr(decide, "followed_by", lambda _: found)
    report = diagnose(ringing(), jobs=1, effects=[EFFECTS[n] for n in ("dead_time", "first_order_lag")])
    assert report.verdict == ("unexplained" if p_value < 1e-6 else "agrees")
    if p_value < 1e-6:
        assert report.location.depends_on[0].signal == "u"


def regulated(rng: np.random.Generator) -> tuple[Array, Array]:
    """Return command and reading (n,) of the body under a controller that sees the reading, with its slow noise."""
    a, b, *_ = cont2discrete((np.array(BODY["A"]), np.array([[0.0], [1.0]]), np.eye(2), np.zeros((2, 1))), 1 / RATE_HZ)
    noise = lfilter([1.0], [1.0, -1.9, 0.95], rng.standard_normal(3000))
    wanted = lfilter([0.05], [1.0, -0.95], rng.standard_normal(3000)) * 6.0 * np.std(noise)
    u, y, x, total = np.zeros(3000), np.zeros(3000), np.zeros(2), 0.0
    for k in range(3000):
        y[k] = x[0] + noise[k]
        total += (wanted[k] - y[k]) / RATE_HZ
        u[k] = 300.0 * (wanted[k] - y[k]) + 4000.0 * total
        x = a @ x + b[:, 0] * u[k]
    return u, y


def test_noise_that_a_controller_feeds_back_has_no_cause(monkeypatch: pytest.MonkeyPatch) -> None:
    """Command and noise are alike in every loop. Of 12 records of a true twin at most 3 may have a cause at 5 %."""
    count = 0
    for seed in range(12):
        u, y = regulated(np.random.default_rng(seed))
        rec = recording("state_space", {"u": u}, {"x": y}, {**BODY, "B": [[0.0], [1.0]]}, rate_hz=RATE_HZ)
        problem, given, base = prepared(rec, 0.3, 0, False)
        assert caused_by(problem, base, "x") is None
        with monkeypatch.context() as patch:
            patch.setattr(causes, "LEAST_P", 0.05)
            count += caused_by(problem, given, "x") is not None
    assert count <= 3
