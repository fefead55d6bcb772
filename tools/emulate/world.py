"""A bench's emulated devices as a process of their own, and where each bus is."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from drivers.specs import check_devices
from hal.bench import BenchFile
from hal.errors import BenchError
from sim_devices.process_world import ProcessWorld
from sim_devices.register import provider
from sim_devices.transports.i2c_shim import build_shim, number_buses
from tools.emulate.stimulus import Stimulus
from tools.errors import InputError

PROVIDER = "sim_devices.register:provider"
INTERFACES = Path("/sys/class/net")
ARPHRD_CAN = "280"
TRUTH_S = 60.0
"""Duration of the physical truth that is kept: a server runs for days."""


@dataclass(frozen=True)
class ServedBus:
    """Describes one emulated bus: ``uri`` is for our own adapters, ``places`` say how other programs open it."""

    name: str
    kind: str
    uri: str
    parts: tuple[str, ...]
    places: tuple[str, ...]


@dataclass
class Served:
    """Holds a running world. A program needs ``environment`` to see its buses; ``notes`` are for a person."""

    world: ProcessWorld
    buses: list[ServedBus]
    environment: dict[str, str] = field(default_factory=dict[str, str])
    notes: list[str] = field(default_factory=list[str])

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON form of ``micron emulate``."""
        return {
            "format": 1,
            "buses": {
                b.name: {"kind": b.kind, "uri": b.uri, "parts": list(b.parts), "places": list(b.places)}
                for b in self.buses
            },
            "control": str(self.world.control_path),
            "environment": self.environment,
            "pid": self.world.pid,
        }


def vcan_interfaces() -> list[str]:
    """Return the virtual CAN interfaces of this machine that are up."""
    interfaces = [path for path in sorted(INTERFACES.glob("vcan*")) if _line(path / "type") == ARPHRD_CAN]
    return [path.name for path in interfaces if int(_line(path / "flags") or "0", 16) & 1]


def _line(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii").strip()
    except OSError:
        return ""


@contextmanager
def serve(
    bench: BenchFile,
    *,
    tcp_port: int | None = None,
    can: Sequence[str] | None = None,
    stimuli: Sequence[Stimulus] = (),
    needs_shim: bool = False,
) -> Iterator[Served]:
    """Serve every emulated bus of ``bench`` until the block ends. Raises ``BenchError`` and ``InputError``.

    ``tcp_port`` is that of the first serial bus, 0 for free ones; ``can`` None takes the machine's vcan interfaces.
    ``needs_shim`` makes a missing C compiler an error instead of a note.
    """
    description = bench.description
    if description.emulation.get("provider", PROVIDER) != PROVIDER:
        raise InputError(f"{bench.path}: [emulation.provider] must be '{PROVIDER}' here; micron run runs other ones")
    emulated = description.emulated_buses()
    if not emulated:
        raise InputError(f"{bench.path}: no bus is emulated; give a bus the URI sim://NAME")
    check_devices(description, str(bench.path))
    interfaces = vcan_interfaces() if can is None else list(can)
    table = {**description.model_dump(), "folder": str(bench.path.parent)}
    serve_table = {"tcp_port": tcp_port, "can": interfaces}
    table["emulation"] = {"truth_s": TRUTH_S, **table["emulation"], "serve": serve_table}
    with tempfile.TemporaryDirectory(prefix="micron-") as folder:
        world = provider(table, clock=None, runtime_dir=Path(folder), hand_file=None, hand_scale=None)
        assert isinstance(world, ProcessWorld)
        try:
            served = Served(world, [])
            _describe(served, bench, emulated, needs_shim=needs_shim)
            _play(world, stimuli, Path(folder))
            yield served
        finally:
            world.stop()


def _play(world: ProcessWorld, stimuli: Sequence[Stimulus], folder: Path) -> None:
    for i, stimulus in enumerate(stimuli):
        file = folder / f"stimulus-{i}.npz"
        np.savez(file, t_s=stimulus.t_s, values=stimulus.values)
        try:
            world.control({"play": stimulus.channel, "file": str(file)})
        except ValueError as error:
            raise InputError(f"--stimulus {stimulus.channel}: {error}") from error


def _describe(served: Served, bench: BenchFile, emulated: Sequence[str], *, needs_shim: bool) -> None:
    world, specs = served.world, bench.description.bus
    sockets = world.control_path.parent
    numbers = number_buses(name for name in emulated if specs[name].kind == "i2c")
    shim: Path | None = None
    if numbers:
        try:
            shim = build_shim()
        except BenchError as error:
            if needs_shim:
                raise
            served.notes.append(str(error))
    if shim is not None:
        preloaded = ":".join(filter(None, (str(shim), os.environ.get("LD_PRELOAD"))))
        served.environment |= {"LD_PRELOAD": preloaded, "MICRON_I2C": str(sockets)}
    served.environment["MICRON_CONTROL"] = str(world.control_path)
    for name in emulated:
        uri = world.endpoint(name)
        scheme, _, rest = uri.partition("://")
        path = rest
        if scheme == "unix-i2c":
            (sockets / f"i2c-{numbers[name]}").symlink_to(Path(path).name)
            places = [*([f"/dev/i2c-{numbers[name]}"] if shim is not None else []), path]
        elif scheme == "udp-multicast":
            places = [f"udp_multicast {rest}"]
        elif scheme == "socketcan":
            places = [f"socketcan {rest}"]
        else:
            places = [path]
        if name in world.tcp_ports:
            address = f"127.0.0.1:{world.tcp_ports[name]}"
            places += [f"socket://{address}", f"rfc2217://{address}"]
        parts = tuple(n for n, device in bench.description.device.items() if device.bus == name)
        served.buses.append(ServedBus(name, specs[name].kind, uri, parts, tuple(places)))
        served.environment[f"MICRON_{name.upper()}"] = places[0] if specs[name].kind != "can" else uri
    served.environment |= _can_environment([bus.uri for bus in served.buses if bus.kind == "can"])


def _can_environment(uris: Sequence[str]) -> dict[str, str]:
    """Return the variables from which python-can's own tools take their bus, where there is one."""
    if len(uris) != 1:
        return {}
    scheme, _, place = uris[0].partition("://")
    if scheme == "udp-multicast":
        group, _, port = place.rpartition(":")
        options = json.dumps({"port": int(port), "hop_limit": 0, "fd": False})
        return {"CAN_INTERFACE": "udp_multicast", "CAN_CHANNEL": group, "CAN_CONFIG": options}
    return {"CAN_INTERFACE": scheme, "CAN_CHANNEL": place}
