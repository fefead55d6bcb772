"""Long compilation is told, short is not, and reading from disk is no compilation."""

from __future__ import annotations

import re
import threading

import numba
import pytest

from hal.compile_notice import PATIENCE_S, REPEAT_S, CompileNotice


def test_it_speaks_after_its_patience_and_then_now_and_again(capsys: pytest.CaptureFixture[str]) -> None:
    now_s = [100.0]
    notice = CompileNotice(lambda: now_s[0])
    for wait_s in (0.4 * PATIENCE_S, 0.4 * PATIENCE_S):  # time between compilations does not count
        notice.on_start(None)
        now_s[0] += wait_s
        notice.on_end(None)
        now_s[0] += 60.0
    assert capsys.readouterr().err == ""
    notice.on_start(None)
    now_s[0] += 0.3 * PATIENCE_S
    notice.on_start(None)  # a kernel within a kernel
    first = capsys.readouterr().err
    assert re.fullmatch(r"compiling kernels, .*: 2 done, 2 s\n", first)
    notice.on_end(None)
    now_s[0] += REPEAT_S
    notice.on_end(None)
    assert capsys.readouterr().err.endswith(": 4 done, 12 s\n")


def test_one_long_kernel_is_told_while_it_compiles(capsys: pytest.CaptureFixture[str]) -> None:
    """A kernel of minutes raises no event between its start and its end."""
    now_s = [0.0]
    looked = threading.Event()

    def clock() -> float:
        if threading.current_thread() is not threading.main_thread():
            looked.set()
        return now_s[0]

    notice = CompileNotice(clock, every_s=0.01)
    notice.on_start(None)
    now_s[0] = 1.5 * PATIENCE_S
    said = ""
    for _ in range(500):
        looked.clear()
        assert looked.wait(10.0), "nobody looks at the clock"
        said += capsys.readouterr().err
        if said.endswith("\n"):
            break
    assert re.fullmatch(r"compiling kernels, .*: 0 done, 3 s\n", said)
    notice.on_end(None)
    looked.clear()
    assert not looked.wait(0.1), "the timer ends with the kernel"


def test_numba_tells_it() -> None:
    heard = []

    class Ears(CompileNotice):
        def on_end(self, event) -> None:
            heard.append(event.data["dispatcher"].py_func.__name__)
            super().on_end(event)

    ears = Ears()
    ears.listen()
    try:

        @numba.njit
        def one_more(a: int) -> int:
            return a + 1

        assert one_more(1) == 2
    finally:
        numba.core.event.unregister("numba:compile", ears)
    assert heard == ["one_more"]
