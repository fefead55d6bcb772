"""Implements the host's side of a guest: it starts the process, asks it, and turns its death into one clear message."""

from __future__ import annotations

import os
import select
import shutil
import signal
import subprocess
import tempfile
import time
import weakref
from collections.abc import Mapping
from dataclasses import dataclass
from typing import IO, Any

import numpy as np

from hal.arrays import Array
from hal.children import child_command, child_environment
from tools.errors import InputError
from tools.guest.frames import SIZES_BYTES, FrameError, frame_parts, read_parts, read_sizes


class GuestError(InputError):
    """The guest said what is wrong. ``kind`` is the name of its exception."""

    def __init__(self, message: str, kind: str) -> None:
        super().__init__(message)
        self.kind = kind


class GuestDied(InputError):
    """The guest crashed, ended itself or did not answer."""


@dataclass(frozen=True)
class Limits:
    """The limits of a guest. ``seconds`` is per request, ``seconds_per_sample`` is added for each sample of a run."""

    memory_bytes: int = 2 << 30
    seconds: float = 60.0
    seconds_per_sample: float = 1e-3


class GuestProcess:
    """A program of somebody else in a process of its own, started at the first request.

    ``name`` stands in messages. ``opening`` is the request that opens the program; it is repeated in a new process
    after the old one died, and in every process that gets a copy of this object.
    """

    def __init__(self, name: str, opening: Mapping[str, Any], limits: Limits = Limits()) -> None:
        self.name, self.opening, self.limits = name, dict(opening), limits
        self._process: subprocess.Popen[bytes] | None = None
        self._stderr: Any = None
        self._folder = ""
        self._opened: tuple[dict[str, Any], dict[str, Array]] | None = None

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_process": None, "_stderr": None, "_folder": "", "_opened": None}

    def opened(self) -> tuple[dict[str, Any], dict[str, Array]]:
        """Return the answer to the opening request. ``GuestError`` or ``GuestDied`` when it cannot be opened."""
        if self._process is None or self._opened is None:
            self._start()
            self._opened = self._ask(self.opening, {}, self.limits.seconds)
        return self._opened

    def run(self, arrays: Mapping[str, Array], parameters: Mapping[str, Any]) -> dict[str, Array]:
        """Return the outputs of one free run, each in the shape that the guest gave it."""
        self.opened()
        samples = max((x.size for x in arrays.values()), default=0)
        limit_s = self.limits.seconds + samples * self.limits.seconds_per_sample
        plain = {k: v.item() if isinstance(v, np.generic) else v for k, v in parameters.items()}
        head, found = self._ask({"ask": "run", "parameters": plain}, arrays, limit_s)
        shapes = head.get("shapes", {})
        try:
            return {o: y.reshape(shapes[o]) for o, y in found.items()}
        except (KeyError, ValueError, TypeError) as error:
            raise self._dead("answered with something that is no run", "") from error

    def end(self) -> None:
        """End the process, if there is one."""
        if self._process is not None:
            _end(self._process, self._stderr, self._folder)
            self._process = None
            self._opened = None

    def _start(self) -> None:
        self.end()
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 - it is read when the process has died
        # its unpacked files are removed here: a guest is killed and cannot remove them
        self._folder = tempfile.mkdtemp(prefix="micron-guest-")
        environment = child_environment() | {"TMPDIR": self._folder}
        # one program needs one thread, and each thread of a linear algebra library takes memory from its limit
        environment.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))
        self._process = subprocess.Popen(
            child_command("tools.guest.process", str(self.limits.memory_bytes)),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            env=environment,
            start_new_session=True,  # Ctrl-C is for the host, which ends its guest
        )
        assert self._process.stdin is not None
        os.set_blocking(self._process.stdin.fileno(), False)  # a guest that never reads must not hold us
        weakref.finalize(self, _end, self._process, self._stderr, self._folder)

    def _ask(
        self, head: Mapping[str, Any], arrays: Mapping[str, Array], limit_s: float
    ) -> tuple[dict[str, Any], dict[str, Array]]:
        process = self._process
        assert process is not None
        until_s = time.monotonic() + limit_s
        try:
            for part in frame_parts(head, arrays):
                self._write(memoryview(part), until_s)
            head_bytes, body_bytes = read_sizes(bytes(self._read(SIZES_BYTES, until_s)))
            # more than a guest may own cannot be an answer
            if body_bytes > self.limits.memory_bytes:
                raise FrameError(f"an answer of {body_bytes} bytes")
            reply, found = read_parts(bytes(self._read(head_bytes, until_s)), self._read(body_bytes, until_s))
        except TimeoutError as error:
            raise self._dead(f"did not answer within {limit_s:.0f} s and was ended", "") from error
        except (BrokenPipeError, EOFError) as error:
            raise self._dead(*self._how_it_ended()) from error
        except FrameError as error:
            raise self._dead(f"sent {error}", "") from error
        if "error" in reply:
            raise GuestError(str(reply.get("message", "")), str(reply["error"]))
        return reply, found

    def _write(self, data: memoryview, until_s: float) -> None:
        process = self._process
        assert process is not None
        assert process.stdin is not None
        handle = process.stdin.fileno()
        while data:
            left_s = until_s - time.monotonic()
            if left_s <= 0 or not select.select([], [handle], [], left_s)[1]:
                raise TimeoutError
            data = data[os.write(handle, data) :]

    def _read(self, size: int, until_s: float) -> bytearray:
        process = self._process
        assert process is not None
        assert process.stdout is not None
        handle, data = process.stdout.fileno(), bytearray(size)
        view, at = memoryview(data), 0
        while at < size:
            left_s = until_s - time.monotonic()
            if left_s <= 0 or not select.select([handle], [], [], left_s)[0]:
                raise TimeoutError
            count = os.readv(handle, [view[at:]])
            if count == 0:
                raise EOFError
            at += count
        return data

    def _how_it_ended(self) -> tuple[str, str]:
        assert self._process is not None
        try:
            status = self._process.wait(timeout=5.0)
        except subprocess.TimeoutExpired:
            return "closed its pipe without an answer", ""
        self._stderr.seek(0)
        lines = self._stderr.read()[-2000:].decode("utf-8", "replace").strip().splitlines()
        last = lines[-1][:200] if lines else ""
        if status < 0:
            return f"crashed ({signal.Signals(-status).name})", last
        return f"ended its process with status {status} instead of an answer", last

    def _dead(self, what: str, last: str) -> GuestDied:
        self.end()
        tail = f"; its last line was: {last}" if last else ""
        return GuestDied(f"{self.name}: the program {what}{tail}; repair it, or leave it out")


def _end(process: subprocess.Popen[bytes], stderr: IO[bytes], folder: str) -> None:
    """Kill the process and all that it started; close what leads to it, and remove its temporary files."""
    if process.poll() is None:
        try:
            os.killpg(process.pid, signal.SIGKILL)
        except ProcessLookupError:
            process.kill()
    process.wait()
    for pipe in (process.stdin, process.stdout, stderr):
        if pipe is not None:
            try:
                pipe.close()
            except OSError:
                continue
    shutil.rmtree(folder, ignore_errors=True)
