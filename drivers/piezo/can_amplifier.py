"""Piezo amplifier as a CAN node: one setpoint frame per tick, status at 100 Hz (``drivers/dbc/micron.dbc``).

The node itself ramps to its safe state on COMMAND safe and when the host's heartbeat stops; ``safe_step`` asks
for it and waits, tick by tick, until a status frame confirms.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence

import numpy as np

from drivers.base import wait_s
from drivers.can_frames import HostHeartbeat, crc8_j1850, host_heartbeat
from drivers.dbc import load_database
from drivers.options import CanAmplifierOptions
from drivers.output_guard import GuardedOutput, OutputGuard
from drivers.registry import Driver, Load, Site, Traffic
from hal.contracts import CanBus, Clock, Float64Array
from hal.errors import BenchError, HalTimeout, ProtocolError, SafetyTrip
from hal.types import CanFrame, ChannelInfo, OutputLimit
from hal.wire_bits import can_bits

CHANNELS = 3
FULL_V = 100.0
CODES_PER_V = 65535.0 / FULL_V
DISARMED, ARMED, SAFE_RAMP, FAULT = range(4)
STATE_NAMES = ("disarmed", "armed", "safe ramp", "fault")
STATUS_LIMIT_NS = 100_000_000  # ten status periods
COUNTER_LAG_LIMIT = 64  # setpoints in a row that no status has acknowledged
CONFIRM_STEPS = 100
COMMAND_EVERY = 5
TICK_S = 0.001
STATUS_HZ, NODE_HEARTBEAT_HZ = 100.0, 10.0  # frames of the node (micron.dbc)
FRAMES = {"command": 8, "STATUS": 8, "AMPLIFIER_HEARTBEAT": 1}
"""Data bytes of what is repeated: one SETPOINT per ``write``, the others by the node. COMMAND is not repeated."""
RECEIVE_LIMIT = 32  # frames per call, so that a babbling bus cannot hold the tick

# hot path; tests compare both with the DBC through cantools
_SETPOINT = struct.Struct("<HHHB")
_STATUS = struct.Struct("<HHHBB")


class CanAmplifier(GuardedOutput):
    """Implements ``AnalogOutput`` for three stacks, in V at the stack."""

    def __init__(
        self,
        bus: CanBus,
        clock: Clock,
        *,
        neutral_V: float = 50.0,
        slew_V_per_s: float = 20_000.0,
        heartbeat: HostHeartbeat | None = None,
        name: str = "piezo",
    ) -> None:
        if not 0.0 <= neutral_V <= FULL_V:
            raise BenchError(f"neutral_V = {neutral_V} is outside 0 .. {FULL_V} V", device=name)
        database = load_database()
        self.name = name
        self.limits = (OutputLimit(0.0, FULL_V, slew_V_per_s, neutral_V),) * CHANNELS
        self.guard = OutputGuard(name, self.limits, clock)
        self.state = DISARMED
        self.measured_V: Float64Array = np.full(CHANNELS, np.nan)
        self.status_ns = 0
        self.heartbeat = heartbeat or HostHeartbeat(bus, clock, database)
        self._bus = bus
        self._clock = clock
        self._setpoint_id = database.get_message_by_name("SETPOINT").frame_id
        self._command_id = database.get_message_by_name("COMMAND").frame_id
        self._status = database.get_message_by_name("STATUS")
        self._counter = 0
        self._acknowledged = 0
        self._safe_steps = 0
        self._asked_ns = 0

    @staticmethod
    def receives() -> tuple[int, ...]:
        """CAN ids for ``SharedCan.view``."""
        database = load_database()
        return tuple(database.get_message_by_name(n).frame_id for n in ("STATUS", "AMPLIFIER_HEARTBEAT"))

    def probe(self, timeout_s: float = 0.5) -> str:
        """Wait for a status frame. Raises ``HalTimeout`` when the node is silent."""
        self._fresh_status(timeout_s)
        return f"CAN piezo node, {STATE_NAMES[self.state]}"

    def poll(self) -> None:
        """Take what has arrived; send our heartbeat when it is due."""
        self.heartbeat.beat()
        for _ in range(RECEIVE_LIMIT):
            frame = self._bus.recv(0.0)
            if frame is None:
                return
            self._take(frame)

    def arm(self) -> None:
        """Ask the node to arm, ramp to neutral, verify counter and measured voltages in a status frame."""
        self._fresh_status(STATUS_LIMIT_NS * 1e-9)
        self.guard.require(self.state != FAULT, "the node reports a fault: switch it off and on")
        self.guard.start_from([float(v) for v in self.measured_V])
        self.guard.offer_last()
        # the node may compare with what it accepted last, and refuse a repeated counter
        self._counter = (self._acknowledged + 1) & 0xFF
        self._send_command(1)
        limit_ns = self._clock.now_ns() + STATUS_LIMIT_NS
        while self.state != ARMED:
            self.guard.require(self._clock.now_ns() < limit_ns, "the node does not confirm 'arm'")
            self._hold_one_tick()
        done = False
        while not done:
            done = self.guard.ramp()
            self._hold_one_tick()
        limit_ns = self._clock.now_ns() + STATUS_LIMIT_NS
        neutral_V = np.array([limit.safe_V for limit in self.limits])
        counter = self._counter
        while not self._accepted_since(counter) or np.abs(self.measured_V - neutral_V).max() > 1.0:
            self.guard.require(
                self._clock.now_ns() < limit_ns and self.state == ARMED,
                f"commanded {neutral_V.tolist()} V, the node measures {self.measured_V.round(2).tolist()} V and is "
                f"{STATE_NAMES[self.state]}",
            )
            self._hold_one_tick()
        self._safe_steps = 0
        self.guard.armed = True

    def write(self, values_V: Float64Array) -> int:
        """Write ``values_V`` (3,) as ``AnalogOutput.write`` does. Raises also when the node is not armed or is
        silent."""
        self.poll()
        if self.guard.armed:
            self._require_link()
        mask = self.guard.admit(values_V)
        self._send_setpoint()
        return mask

    def safe_step(self) -> bool:
        """Ask for the safe state, again every 5 ticks; True once the node says that it is disarmed.

        Raises ``HalTimeout`` when it does not confirm within 100 ticks (the node's own watchdog then acts).
        """
        self.guard.armed = False
        if self._safe_steps == 0:
            self._asked_ns = self._clock.now_ns()
        if self._safe_steps % COMMAND_EVERY == 0:
            self._send_command(0)
        self._safe_steps += 1
        self.poll()
        if self.state == DISARMED and self.status_ns > self._asked_ns:
            self.guard.start_from([limit.safe_V for limit in self.limits])
            self._safe_steps = 0
            return True
        if self._safe_steps > CONFIRM_STEPS:
            raise HalTimeout(
                f"the node does not confirm its safe state (last: {STATE_NAMES[self.state]})", device=self.name
            )
        return False

    def readback_V(self) -> Float64Array:
        """Return the voltages (3,) in V that the node measured, from its next status frame. It holds the set point
        meanwhile."""
        if not self.guard.armed:
            self._fresh_status(STATUS_LIMIT_NS * 1e-9)
            return self.measured_V.copy()
        asked_ns = self._clock.now_ns()
        while self.status_ns <= asked_ns:
            self._require_link()
            self._hold_one_tick()
        return self.measured_V.copy()

    def close(self) -> None:
        """Bring the node to its safe state unless it is there; the bus belongs to the bench."""
        if self.state in (DISARMED, FAULT):
            return
        with self.bringing_to_neutral("were NOT seen to reach neutral"):
            while not self.safe_step():
                wait_s(self._clock, TICK_S)

    def channels(self) -> Sequence[ChannelInfo]:
        return [ChannelInfo(f"{self.name}.{i + 1}", "V", 0.0, FULL_V, 1.0 / CODES_PER_V) for i in range(CHANNELS)]

    def _take(self, frame: CanFrame) -> None:
        if frame.can_id == self._status.frame_id:
            if len(frame.data) != self._status.length:
                raise ProtocolError(f"a STATUS of {len(frame.data)} bytes", device=self.name)
            a, b, c, state, self._acknowledged = _STATUS.unpack(frame.data)
            self.measured_V[:] = (a, b, c)
            self.measured_V /= CODES_PER_V
            self.state = min(state, FAULT)
            self.status_ns = frame.t_ns

    def _require_link(self) -> None:
        age_ns = self._clock.now_ns() - self.status_ns
        if age_ns > STATUS_LIMIT_NS:
            raise HalTimeout(f"no STATUS frame for {age_ns * 1e-6:.0f} ms: bus silent or node off", device=self.name)
        if self.state != ARMED:
            raise SafetyTrip(f"the node left the armed state: {STATE_NAMES[self.state]}", device=self.name)
        if self._lag() > COUNTER_LAG_LIMIT:
            raise ProtocolError(
                f"the node has not accepted the last {self._lag()} setpoints (counter or checksum)", device=self.name
            )

    def _lag(self) -> int:
        return (self._counter - 1 - self._acknowledged) & 0xFF

    def _accepted_since(self, counter: int) -> bool:
        return (self._acknowledged - counter) & 0xFF <= (self._counter - 1 - counter) & 0xFF

    def _hold_one_tick(self) -> None:
        """An armed node wants setpoints all the time: its own watchdog may be as short as 10 ms."""
        self._send_setpoint()
        self.poll()
        wait_s(self._clock, TICK_S)

    def _fresh_status(self, timeout_s: float) -> None:
        asked_ns = self._clock.now_ns()
        limit_ns = asked_ns + round(timeout_s * 1e9)
        while self.status_ns <= asked_ns:
            left_s = (limit_ns - self._clock.now_ns()) * 1e-9
            frame = self._bus.recv(left_s) if left_s > 0 else None
            if frame is None:
                raise HalTimeout(
                    f"no STATUS frame within {timeout_s} s: is the node on, is the bitrate right?", device=self.name
                )
            self._take(frame)

    def _send_command(self, command: int) -> None:
        self._bus.send(CanFrame(self._command_id, bytes((command, command ^ 0xFF))), 0.0)

    def _send_setpoint(self) -> None:
        a, b, c = self.guard.next_V
        k = CODES_PER_V
        data = _SETPOINT.pack(int(a * k + 0.5), int(b * k + 0.5), int(c * k + 0.5), self._counter)
        self._bus.send(CanFrame(self._setpoint_id, data + bytes((crc8_j1850(data),))), 0.0)
        self._counter = (self._counter + 1) & 0xFF
        self.guard.sent()


def _open(site: Site) -> CanAmplifier:
    if site.can is None:
        raise BenchError("the CAN amplifier is opened by an instrument alone", device=site.name)
    bus = site.spec.bus or ""
    view = site.can.view(bus, CanAmplifier.receives())
    options = site.options.model_dump()
    return CanAmplifier(view, site.bench.clock, heartbeat=site.can.heartbeat(bus), name=site.name, **options)


def _traffic(load: Load) -> Iterator[Traffic]:
    frames_hz = {"command": load.tick_hz, "STATUS": STATUS_HZ, "AMPLIFIER_HEARTBEAT": NODE_HEARTBEAT_HZ}
    for frame, n in FRAMES.items():
        yield Traffic(frame, can_bits(n), frames_hz[frame])
    yield host_heartbeat()


DRIVER = Driver(CanAmplifierOptions, _open, "output", traffic=_traffic)
