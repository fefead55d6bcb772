"""Obeys orders to a running emulated world: read and set what its parts sense, inject faults, pause time.

One JSON object is one order, and so is its answer: ``{"ok": true, "t_s": ...}`` with what was asked for, or
``{"ok": false, "error": "..."}``. ``t_s`` is the age of the world in s. The orders are:

- ``{"list": true}``: ``channels`` with their units, and ``faults``
- ``{"get": "daq"}``: ``values`` of a part, of one channel, or with ``""`` of all
- ``{"truth": true}``: ``truth``, the present state of the physics
- ``{"set": {"daq.0": 1.25, "imu.az": null}}``: constants; ``null`` gives the channel back to the physics
- ``{"play": "daq.0", "t_s": [...], "values": [...]}``, or ``"file"``: an npz with these two arrays, from now on
- ``{"fault": "nack", "target": "mag_adc"}``: one of ``sim_devices.faults.FAULTS``
- ``{"pause": true}``, ``{"pause": false}``: time stands still, time goes on
- ``{"advance_s": 0.5}``: time that is paused goes on by so much
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from hal.npz import NpzError, open_npz
from sim_devices.faults import FAULTS, UnknownFault
from sim_devices.stimuli import UnknownChannel, constant, played
from sim_devices.world import World


class WorldTime(Protocol):
    """The time that a control may stop. ``stretched_ns``: it stood still for so long because the host was too slow."""

    @property
    def stretched_ns(self) -> int: ...
    def pause(self) -> None: ...
    def resume(self) -> None: ...
    def advance(self, seconds: float) -> None: ...


class WorldControl:
    """Answers orders to ``world``. ``strike(fault, target)`` does a fault, ``now_ns`` is bench time.

    Without a ``time``, time cannot be paused, because the program that uses the world drives it.
    """

    def __init__(
        self,
        world: World,
        strike: Callable[[str, str], None],
        now_ns: Callable[[], int],
        time: WorldTime | None = None,
    ) -> None:
        self._world, self._strike, self._now_ns, self._time = world, strike, now_ns, time
        self._orders: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
            "list": self._list,
            "get": lambda order: {"values": world.stimuli.read(str(order["get"]), now_ns())},
            "truth": self._truth,
            "set": self._set,
            "play": self._play,
            "fault": self._fault,
            "pause": self._pause,
            "advance_s": self._advance,
        }

    def answer(self, line: bytes) -> bytes:
        """Do the order in ``line``, a JSON object, and return the answer as JSON."""
        try:
            try:
                order = json.loads(line)
            except ValueError as error:
                raise ValueError(f"an order is one JSON object on a line, and this is no JSON: {error}") from error
            if not isinstance(order, dict):
                raise ValueError("an order is one JSON object on a line")
            known = [name for name in self._orders if name in order]
            if len(known) != 1:
                raise ValueError(f"an order has one of {', '.join(self._orders)}")
            answer = self._orders[known[0]](order)
            return json.dumps({"ok": True, "t_s": (self._now_ns() - self._world.epoch_ns) * 1e-9, **answer}).encode()
        except KeyError as error:
            return json.dumps({"ok": False, "error": f"the order lacks {error}"}).encode()
        except (ValueError, TypeError, AttributeError, RecursionError, UnknownFault, UnknownChannel) as error:
            return json.dumps({"ok": False, "error": str(error)}).encode()

    def _list(self, order: dict[str, Any]) -> dict[str, Any]:
        stretched_s = 0.0 if self._time is None else self._time.stretched_ns * 1e-9
        return {
            "channels": self._world.stimuli.units,
            "faults": list(FAULTS),
            "parts": list(self._world.devices),
            "stretched_s": stretched_s,
        }

    def _truth(self, order: dict[str, Any]) -> dict[str, Any]:
        self._world.plant.advance_to(self._now_ns() - self._world.epoch_ns)
        return {"truth": {name: np.asarray(value).tolist() for name, value in self._world.plant.truth_row().items()}}

    def _set(self, order: dict[str, Any]) -> dict[str, Any]:
        if not isinstance(order["set"], dict):
            raise ValueError('set takes an object with a value for each channel, as in {"set": {"daq.0": 1.25}}')
        wanted = {
            str(channel): None if value is None else _finite(channel, value) for channel, value in order["set"].items()
        }
        for channel in wanted:
            self._world.stimuli.check(channel)
        for channel, value in wanted.items():
            self._world.stimuli.put(channel, None if value is None else constant(value))
        return {}

    def _play(self, order: dict[str, Any]) -> dict[str, Any]:
        channel = str(order["play"])
        self._world.stimuli.check(channel)
        if "file" in order:
            path = Path(str(order["file"]))
            try:
                with open_npz(path) as columns:
                    t_s, values = columns["t_s"], columns["values"]
            except (NpzError, OSError) as error:
                raise ValueError(f"{path}: {error}") from error
        else:
            t_s, values = order["t_s"], order["values"]
        self._world.stimuli.put(channel, played(t_s, values, self._now_ns()))
        return {}

    def _fault(self, order: dict[str, Any]) -> dict[str, Any]:
        self._strike(str(order["fault"]), str(order.get("target", "")))
        return {}

    def _pause(self, order: dict[str, Any]) -> dict[str, Any]:
        time = self._own_time()
        time.pause() if order["pause"] else time.resume()
        return {}

    def _advance(self, order: dict[str, Any]) -> dict[str, Any]:
        self._own_time().advance(_finite("advance_s", order["advance_s"]))
        return {}

    def _own_time(self) -> WorldTime:
        if self._time is None:
            raise ValueError("time is driven by the program that uses this world; it cannot be paused from here")
        return self._time


def _finite(name: str, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: {value!r} is not a number") from None
    if not np.isfinite(number):
        raise ValueError(f"{name}: {value} is not a finite number")
    return number
