"""The emulated world in real time, seen from the firmware's process: starts it, names its buses, fetches its truth."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import socket
import subprocess
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hal.children import child_command, child_environment
from hal.errors import BenchError, DeviceNotFound, Disconnected, HalTimeout
from sim_devices.lateness import LatenessView
from sim_devices.linger import END

if TYPE_CHECKING:  # the physics and its kernels are the other process's
    from sim_devices.world import Truth

START_S = 180.0  # the first start of all compiles the plant
STOP_S = 20.0


class ProcessWorld:
    """A world in real time, in a process of its own. ``runtime_dir`` holds its sockets, log and truth."""

    PROGRAM = "sim_devices.process"

    def __init__(
        self,
        description: dict[str, Any],
        runtime_dir: Path,
        hand_file: str | None,
        hand_scale: float | None,
        plant: str,
    ) -> None:
        runtime_dir.mkdir(parents=True, exist_ok=True)
        self._dir = Path(tempfile.mkdtemp(prefix="world-", dir=runtime_dir))
        # a Unix socket's path has at most 107 characters, however deep the runtime directory is
        self._sockets = Path(tempfile.mkdtemp(prefix="micron-"))
        job = {
            "description": description,
            "runtime_dir": str(self._dir),
            "socket_dir": str(self._sockets),
            "parent": os.getpid(),
            "hand_file": hand_file,
            "hand_scale": hand_scale,
            "plant": plant,
        }
        job_path = self._dir / "job.json"
        job_path.write_text(json.dumps(job), encoding="utf-8")
        self._log = self._dir / "world.log"
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                child_command(self.PROGRAM, str(job_path)),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=child_environment(),
                start_new_session=True,  # signals to the firmware's group are not for its devices
            )
        ready = self._await_endpoints()
        self._endpoints: dict[str, str] = ready["endpoints"]
        self.tcp_ports: dict[str, int] = ready["tcp"]
        self._lateness = LatenessView(self._dir)

    @property
    def pid(self) -> int:
        """Return the process id of the world's process, for tests that kill it."""
        return self._process.pid

    def endpoint(self, bus: str) -> str:
        """Return the URI of ``bus`` for the adapters of hal."""
        return self._endpoints[bus]

    def alive(self) -> bool:
        return self._process.poll() is None

    def stop(self) -> None:
        """End the process; when this returns the truth is on disk. Idempotent."""
        if self.alive():
            self._process.send_signal(END)
        try:
            self._process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        shutil.rmtree(self._sockets, ignore_errors=True)

    def truth(self) -> Truth:
        """Return the physical truth. Call it after ``stop``. Raises ``Disconnected`` when the process was killed before
        it could write."""
        path = self._dir / "truth.npz"
        if not path.exists():
            raise Disconnected(f"the emulated world was killed and left no truth; its log: {self._tail()}")
        with np.load(path) as data:
            return {name: data[name] for name in data.files}

    def stalled_ms(self, now_ns: int, within_ms: float) -> float:
        """Return the duration in ms of a stall of the world's process at ``now_ns`` or up to ``within_ms`` before.

        Returns 0 if there is none, or if the process is dead."""
        return self._lateness.stalled_ms(now_ns, within_ms) if self.alive() else 0.0

    def stalls(self) -> tuple[int, float]:
        """Return the number of stalls of the world's process and the duration of the longest one in ms."""
        return self._lateness.stalls, self._lateness.longest_ms

    def statistics(self) -> dict[str, float]:
        """Return, after ``stop``, ``worst_late_us`` (largest lateness of the world), ``turns`` of its loop and
        ``cpu_s``."""
        path = self._dir / "world.json"
        return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}

    def inject(self, fault: str, target: str = "") -> None:
        """Do one of ``sim_devices.faults.FAULTS`` in the running process; ``ValueError`` says why not."""
        self.control({"fault": fault, "target": target})

    @property
    def control_path(self) -> Path:
        """Return the path of the socket that takes orders; it lies in the folder of all sockets of this world."""
        return self._sockets / "control.sock"

    def control(self, order: dict[str, Any]) -> dict[str, Any]:
        """Give one order of ``sim_devices.control`` and return its answer; ``ValueError`` says why it was refused."""
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        with contextlib.closing(sock):
            sock.settimeout(5.0)
            try:
                sock.connect(str(self.control_path))
                sock.sendall(json.dumps(order).encode() + b"\n")
                answer = json.loads(sock.makefile("rb").readline())
            except TimeoutError as error:
                raise HalTimeout("the emulated world does not answer on its control socket") from error
            except (OSError, ValueError) as error:
                raise Disconnected("the emulated world is gone") from error
        if not answer["ok"]:
            raise ValueError(answer["error"])
        return answer

    def _await_endpoints(self) -> dict[str, Any]:
        path = self._dir / "endpoints.json"
        deadline = time.monotonic() + START_S
        while not path.exists():
            if not self.alive():
                shutil.rmtree(self._sockets, ignore_errors=True)
                refusal = self._dir / "error.txt"
                if refusal.exists():
                    raise BenchError(refusal.read_text(encoding="utf-8"))
                raise BenchError(f"the emulated world did not start: {self._tail()}")
            if time.monotonic() > deadline:
                self.stop()
                raise DeviceNotFound(f"the emulated world was not ready in {START_S:.0f} s: {self._tail()}")
            time.sleep(0.01)
        return json.loads(path.read_text(encoding="utf-8"))

    def _tail(self) -> str:
        lines = self._log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return lines[-1] if lines else "(empty log)"
