"""The cascade network: transfer functions, the runtime kernel against plain matrices, training, the weights file."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import special

from firmware_py.records import attributes
from hal.errors import BenchError
from tools.research.tremor.activations import KINDS, activation, bessel_j0, bessel_j1, slope
from tools.research.tremor.cascade import Cascade, CascadeNetwork, cascade_kernel
from tools.research.tremor.cascade_file import load_network, network_text
from tools.research.tremor.cascade_kernels import candidate_score, ndekf_pass, quickprop
from tools.research.tremor.cascade_training import Paths, Training, train, windows


def network(units: int = 2, **changes: object) -> CascadeNetwork:
    rng = np.random.default_rng(8)
    window, wide = 5, 6 + units
    hidden = np.tril(rng.standard_normal((units, wide)), 5)
    made = CascadeNetwork(
        window, 2, 250.0, "voluntary", 1e-4, False, KINDS[1 : 1 + units], hidden, rng.standard_normal(wide)
    )
    return replace(made, **changes)


def plain(net: CascadeNetwork, path: np.ndarray) -> np.ndarray:
    """The network written with matrices, from Ang 2004 Fig. 5.6."""
    x = windows(path, net.window, net.spacing)
    middle = x.mean(axis=1) if net.centred else np.zeros(len(x))
    features = np.concatenate([np.ones((len(x), 1)), (x - middle[:, None]) / net.scale], axis=1)
    for h, kind in enumerate(net.kinds):
        s = features @ net.hidden[h, : features.shape[1]]
        unit = {"gaussian": np.exp(-0.5 * s**2), "sine": np.sin(s), "bessel": special.j0(s), "sigmoid": np.tanh(s)}[
            kind
        ]
        features = np.column_stack([features, unit])
    out = features @ net.output * net.scale
    newest = path[(net.window - 1) * net.spacing :]
    return out if net.target == "error" else newest - out - middle


@pytest.mark.parametrize("x", [-40.0, -7.7, -3.0, -0.4, 0.0, 1.3, 2.999, 3.001, 25.0])
def test_bessel_functions(x: float) -> None:
    assert bessel_j0(x) == pytest.approx(special.j0(x), abs=1e-7)
    assert bessel_j1(x) == pytest.approx(special.j1(x), abs=1.5e-7)


@pytest.mark.parametrize("kind", range(len(KINDS)))
def test_slopes_by_finite_differences(kind: int) -> None:
    for s in (-2.3, -0.4, 0.7, 1.9):
        numeric = (activation(kind, s + 1e-4) - activation(kind, s - 1e-4)) / 2e-4
        assert slope(kind, s) == pytest.approx(numeric, abs=2e-3 if kind == 3 else 1e-7)


@pytest.mark.parametrize("changes", [{}, {"centred": True}, {"target": "error"}])
def test_runtime_kernel_is_the_network(changes: dict[str, object]) -> None:
    net = network(**changes)
    path = np.cumsum(np.random.default_rng(3).standard_normal(60)) * 1e-5
    found = Cascade(net).run(path)
    filled = net.window * net.spacing - 1
    assert np.all(found[:filled] == 0.0)
    expected = plain(net, path)[filled - (net.window - 1) * net.spacing :]
    np.testing.assert_allclose(found[filled:], expected, rtol=1e-6, atol=1e-12)


def test_python_twin_of_the_kernel() -> None:
    net = network()
    path = np.random.default_rng(4).standard_normal(30) * 1e-4
    compiled, twin = Cascade(net), Cascade(net)
    state, params = attributes(twin.state)[0], attributes(twin.params)[0]
    step = cascade_kernel.py_func  # pyright: ignore[reportFunctionMemberAccess]
    np.testing.assert_allclose([step(p, state, params) for p in path], compiled.run(path), rtol=1e-12)


def test_centred_network_does_not_care_where_the_hand_is() -> None:
    net = network(centred=True)
    path = np.random.default_rng(5).standard_normal(40) * 1e-4
    np.testing.assert_allclose(Cascade(net).run(path + 0.02), Cascade(net).run(path), atol=1e-12)


@pytest.mark.parametrize("kind", range(len(KINDS)))
def test_gradient_of_a_candidate_by_finite_differences(kind: int) -> None:
    rng = np.random.default_rng(6)
    inputs, residual = rng.standard_normal((200, 4)), rng.standard_normal(200)
    residual = (residual - residual.mean()) / residual.std()
    weights = rng.standard_normal(4) * 0.7
    gradient, unused = np.zeros(4), np.zeros(4)
    candidate_score(inputs, residual, kind, weights, gradient)
    for j in range(4):
        up, down = weights.copy(), weights.copy()
        up[j] += 1e-4
        down[j] -= 1e-4
        rise = candidate_score(inputs, residual, kind, up, unused) - candidate_score(
            inputs, residual, kind, down, unused
        )
        assert gradient[j] == pytest.approx(rise / 2e-4, abs=2e-4 if kind == 3 else 1e-6)


def test_quickprop_finds_a_hidden_sine() -> None:
    rng = np.random.default_rng(7)
    inputs = np.column_stack([np.ones(800), rng.standard_normal((800, 3))])
    target = np.sin(inputs @ np.array([0.3, 1.4, -0.8, 0.0]))
    residual = (target - target.mean()) / target.std()
    best = max(quickprop(inputs, residual, 2, rng.standard_normal(4), 100, 2.0) for _ in range(6))
    assert best > 0.98


def test_filtering_without_hidden_unit_is_regularised_least_squares() -> None:
    rng = np.random.default_rng(8)
    features = rng.standard_normal((300, 5))
    target = features @ np.array([1.0, -2.0, 0.5, 0.0, 3.0]) + 0.1 * rng.standard_normal(300)
    output, spread = np.zeros(5), np.eye(5) * 4.0
    nothing = np.zeros(0)
    ndekf_pass(features, target, np.arange(300), output, spread, nothing, np.eye(1), 0, 0.01, 0.0)
    normal = features.T @ features / 0.01 + np.eye(5) / 4.0
    np.testing.assert_allclose(output, np.linalg.solve(normal, features.T @ target / 0.01), rtol=1e-8)
    np.testing.assert_allclose(spread, np.linalg.inv(normal), rtol=1e-6, atol=1e-12)


def made_paths(seed: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Slow motion with a fast, nonlinear disturbance."""
    rng = np.random.default_rng(seed)
    slow = np.convolve(rng.standard_normal(n + 199), np.hanning(200) / 8.0, "valid")
    t = np.arange(n)
    return 1e-4 * (slow + np.sin(0.6 * t + 2.0 * np.sin(0.01 * t))), 1e-4 * slow


def test_training_removes_a_disturbance_and_survives_the_file(tmp_path: Path) -> None:
    fit, hold = Paths((made_paths(1, 1500),)), Paths((made_paths(2, 700),))
    how = Training(window=12, units=1, candidate_rows=300, epochs=10, restarts=1)
    trained = train(fit, hold, 250.0, how, "made up")
    assert trained.validation_error[0] < 0.25
    assert min(trained.validation_error) == trained.validation_error[len(trained.network.kinds)]
    measured, wanted = made_paths(3, 800)
    left = (measured - wanted - Cascade(trained.network).run(measured))[20:]
    assert np.std(left) < 0.3 * np.std((measured - wanted)[20:])
    file = tmp_path / "network.json"
    file.write_text(network_text(trained.network))
    again = load_network(file)
    np.testing.assert_array_equal(Cascade(again).run(measured), Cascade(trained.network).run(measured))
    assert again.note == "made up"


def test_same_seed_same_network() -> None:
    paths = Paths((made_paths(1, 600),)), Paths((made_paths(2, 400),))
    how = Training(window=6, units=2, candidate_rows=200, epochs=5, restarts=1, patience=2)
    one, two = (train(*paths, 250.0, how) for _ in range(2))
    assert network_text(one.network) == network_text(two.network)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda t: t.pop("output"), "output"),
        (lambda t: t.update(format=2), "format"),
        (lambda t: t.update(kinds=["cosine"] * 2), "unknown kind"),
        (lambda t: t["hidden"].pop(), "1 rows of hidden weights"),
        (lambda t: t["hidden"][1].pop(), "hidden unit 1"),
        (lambda t: t["output"].pop(), "weights"),
        (lambda t: t.update(scale_m=-1.0), "scale_m"),
    ],
)
def test_bad_weights_files_are_named(tmp_path: Path, change: object, expected: str) -> None:
    table = json.loads(network_text(network()))
    change(table)  # type: ignore[operator]
    file = tmp_path / "bad.json"
    file.write_text(json.dumps(table))
    with pytest.raises(BenchError, match=expected):
        load_network(file)


def test_no_such_weights_file(tmp_path: Path) -> None:
    with pytest.raises(BenchError, match="micron tremor train"):
        load_network(tmp_path / "nothing.json")


def test_too_short_a_path() -> None:
    short = Paths((made_paths(1, 50),))
    with pytest.raises(ValueError, match="too short"):
        train(short, short, 250.0, Training(window=40))
