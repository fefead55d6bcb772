"""A guest that crashes, hangs, lies or eats memory is one message; what it answers is taken as numbers only."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from tools.guest.equations import builder_of
from tools.guest.frames import FrameError, frame_parts, read_parts, read_sizes
from tools.guest.host import GuestDied, GuestError, GuestProcess, Limits

U = np.linspace(0.0, 1.0, 50)


def module(body: str, limits: Limits = Limits()) -> GuestProcess:
    opening = {"ask": "open_module", "path": "twin.py", "source": body, "dt": 0.1}
    return GuestProcess("her/twin.py", opening, limits)


def simulate(line: str) -> str:
    return f"import os, sys, ctypes\nimport numpy as np\ndef simulate(inputs, dt):\n    {line}\n"


def test_it_runs_and_its_prints_do_not_get_between_its_answers() -> None:
    guest = module(simulate("print('hello', flush=True); return {'y': 2 * inputs['u'], 'dt': np.float64(dt)}"))
    try:
        for k in (1.0, 3.0):
            found = guest.run({"u": k * U}, {"gain": np.float64(1.0)})
            np.testing.assert_array_equal(found["y"], 2 * k * U)
            assert found["dt"] == 0.1
    finally:
        guest.end()


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("ctypes.string_at(0)", "crashed (SIGSEGV)"),
        ("os.abort()", "crashed (SIGABRT)"),
        ("os._exit(0)", "ended its process with status 0"),
        (
            "sys.stderr.write('stack smashed'); sys.stderr.flush(); os._exit(3)",
            "answer; its last line was: stack",
        ),
        ("os.write(3, b'x' * 64)", "sent a message with a head of"),
    ],
)
def test_a_death_is_one_message_that_names_the_program(line: str, message: str) -> None:
    guest = module(simulate(line), Limits(seconds=20.0))
    with pytest.raises(GuestDied) as caught:
        guest.run({"u": U}, {})
    assert message in str(caught.value)
    assert str(caught.value).startswith("her/twin.py: the program ")
    assert len(str(caught.value).splitlines()) == 1
    assert guest._process is None


def test_its_temporary_files_go_with_it() -> None:
    """However it ends: it is killed, and so it tidies nothing up itself."""
    line = "import tempfile; at = tempfile.mkdtemp(); return {'at': np.frombuffer(at.encode(), np.uint8) * 1.0}"
    guest = module(simulate(line))
    folder = Path(bytes(guest.run({"u": U}, {})["at"].astype(np.uint8)).decode())
    assert folder.is_dir()
    guest.end()
    assert not folder.parent.exists()
    crashing = module(simulate("ctypes.string_at(0)"))
    with pytest.raises(GuestDied):
        crashing.run({"u": U}, {})
    assert not Path(crashing._folder).exists()


def test_an_endless_loop_is_ended_at_its_limit() -> None:
    guest = module(simulate("while True: pass"), Limits(seconds=3.0, seconds_per_sample=0.0))
    with pytest.raises(GuestDied, match="did not answer within 3 s and was ended"):
        guest.run({"u": U}, {})
    assert guest._process is None


def test_memory_above_the_limit_is_not_had() -> None:
    guest = module(simulate("x = [bytearray(1 << 28) for _ in range(64)]"), Limits(memory_bytes=1 << 30))
    with pytest.raises(GuestError, match="no memory is left below its limit"):
        guest.run({"u": U}, {})
    guest.end()


def test_what_it_raises_is_said_and_it_goes_on() -> None:
    guest = module(simulate("return {'y': inputs['u'] / inputs['u'].size} if dt > 1 else missing"))
    with pytest.raises(GuestError, match="missing") as caught:
        guest.run({"u": U}, {})
    assert caught.value.kind == "NameError"
    with pytest.raises(GuestError, match="missing"):
        guest.run({"u": U}, {})
    guest.end()


def test_a_dead_one_starts_again_and_a_copy_starts_its_own() -> None:
    guest = module(simulate("os._exit(1) if inputs['u'][0] else None; return {'y': inputs['u'], 'pid': os.getpid()}"))
    first = guest.run({"u": U}, {})["pid"]
    with pytest.raises(GuestDied):
        guest.run({"u": 1 + U}, {})
    second = guest.run({"u": U}, {})["pid"]
    copy = pickle.loads(pickle.dumps(guest))
    third = copy.run({"u": U}, {})["pid"]
    assert len({float(first), float(second), float(third)}) == 3
    guest.end()
    copy.end()


def test_nothing_of_it_runs_here(tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    here = f"open({str(mark)!r}, 'w').write(str(__import__('os').getpid()))\n"
    guest = module(here + simulate("return {'y': inputs['u']}"))
    guest.run({"u": U}, {})
    pid = guest._process.pid if guest._process else 0
    assert int(mark.read_text()) == pid
    guest.end()


@pytest.mark.parametrize(
    ("head", "body"),
    [
        (b"no json", b""),
        (b"[]", b""),
        (b'{"arrays": [["y", 2]]}', bytes(8)),
        (b'{"arrays": [["y", -1], ["z", 2]]}', bytes(8)),
        (b'{"arrays": 3}', b""),
        (b"[" * 100_000, b""),
    ],
)
def test_answers_that_do_not_fit_are_refused(head: bytes, body: bytes) -> None:
    with pytest.raises(FrameError):
        read_parts(head, body)


def test_a_message_comes_back() -> None:
    data = b"".join(frame_parts({"a": 1}, {"u": U, "none": np.zeros(0)}))
    head, body = read_sizes(data[:16])
    said, found = read_parts(data[16 : 16 + head], data[16 + head :])
    assert said == {"a": 1}
    assert body == U.nbytes
    np.testing.assert_array_equal(found["u"], U)


@pytest.mark.parametrize(
    ("operations", "results"),
    [
        ([[0, 5, 0, 1, 0]], {"x": 2}),  # writes beyond the registers
        ([[0, 2, -1, 1, 0]], {"x": 2}),
        ([[99, 2, 0, 1, 0]], {"x": 2}),
        ([[0, 2, 0, 1, 0]], {"x": 3}),
        ([[0, 1, 0, 1, 0]], {"x": 2}),  # writes to a variable
    ],
)
def test_operations_that_reach_beyond_their_registers_are_refused(operations: list, results: dict) -> None:
    with pytest.raises(ValueError, match=r"register|variable"):
        builder_of(("a", "b"), operations, np.zeros(3), results)
    assert builder_of(("a", "b"), [[0, 2, 0, 1, 0]], np.zeros(3), {"x": 2})[1] == {"x": 2}
