"""An estimator of another package that does not keep to the rules is refused by name, before anything runs."""

from __future__ import annotations

from typing import Any

import pytest

from firmware_py.tremor import own
from firmware_py.tremor.config import TremorConfig
from hal.errors import BenchError


def step(memory: Any, numbers: Any, sample: float, have: bool, out: Any) -> None:
    out[0] = sample


def uncompilable(memory: Any, numbers: Any, sample: float, have: bool, out: Any) -> None:
    out[0] = {}.nothing  # pyright: ignore


def params(monkeypatch: pytest.MonkeyPatch, numbers: Any, code: Any = step) -> Any:
    monkeypatch.setattr(own, "load", lambda group, name, kind: own.OwnEstimator(lambda config: numbers, code))
    return own.own_params(TremorConfig.model_construct(method="mine"))


def test_a_built_in_method_has_no_code_of_its_own() -> None:
    assert own.own_params(TremorConfig(method="adaptive"))["address"][0] == 0


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
