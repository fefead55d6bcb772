"""A kernel calls another one at its address, or the row of a table that its state is made for."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest

from hal.compiled import kernel
from hal.kernel_calls import ChosenKernel, call_entry, entry


class Row(NamedTuple):
    step: Any


@kernel
def one(given: float, state: Any, params: Any) -> float:
    state.a.x += given * params.k
    return 1.0


@kernel
def two(given: float, state: Any, params: Any) -> float:
    state.b[0] += given + params.k
    return 2.0


TABLE = {"a": Row(one), "b": Row(two)}
step = ChosenKernel(TABLE, "step")


@kernel
def stage(frame: Any, states: Any, params: Any) -> None:
    frame[0] += step(2.0, states[0], params[0])
    if frame[0] > 100.0:
        raise ValueError("too far")


@kernel
def caller(memory: Any) -> None:
    m = memory[0]
    call_entry(m.entry, m.frame, m.state, m.params)


def memory(state: list[Any]) -> Any:
    """Return a frame, a state and parameters in one record, bound to ``stage``."""
    fields: list[Any] = [
        ("frame", "f8", (2,)),
        ("state", state, (1,)),
        ("params", [("k", "f8")], (1,)),
        ("entry", "i8"),
    ]
    made = np.zeros(1, fields)
    made["params"] = 3.0
    made["entry"] = entry(stage, made["frame"][0], made["state"][0], made["params"][0])
    return made


def test_each_state_has_its_row_and_no_other_is_compiled() -> None:
    a = memory([("a", [("x", "f8")])])
    caller(a)
    caller(a)
    # of ``one`` nothing can be said: where its caller comes from the cache, it is not compiled either
    assert not two.signatures  # type: ignore[attr-defined]
    assert (a["frame"][0, 0], a["state"]["a"]["x"].item()) == (2.0, 12.0)
    b = memory([("b", "f8", (2,))])
    caller(b)
    assert (b["frame"][0, 0], b["state"]["b"].ravel().tolist()) == (2.0, [5.0, 0.0])


def test_what_is_raised_behind_an_address_reaches_python() -> None:
    a = memory([("a", [("x", "f8")])])
    a["frame"] = 200.0
    with pytest.raises(ValueError, match="too far"):
        caller(a)


def test_the_plain_python_twin_chooses_the_same_row() -> None:
    state, params = np.zeros(1, [("b", "f8", (2,))]).view(np.recarray), np.ones(1, [("k", "f8")]).view(np.recarray)
    assert step(2.0, state[0], params[0]) == 2.0
    assert state[0].b[0] == 3.0
