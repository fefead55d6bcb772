"""State-space twins of any order: many modes, several inputs and outputs, constant and unmoved states."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from tests.unit.mismatch_engine.cases import RATE, recording
from tools.errors import RecordingError
from tools.mismatch.recording import Recording
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_view import View
from tools.mismatch.twins.make import make

Array = np.ndarray


def modal(order: int, inputs: int, outputs: int, seed: int) -> tuple[Array, Array, Array]:
    """Lightly damped modes between 3 and 300 rad/s in state coordinates that nobody chose."""
    rng = np.random.default_rng(seed)
    w = np.exp(rng.uniform(np.log(3), np.log(300), order // 2))
    z = np.exp(rng.uniform(np.log(0.005), np.log(0.3), order // 2))
    a = np.zeros((order, order))
    for i in range(order // 2):
        a[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [[0.0, w[i]], [-w[i], -2 * z[i] * w[i]]]
    b, c = rng.standard_normal((order, inputs)), rng.standard_normal((outputs, order))
    turn = np.linalg.qr(rng.standard_normal((order, order)))[0]
    return turn @ a @ turn.T, turn @ b, c @ turn.T


def twin_of(matrices: dict[str, object], inputs: dict[str, Array], outputs: int = 1) -> Recording:
    n = next(iter(inputs.values())).size
    # outputs are stand-ins: from rest nothing of them is used
    return recording("state_space", inputs, {f"y{k}": np.cos(np.arange(n)) for k in range(outputs)}, matrices)


def as_given(rec: Recording) -> Array:
    model = Model(make(rec))
    found = model.simulate(View.whole(rec), model.start(rec))
    return np.stack([found[o] for o in rec.outputs], axis=1)


@pytest.mark.parametrize(("order", "inputs", "outputs"), [(16, 1, 3), pytest.param(64, 2, 2, marks=pytest.mark.slow)])
@pytest.mark.parametrize("discrete", [False, True])
def test_a_high_order_runs_as_its_matrices_do_and_is_written_and_read_again(
    order: int, inputs: int, outputs: int, discrete: bool
) -> None:
    a, b, c = modal(order, inputs, outputs, order)
    rng = np.random.default_rng(1)
    u = {f"u{i}": rng.standard_normal(400) for i in range(inputs)}
    block = np.zeros((order + inputs, order + inputs))
    block[:order, :order], block[:order, order:] = a / RATE, b / RATE
    ad, bd = expm(block)[:order, :order], expm(block)[:order, order:]
    x, want = np.zeros(order), np.empty((400, outputs))
    for k in range(400):
        want[k] = c @ x
        x = ad @ x + bd @ np.array([v[k] for v in u.values()])
    given = {"A": ad, "B": bd, "discrete": True} if discrete else {"A": a, "B": b, "hold": "zero"}
    rec = twin_of(
        {k: v if isinstance(v, bool | str) else v.tolist() for k, v in given.items()} | {"C": c.tolist()}, u, outputs
    )
    got = as_given(rec)
    np.testing.assert_allclose(got, want, atol=1e-7 * float(np.std(want)))
    twin = make(rec)
    assert len(twin.parameters) == order + order * inputs * outputs + outputs
    again = twin_of(dict(twin.to_text(twin.start(rec))), u, outputs)
    assert len(make(again).parameters) == len(twin.parameters)
    np.testing.assert_allclose(as_given(again), want, atol=1e-7 * float(np.std(want)))


def test_more_modes_than_can_be_fitted_are_refused_with_their_number() -> None:
    a, b, c = modal(66, 1, 1, 0)
    with pytest.raises(RecordingError, match="66 modes"):
        make(twin_of({"A": a.tolist(), "B": b.tolist(), "C": c.tolist()}, {"u": np.ones(80)}))


def test_a_state_that_stays_one_is_an_offset() -> None:
    a = [[-20.0, 0.0, 30.0], [10.0, -40.0, 0.0], [0.0, 0.0, 0.0]]
    rec = twin_of(
        {"A": a, "B": [[1.0], [0.0], [0.0]], "C": [[0.0, 1.0, 0.5]], "x0": [0.0, 0.0, 2.0]}, {"u": np.zeros(90)}
    )
    twin = make(rec)
    names = [p.name for p in twin.parameters]
    assert names == ["pole_rate_1", "pole_rate_2", "numerator_0", "y0"]
    # 0.5 * 2 directly, and 30 * 2 / 20 * 10 / 40 through both lags in the long run
    assert twin.start(rec)[-1] == pytest.approx(1.75)
    assert not twin.restart
    t = np.arange(90) / RATE
    lags = np.array(a)[:2, :2]
    want = 1.75 + np.array([[0.0, 1.0] @ expm(lags * s) @ [-3.0, -0.75] for s in t])
    np.testing.assert_allclose(as_given(rec)[:, 0], want, atol=1e-9)


def test_what_is_stable_as_given_has_no_unstable_values_to_search() -> None:
    a, b, c = modal(16, 1, 1, 2)
    twin = make(twin_of({"A": a.tolist(), "B": b.tolist(), "C": c.tolist()}, {"u": np.ones(80)}))
    assert all(p.lo >= 0.0 for p in twin.parameters if p.name.startswith("damping_ratio"))
