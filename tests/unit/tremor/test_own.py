"""An estimator of another package that does not keep to the rules is refused by name, before anything runs."""

from __future__ import annotations

from typing import Any

import pytest

from firmware_py.tremor import own
from firmware_py.tremor.config import TremorConfig
from hal.errors import BenchError
from tools.cli.run import estimator_name
from tools.errors import InputError


def step(memory: Any, numbers: Any, sample: float, have: bool, out: Any) -> None:
    out[0] = sample


def uncompilable(memory: Any, numbers: Any, sample: float, have: bool, out: Any) -> None:
    out[0] = {}.nothing  # pyright: ignore


def params(monkeypatch: pytest.MonkeyPatch, numbers: Any, code: Any = step) -> Any:
    monkeypatch.setattr(own, "load", lambda group, name, kind: own.OwnEstimator(lambda config: numbers, code))
    return own.own_params(TremorConfig.model_construct(method="mine"))


@pytest.mark.parametrize("numbers", [[0.0] * 65, [float("nan")], [1.0, float("inf")], [[1.0, 2.0]]], ids=str)
def test_a_design_is_up_to_64_finite_numbers(monkeypatch: pytest.MonkeyPatch, numbers: Any) -> None:
    with pytest.raises(BenchError, match="estimator 'mine': its design must be up to 64 finite numbers"):
        params(monkeypatch, numbers)


def test_a_step_that_cannot_be_compiled_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(BenchError, match=r"step tests\.unit\.tremor\.test_own\.uncompilable cannot be compiled"):
        params(monkeypatch, [1.0], uncompilable)


def test_numbers_are_kept_and_the_rest_is_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    made = params(monkeypatch, [1.0] * 63 + [2.0])
    assert made["address"][0] != 0
    assert made["numbers"][0].tolist() == [1.0] * 63 + [2.0]


def test_options_of_a_method_that_was_built_in_are_read_from_their_former_table() -> None:
    """Benches and recordings of versions before have one; those of other methods say nothing and are dropped."""
    config = TremorConfig.from_dict({"method": "ebmflc", "bmflc": {"memory_s": 0.2}, "ar": {"order": 4}})
    assert config.own == {"memory_s": 0.2}
    assert TremorConfig.from_dict({"kalman": {"drift_s": 2.0}}) == TremorConfig()
    with pytest.raises(BenchError, match=r"\[memory\] unknown key"):
        own.own_params(TremorConfig(method="ebmflc", own={"memory": 0.2}))


def test_an_installed_wheel_says_where_a_baseline_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("firmware_py.tremor.config.offered", lambda group: {})
    with pytest.raises(BenchError, match=r"'bmflc' is an estimator to compare with: only a source tree has it"):
        TremorConfig.from_dict({"method": "bmflc"})
    with pytest.raises(InputError, match=r"'bmflc' is an estimator to compare with: only a source tree has it"):
        estimator_name("bmflc")
