"""Drives a piezo amplifier that is a CAN node: one set point frame per tick, status at 100 Hz (``dbc/micron.dbc``).

The node itself ramps to its safe state on COMMAND safe and when the host's heartbeat stops; ``safe_step`` asks
for it and waits, tick by tick, until a status frame confirms.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from drivers.base import wait_s
from drivers.can_frames import HostHeartbeat, host_heartbeat
from drivers.dbc import load_database
from drivers.options import CanAmplifierOptions
from drivers.output_guard import GuardedOutput, OutputGuard
from drivers.piezo.can_node import (
    ACKNOWLEDGED,
    ARMED,
    CHANNELS,
    CODES_PER_V,
    COUNTER,
    DISARMED,
    FAULT,
    FULL_V,
    LEFT,
    RECEIVE_LIMIT,
    SAFE_STEPS,
    SILENT,
    STATE,
    STATUS_LIMIT_NS,
    STATUS_NS,
    WELL,
    decode_status,
    encode_setpoint,
    is_safe,
    lag,
    link_fault,
    must_ask,
    new_node,
    note_setpoint,
)
from drivers.registry import Driver, Load, Site, Traffic
from hal.arrays import Array
from hal.contracts import CanBus, Clock
from hal.errors import BenchError, HalError, HalTimeout, ProtocolError, SafetyTrip
from hal.types import CanFrame, ChannelInfo, OutputLimit
from hal.wire_bits import can_bits

STATE_NAMES = ("disarmed", "armed", "safe ramp", "fault")
CONFIRM_STEPS = 100
TICK_S = 0.001
STATUS_HZ, NODE_HEARTBEAT_HZ = 100.0, 10.0  # frames of the node (micron.dbc)
FRAMES = {"command": 8, "STATUS": 8, "AMPLIFIER_HEARTBEAT": 1}
"""Data bytes of what is repeated: one SETPOINT per ``write``, the others by the node. COMMAND is not repeated."""


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
        self.node = new_node()
        self.heartbeat = heartbeat or HostHeartbeat(bus, clock, database)
        self.pending: HalError | None = None
        """Failure in a compiled loop, which leaves it to ``write``."""
        self.bus = bus
        self._clock = clock
        self.setpoint_id, self.command_id, self.status_id = (
            database.get_message_by_name(name).frame_id for name in ("SETPOINT", "COMMAND", "STATUS")
        )

    @staticmethod
    def receives() -> tuple[int, ...]:
        """CAN ids for ``SharedCan.view``."""
        database = load_database()
        return tuple(database.get_message_by_name(n).frame_id for n in ("STATUS", "AMPLIFIER_HEARTBEAT"))

    @property
    def state(self) -> int:
        """Return the state that the node has reported: DISARMED, ARMED, SAFE_RAMP or FAULT."""
        return self.node.words[STATE]

    @property
    def measured_V(self) -> Array:
        """Return the voltages (3,) in V that the node has measured, not a number before its first STATUS."""
        return np.array(self.node.measured_V)

    @property
    def is_ready(self) -> bool:
        """True if a compiled loop may command the node: it is armed, and no failure is pending."""
        return self.guard.armed and self.pending is None

    def probe(self, timeout_s: float = 0.5) -> str:
        """Wait for a status frame. Raises ``HalTimeout`` when the node is silent."""
        self._fresh_status(timeout_s)
        return f"CAN piezo node, {STATE_NAMES[self.state]}"

    def poll(self) -> None:
        """Process the frames that have arrived, and send the host's heartbeat if it is due."""
        self.heartbeat.beat()
        for _ in range(RECEIVE_LIMIT):
            frame = self.bus.recv(0.0)
            if frame is None:
                return
            self._take(frame)

    def forget_received(self) -> None:
        """Discard the frames that have arrived, because a compiled loop has received them, too."""
        while self.bus.recv(0.0) is not None:
            pass

    def arming(self) -> Iterator[None]:
        """Ask the node to arm, ramp to neutral, verify counter and measured voltages in a status frame."""
        self._fresh_status(STATUS_LIMIT_NS * 1e-9)
        self.guard.require(self.state != FAULT, "the node reports a fault: switch it off and on")
        self.guard.start_from(list(self.node.measured_V))
        self.guard.offer_last()
        # the node may compare with what it accepted last, and refuse a repeated counter
        words = self.node.words
        words[COUNTER] = (words[ACKNOWLEDGED] + 1) & 0xFF
        self._send_command(1)
        limit_ns = self._clock.now_ns() + STATUS_LIMIT_NS
        while self.state != ARMED:
            self.guard.require(self._clock.now_ns() < limit_ns, "the node does not confirm 'arm'")
            self._hold()
            yield
        done = False
        while not done:
            done = self.guard.ramp()
            self._hold()
            yield
        limit_ns = self._clock.now_ns() + STATUS_LIMIT_NS
        neutral_V = np.array([limit.safe_V for limit in self.limits])
        counter = words[COUNTER]
        while not self._accepted_since(counter) or np.abs(self.measured_V - neutral_V).max() > 1.0:
            self.guard.require(
                self._clock.now_ns() < limit_ns and self.state == ARMED,
                f"commanded {neutral_V.tolist()} V, the node measures {self.measured_V.round(2).tolist()} V and is "
                f"{STATE_NAMES[self.state]}",
            )
            self._hold()
            yield
        words[SAFE_STEPS] = 0
        self.pending = None
        self.guard.armed = True

    def write(self, values_V: Array) -> int:
        """Write ``values_V`` (3,) and return the mask, both as ``AnalogOutput.write`` says. Raises ``SafetyTrip`` if
        the node has left the armed state, ``HalTimeout`` if it is silent, ``ProtocolError`` if it accepts no set
        point."""
        if self.pending is not None:
            raise self._take_pending()
        self.poll()
        if self.guard.armed:
            self._require_link()
        mask = self.guard.admit(values_V)
        self._send_setpoint()
        return mask

    def safe_step(self) -> bool:
        """Request the safe state, again every 5 calls. Return True once the node reports that it is disarmed.

        Raises ``HalTimeout`` when it does not confirm within 100 ticks (the node's own watchdog then acts).
        """
        self.guard.armed = False
        if must_ask(self.node, self._clock.now_ns()):
            self._send_command(0)
        self.node.words[SAFE_STEPS] += 1
        self.poll()
        if is_safe(self.node):
            self.guard.start_from([limit.safe_V for limit in self.limits])
            return True
        if self.node.words[SAFE_STEPS] > CONFIRM_STEPS:
            raise HalTimeout(
                f"the node does not confirm its safe state (last: {STATE_NAMES[self.state]})", device=self.name
            )
        return False

    def readback_V(self) -> Array:
        """Return the voltages (3,) in V that the node measured, from its next status frame. It holds the set point
        meanwhile."""
        if not self.guard.armed:
            self._fresh_status(STATUS_LIMIT_NS * 1e-9)
            return self.measured_V
        asked_ns = self._clock.now_ns()
        while self.node.words[STATUS_NS] <= asked_ns:
            self._require_link()
            self._hold()
            wait_s(self._clock, TICK_S)
        return self.measured_V

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
        if frame.can_id == self.status_id and not decode_status(self.node, frame.data, frame.t_ns):
            raise self.wrong_status(len(frame.data))

    def wrong_status(self, n: int) -> ProtocolError:
        """Return the error for a STATUS of ``n`` bytes."""
        return ProtocolError(f"a STATUS of {n} bytes", device=self.name)

    def _take_pending(self) -> HalError:
        pending, self.pending = self.pending, None
        assert pending is not None
        return pending

    def _require_link(self) -> None:
        now_ns = self._clock.now_ns()
        fault = link_fault(self.node, now_ns)
        if fault == WELL:
            return
        if fault == SILENT:
            age_ms = (now_ns - self.node.words[STATUS_NS]) * 1e-6
            raise HalTimeout(f"no STATUS frame for {age_ms:.0f} ms: bus silent or node off", device=self.name)
        if fault == LEFT:
            raise SafetyTrip(f"the node left the armed state: {STATE_NAMES[self.state]}", device=self.name)
        raise ProtocolError(
            f"the node has not accepted the last {lag(self.node)} setpoints (counter or checksum)", device=self.name
        )

    def _accepted_since(self, counter: int) -> bool:
        words = self.node.words
        return (words[ACKNOWLEDGED] - counter) & 0xFF <= (words[COUNTER] - 1 - counter) & 0xFF

    def _hold(self) -> None:
        """Repeat the set point, because the watchdog of an armed node may be as short as 10 ms."""
        self._send_setpoint()
        self.poll()

    def _fresh_status(self, timeout_s: float) -> None:
        asked_ns = self._clock.now_ns()
        limit_ns = asked_ns + round(timeout_s * 1e9)
        while self.node.words[STATUS_NS] <= asked_ns:
            left_s = (limit_ns - self._clock.now_ns()) * 1e-9
            frame = self.bus.recv(left_s) if left_s > 0 else None
            if frame is None:
                raise HalTimeout(
                    f"no STATUS frame within {timeout_s} s: is the node on, is the bitrate right?", device=self.name
                )
            self._take(frame)

    def _send_command(self, command: int) -> None:
        self.bus.send(CanFrame(self.command_id, bytes((command, command ^ 0xFF))), 0.0)

    def _send_setpoint(self) -> None:
        encode_setpoint(self.node, self.guard.next_V)
        self.bus.send(CanFrame(self.setpoint_id, bytes(self.node.setpoint)), 0.0)
        note_setpoint(self.node)
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


DRIVER = Driver(CanAmplifierOptions, _open, "output", traffic=_traffic, has_kernels=True)
