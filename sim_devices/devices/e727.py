"""Emulates the PI E-727.3SDA digital piezo controller: three axes, four output channels, GCS 2.0 over RS-232.

Sources: PI E-727 manual E727T0005 (28 June 2019); GCS framing and error numbers as collected in
``ecosystem.md`` section 6b from PI's client and captures of real devices. Wire face: bytes at 115200 baud 8N1
(86.8 us each, both ways). Truth face: ``output_V``, ``on_output`` and the position that the servo measures.

Model limits
- The servo is an integrator of 1 kHz (0.3 of the error per step) behind a velocity limit, not PI's 20 kHz servo
  with notch filters. Without ``measure_um`` its sensor sees an ideal stack of 15 um at 100 V.
- Axes 1..3 drive outputs 1..3 directly (identity output matrix); output 4 stays at 0 V. Limits 0..100 V.
- Left out: data recorder, wave generator, analog targets, trigger lines, saving to flash (``WPA``), macros. They are
  answered with error 2 as unknown commands. ``TAD?``/``TSP?`` report the measured position.
- Decided where the manual text was not at hand: an odd number of arguments is error 24, a line of more than 512
  characters error 3, voltage beyond the limits error 302; ``ATZ`` takes 0.5 s; several errors keep the last one.
- ``HLP?`` and ``HPA?`` list what this device knows, in the vendor's layout; its sensors are absolute, so ``FRF?``
  reports every axis as referenced. ``TVI?`` names the characters of an axis identifier.
- Start-up time and axis coupling are not modelled; commands are executed when their last byte has arrived.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence

from sim_devices.devices.e727_lists import LIMIT_V, MEANINGS, PARAMETERS, TRAVEL_UM

AXES = ("1", "2", "3")
OUTPUTS = 4
BYTE_NS = round(10 * 1e9 / 115_200)
NOMINAL_UM_PER_V = 0.15
SERVO_NS = 1_000_000
SERVO_GAIN = 0.3
ON_TARGET_UM = 0.05
AUTOZERO_NS = 500_000_000
MAX_LINE = 512
VALID_IDENTIFIERS = "1234567890ABCDEFGHIJKLMNOPQRSTUVWXYZ-_"
IDENTITY = "(c)2016 Physik Instrumente (PI) GmbH & Co. KG, E-727.3SDA, 0116047977, 13.21.00.02"
(SYNTAX, UNKNOWN, TOO_LONG, SERVO_OFF, POSITION, VELOCITY, STOPPED) = (1, 2, 3, 5, 7, 8, 10)
(AXIS, RANGE, AXIS_TWICE, COUNT, NUMBER, PARAMETER, PASSWORD, PROTECTED) = (15, 17, 22, 24, 25, 54, 56, 60)
(VOLTAGE, SERVO_ON) = (302, 303)


class GcsError(Exception):
    """A command was refused; the number goes to ``ERR?``."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


class E727:
    """Emulates one controller. ``measure_um(axis, t_ns)`` is its position sensor, ``on_output`` its amplifier."""

    def __init__(
        self,
        *,
        on_output: Callable[[int, float, int], None] | None = None,
        measure_um: Callable[[int, int], float] | None = None,
    ) -> None:
        self.unread = 0
        self.frozen = False
        self.output_V = [0.0] * OUTPUTS
        self.servo = [False] * 3
        self.target_um = [0.0] * 3
        self.velocity_um_s = [10_000.0] * 3
        self._reference_um = [0.0] * 3
        self._autozeroed = [False] * 3
        self._on_output = on_output
        self._measure_um = measure_um
        self._error = 0
        self._command_level = 0
        self._parameters = {(a, p): known[0] for a in AXES for p, known in PARAMETERS.items()}
        self._now_ns = 0
        self._servo_ns = 0
        self._busy_until_ns = 0
        self._line = bytearray()
        self._incoming: deque[tuple[int, int]] = deque()  # arrival, byte
        self._line_free_ns = 0
        self._outgoing: deque[int] = deque()
        self._sent_ns = 0  # when the byte at the head of the queue has been sent
        self._out = bytearray()
        self._queries = self._query_table()
        self._setters = self._setter_table()

    # ------------------------------------------------------------------ wire face

    def receive(self, data: bytes, t_ns: int) -> None:
        self.advance_to(t_ns)
        arrival_ns = max(self._line_free_ns, t_ns)
        for byte in data:
            arrival_ns += BYTE_NS
            self._incoming.append((arrival_ns, byte))
        self._line_free_ns = arrival_ns

    def take(self, max_bytes: int) -> bytes:
        """Bytes that have come over the line by now."""
        if not self._out:
            return b""
        data = bytes(self._out[:max_bytes])
        del self._out[:max_bytes]
        return data

    def next_event_ns(self) -> int | None:
        if self.frozen:
            return None
        due = [self._incoming[0][0]] if self._incoming else []
        if self._outgoing:
            due.append(self._sent_ns)
        if any(self.servo):
            due.append(self._servo_ns)
        return min(due, default=None)

    def advance_to(self, t_ns: int) -> None:
        while not self.frozen:
            due_ns = self.next_event_ns()
            if due_ns is None or due_ns > t_ns:
                break
            self._now_ns = max(self._now_ns, due_ns)
            self._step(due_ns)
        self._now_ns = max(self._now_ns, t_ns)
        if self.frozen:
            self._incoming.clear()

    def _step(self, t_ns: int) -> None:
        if any(self.servo) and self._servo_ns <= t_ns:
            self._servo_step(self._servo_ns)
            self._servo_ns += SERVO_NS
        if self._outgoing and self._sent_ns <= t_ns:
            self._out.append(self._outgoing.popleft())
            self._sent_ns += BYTE_NS
        if self._incoming and self._incoming[0][0] <= t_ns:
            self._receive_byte(self._incoming.popleft()[1])

    def _receive_byte(self, byte: int) -> None:
        if byte == 0x05:
            moving = sum(1 << a for a in range(3) if not self._on_target(a))
            self._send(f"{moving:X}\n".encode())
        elif byte == 0x07:
            self._send(bytes((0xB0 if self._now_ns < self._busy_until_ns else 0xB1, 0x0A)))
        elif byte == 0x18:
            self._halt(AXES)
        elif byte == 0x0A:
            line = self._line.decode("latin-1")
            self._line.clear()
            self._execute(line)
        elif len(self._line) <= MAX_LINE:  # one more than allowed marks the line as too long
            self._line.append(byte)

    def _send(self, data: bytes) -> None:
        if not self._outgoing:
            self._sent_ns = self._now_ns + BYTE_NS
        self._outgoing.extend(data)

    # ------------------------------------------------------------------ truth face

    def position_um(self, axis: int) -> float:
        """Return the position of ``axis`` that the controller's sensor measures, in um."""
        if self._measure_um is not None:
            return self._measure_um(axis, self._now_ns)
        return self.output_V[axis] * NOMINAL_UM_PER_V

    # ------------------------------------------------------------------ servo and outputs

    def _servo_step(self, t_ns: int) -> None:
        for axis in range(3):
            if not self.servo[axis]:
                continue
            step = self.velocity_um_s[axis] * SERVO_NS * 1e-9
            away = self.target_um[axis] - self._reference_um[axis]
            self._reference_um[axis] += max(-step, min(step, away))
            error = self._reference_um[axis] - self.position_um(axis)
            if error:
                self._drive(axis, self.output_V[axis] + SERVO_GAIN * error / NOMINAL_UM_PER_V, t_ns)

    def _drive(self, axis: int, volts: float, t_ns: int) -> None:
        volts = max(LIMIT_V[0], min(LIMIT_V[1], volts))
        if volts != self.output_V[axis]:
            self.output_V[axis] = volts
            if self._on_output is not None:
                self._on_output(axis, volts, t_ns)

    def _on_target(self, axis: int) -> bool:
        return not self.servo[axis] or abs(self.target_um[axis] - self.position_um(axis)) <= ON_TARGET_UM

    def _halt(self, axes: Sequence[str]) -> None:
        for a in axes:
            axis = AXES.index(a)
            if self.servo[axis]:
                self.target_um[axis] = self._reference_um[axis] = self.position_um(axis)
        self._error = STOPPED

    # ------------------------------------------------------------------ commands

    def _execute(self, line: str) -> None:
        words = line.split()
        if not words:
            return
        name, arguments = words[0].upper(), words[1:]
        try:
            if len(line) > MAX_LINE:
                raise GcsError(TOO_LONG)
            if name in self._queries:
                lines = self._queries[name](arguments)
                self._send((" \n".join(lines) + "\n").encode("latin-1"))
            elif name in self._setters:
                self._setters[name](arguments)
            else:
                raise GcsError(UNKNOWN)
        except GcsError as error:
            self._error = error.number

    def _query_table(self) -> dict[str, Callable[[list[str]], list[str]]]:
        def per_axis(value: Callable[[int], str]) -> Callable[[list[str]], list[str]]:
            return lambda args: [f"{a}={value(AXES.index(a))}" for a in _axes(args)]

        def fixed(*lines: str) -> Callable[[list[str]], list[str]]:
            return lambda args: list(lines)

        return {
            "*IDN?": fixed(IDENTITY),
            "SAI?": fixed(*AXES),
            "CSV?": fixed("2.0"),
            "ERR?": self._read_error,
            "SVO?": per_axis(lambda a: str(int(self.servo[a]))),
            "MOV?": per_axis(lambda a: f"{self.target_um[a]:.9e}"),
            "SVA?": per_axis(lambda a: f"{self.output_V[a]:.9e}"),
            "POS?": per_axis(lambda a: f"{self.position_um(a):.9e}"),
            "TSP?": per_axis(lambda a: f"{self.position_um(a):.9e}"),
            "TAD?": per_axis(lambda a: str(round(self.position_um(a) / TRAVEL_UM[1] * 32768))),
            "ONT?": per_axis(lambda a: str(int(self._on_target(a)))),
            "OVF?": per_axis(lambda a: str(int(self.servo[a] and self.output_V[a] in LIMIT_V))),
            "TMN?": per_axis(lambda a: f"{TRAVEL_UM[0]:.9e}"),
            "TMX?": per_axis(lambda a: f"{TRAVEL_UM[1]:.9e}"),
            "VEL?": per_axis(lambda a: f"{self.velocity_um_s[a]:.9e}"),
            "PUN?": per_axis(lambda a: "um"),
            "CST?": per_axis(lambda a: "P-885.50"),
            "ATZ?": per_axis(lambda a: str(int(self._autozeroed[a] and self._now_ns >= self._busy_until_ns))),
            "VOL?": self._read_outputs,
            "TPC?": fixed(str(OUTPUTS)),
            "TSC?": fixed("3"),
            "CCL?": lambda args: [str(self._command_level)],
            "FRF?": per_axis(lambda a: "1"),
            "TVI?": fixed(VALID_IDENTIFIERS),
            "HLP?": self._help,
            "HPA?": self._parameter_help,
            "SPA?": self._read_parameter,
            "VER?": fixed("FW_DSP: 13.21.00.02"),
        }

    def _setter_table(self) -> dict[str, Callable[[list[str]], None]]:
        return {
            "SVO": self._set_servo,
            "MOV": lambda args: self._move(_pairs(args)),
            "MVR": lambda args: self._move([(a, self.target_um[a] + d) for a, d in _pairs(args)]),
            "SVA": self._set_voltage,
            "VEL": self._set_velocity,
            "ATZ": self._autozero,
            "HLT": lambda args: self._halt(_axes(args)),
            "STP": lambda args: self._halt(AXES),
            "CCL": self._set_command_level,
            "SPA": self._set_parameter,
        }

    def _read_error(self, args: list[str]) -> list[str]:
        error, self._error = self._error, 0
        return [str(error)]

    def _read_outputs(self, args: list[str]) -> list[str]:
        channels = args or [str(n + 1) for n in range(OUTPUTS)]
        if any(c not in ("1", "2", "3", "4") for c in channels):
            raise GcsError(RANGE)
        return [f"{c}={self.output_V[int(c) - 1]:.9e}" for c in channels]

    def _set_servo(self, args: list[str]) -> None:
        pairs = _pairs(args)
        if any(value not in (0.0, 1.0) for _, value in pairs):
            raise GcsError(RANGE)
        if not any(self.servo):
            self._servo_ns = self._now_ns + SERVO_NS
        for axis, value in pairs:
            if value and not self.servo[axis]:
                self.target_um[axis] = self._reference_um[axis] = self.position_um(axis)
            self.servo[axis] = bool(value)

    def _move(self, pairs: list[tuple[int, float]]) -> None:
        """Start all axes together, and only if every target is legal."""
        if any(not self.servo[axis] for axis, _ in pairs):
            raise GcsError(SERVO_OFF)
        if any(not TRAVEL_UM[0] <= target <= TRAVEL_UM[1] for _, target in pairs):
            raise GcsError(POSITION)
        for axis, target in pairs:
            self.target_um[axis] = target

    def _set_voltage(self, args: list[str]) -> None:
        pairs = _pairs(args)
        if any(self.servo[axis] for axis, _ in pairs):
            raise GcsError(SERVO_ON)
        if any(not LIMIT_V[0] <= volts <= LIMIT_V[1] for _, volts in pairs):
            raise GcsError(VOLTAGE)
        for axis, volts in pairs:
            self._drive(axis, volts, self._now_ns)

    def _set_velocity(self, args: list[str]) -> None:
        pairs = _pairs(args)
        if any(not 0.0 < v <= 1e5 for _, v in pairs):
            raise GcsError(VELOCITY)
        for axis, velocity in pairs:
            self.velocity_um_s[axis] = velocity

    def _autozero(self, args: list[str]) -> None:
        words = args or [word for a in AXES for word in (a, "NaN")]
        for a in _axes(words[::2]):
            self._autozeroed[AXES.index(a)] = True
        self._busy_until_ns = self._now_ns + AUTOZERO_NS

    def _set_command_level(self, args: list[str]) -> None:
        if not args or args[0] not in ("0", "1"):
            raise GcsError(COUNT if not args else RANGE)
        if args[0] == "1" and args[1:] != ["advanced"]:
            raise GcsError(PASSWORD)
        self._command_level = int(args[0])

    def _parameter_key(self, axis: str, number: str) -> tuple[str, int]:
        try:
            key = (axis, int(number, 0))
        except ValueError as error:
            raise GcsError(NUMBER) from error
        if key not in self._parameters:
            raise GcsError(PARAMETER if axis in AXES else AXIS)
        return key

    def _read_parameter(self, args: list[str]) -> list[str]:
        if len(args) % 2:
            raise GcsError(COUNT)
        asked = [self._parameter_key(a, p) for a, p in zip(args[::2], args[1::2], strict=True)]
        keys = asked or sorted(self._parameters)
        return [f"{a} 0x{number:08X}={self._parameters[a, number]:g}" for a, number in keys]

    def _help(self, args: list[str]) -> list[str]:
        names = [*("#5", "#7", "#24"), *sorted((*self._queries, *self._setters))]
        return ["The following commands are valid:", *(f"{n} {MEANINGS[n]}" for n in names), "end of help"]

    def _parameter_help(self, args: list[str]) -> list[str]:
        """Return the fields of a line: level for writing, number of items, type, group and name (GCS manual PZ281E,
        HPA?)."""
        lines = [
            f"0x{number:X}=\t{level}\t{len(AXES)}\t{kind}\tAxis\t{name}"
            for number, (_, level, kind, name) in PARAMETERS.items()
        ]
        return ["The following parameters are valid:", *lines, "end of help"]

    def _set_parameter(self, args: list[str]) -> None:
        if len(args) != 3:
            raise GcsError(COUNT)
        key = self._parameter_key(args[0], args[1])
        if self._command_level < 1:
            raise GcsError(PROTECTED)
        self._parameters[key] = _number(args[2])


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError as error:
        raise GcsError(NUMBER) from error
    if not math.isfinite(value):
        raise GcsError(NUMBER)
    return value


def _axes(args: Sequence[str]) -> list[str]:
    axes = list(args) or list(AXES)
    if any(a not in AXES for a in axes):
        raise GcsError(AXIS)
    if len(set(axes)) != len(axes):
        raise GcsError(AXIS_TWICE)
    return axes


def _pairs(args: list[str]) -> list[tuple[int, float]]:
    if not args or len(args) % 2:
        raise GcsError(COUNT)
    axes = _axes(args[::2])
    return [(AXES.index(a), _number(v)) for a, v in zip(axes, args[1::2], strict=True)]
