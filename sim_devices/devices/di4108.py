"""Emulates the DATAQ DI-4108: 8 x 16 bit data acquisition over USB CDC, command and stream protocol.

Source: DATAQ "Data Acquisition Instrument Command Protocol", revised 1 August 2019, 72 pages (page numbers in
the comments). Wire face: ``receive`` command bytes, ``advance_to`` the scan clock, ``take`` what the host reads.
Truth face: a callable that gives the 8 input voltages at a conversion instant, ``digital_levels``, ``pulse_hz``;
observable ``switches`` and ``led``.

Model limits
- Commands are executed the moment their CR arrives; USB transfers take no time here (a transport may add it).
- No input noise, gain or offset error beyond 16-bit quantisation and clipping; all channels of a scan are
  sampled at one instant; the first scan is one period after ``start``.
- Where the manual is silent this device decides: anything it cannot accept (unknown command, wrong number of
  arguments, value out of range, ``syncget``/``syncset``/``syncstart``, ``ms``, ``eu``) is answered
  ``command not found`` CR and changes nothing; ``*IDN?`` answers ``*IDN? DATAQ,DI-4108,<serial>,<firmware>``;
  input longer than 64 characters without a CR is thrown away.
- Settings changed while scanning take effect at the next ``start``; ``led``, ``endo``, ``dout`` and ``reset`` at
  once, without echo.
- When scanning ends, what the FIFO holds is sent even if it does not fill a packet, then ``stop`` CR or
  ``stop 01`` (seven bytes, no CR, page 50). The FIFO counts everything the host has not read.
- ``filter`` 1 (average) is the plain mean; CIC order and delay are not published. At most 16 conversions per scan
  are evaluated, evenly spread, when ``dec * deca`` is larger. ASCII values are written ``%.4f``.
- Rate and counter channels follow the constant truth ``pulse_hz``; the ``ffl`` moving average is stored only.
- ``din`` reports a switch that is on as 1 (the manual's example on page 58 contradicts itself).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from sim_devices.faces import VoltageSource, Volts

DIVIDEND_HZ = 60_000_000  # page 48, table of srate variables
FIFO_SAMPLES = 1024  # page 50
RANGES_V = (10.0, 5.0, 2.0, 1.0, 0.5, 0.2)  # page 44, codes 0..5
RATE_RANGES_HZ = (50e3, 20e3, 10e3, 5e3, 2e3, 1e3, 500.0, 200.0, 100.0, 50.0, 20.0, 10.0)  # codes 1..12
IGNORE = 0xFFFF
DIGITAL, RATE, COUNTER = 8, 9, 10
MAX_COMMAND = 64
MAX_CONVERSIONS_PER_SCAN = 16
NOT_FOUND = "command not found"


@dataclass
class Di4108Settings:
    """Holds the settings that commands change; the defaults are the values after power-up."""

    packet_code: int = 0
    ascii_output: bool = False
    eol: bytes = b"\r"
    words: list[int] = field(default_factory=lambda: [0])
    srate: int = 6000
    dec: int = 1
    deca: int = 1
    filters: list[int] = field(default_factory=lambda: [0] * 8)
    ffl: int = 32
    description: str = ""


class Di4108:
    """Emulates one DI-4108. ``clock_error_ppb`` > 0 makes its crystal, hence its scan clock, run fast."""

    def __init__(
        self,
        analog: VoltageSource,
        *,
        serial_number: str = "5E0B1A2C",
        firmware: int = 121,
        clock_error_ppb: int = 0,
        fifo_samples: int = FIFO_SAMPLES,
        on_switches: Callable[[int, int], None] | None = None,
    ) -> None:
        self.settings = Di4108Settings()
        self.unread = 0
        self.frozen = False
        self.model = "4108"
        self.scanning = False
        self.scans = 0
        self.overflows = 0
        self.switches = 0
        self.led = 7
        self.digital_levels = 0x7F
        self.pulse_hz = 0.0
        self._analog = analog
        self._serial_number = serial_number
        self._firmware = firmware
        self._clock_error_ppb = clock_error_ppb
        self._fifo_bytes = 2 * fifo_samples
        self._on_switches = on_switches
        self._endo = 0
        self._now_ns = 0
        self._counter_zero_ns = 0
        self._command = bytearray()
        self._out = bytearray()
        self._partial = bytearray()
        self._commands = self._command_table()
        self._prepare_scan(0)

    # ------------------------------------------------------------------ wire face

    def receive(self, data: bytes, t_ns: int) -> None:
        """Take bytes from the host. LF and NUL are skipped (page 16: CR alone ends a command)."""
        if self.frozen:
            return
        self.advance_to(t_ns)
        for byte in data:
            if byte == 0x0D:
                line = self._command.decode("latin-1")
                self._command.clear()
                self._execute(line)
            elif byte not in (0x00, 0x0A):
                self._command.append(byte)
                if len(self._command) > MAX_COMMAND:
                    self._command.clear()

    def take(self, max_bytes: int) -> bytes:
        """Remove and return the bytes that the host reads next, at most ``max_bytes``; none while the device is frozen.

        While scanning, output is queued in full packets only (page 21)."""
        if self.frozen or not self._out:
            return b""
        data = bytes(self._out[:max_bytes])
        del self._out[:max_bytes]
        return data

    def next_event_ns(self) -> int | None:
        return self._next_ns if self.scanning and not self.frozen else None

    def advance_to(self, t_ns: int) -> None:
        """Take every conversion due up to ``t_ns``, each at its own instant of the device clock."""
        while self.scanning and self._next_ns <= t_ns:
            if self.frozen:
                self._skip_to(t_ns)
                break
            self._convert(self._next_ns)
        self._now_ns = max(self._now_ns, t_ns)

    # ------------------------------------------------------------------ truth face

    @property
    def fifo_samples(self) -> int:
        """Samples that the host has not read yet."""
        return (len(self._out) + len(self._partial) + self.unread) // 2

    def set_clock_error_ppb(self, ppb: int, t_ns: int) -> None:
        """Let the crystal run fast by ``ppb`` from the last conversion on (fault hook)."""
        self.advance_to(t_ns)
        self._clock_error_ppb = ppb
        self._start_ns += self._conversion * self._num // self._den
        self._conversion = 0
        self._den = DIVIDEND_HZ * (10**9 + ppb) * self._conversions
        self._next_ns = self._start_ns + self._num // self._den

    def step_clock(self, dt_ns: int, t_ns: int) -> None:
        """Shift the next conversion and all that follow by ``dt_ns`` (fault hook)."""
        self.advance_to(t_ns)
        self._start_ns += dt_ns
        self._next_ns = max(t_ns + 1, self._next_ns + dt_ns)

    def force_overflow(self) -> None:
        """Overflow the buffer, as if the host had not read for too long (fault hook)."""
        if self.scanning:
            self._overflow()

    # ------------------------------------------------------------------ scanning

    def _prepare_scan(self, t_ns: int) -> None:
        s = self.settings
        entries = [word for word in s.words if word != IGNORE]
        self._entries = entries
        channels = [word & 0xF for word in entries]
        self._analog_only = all(c < DIGITAL for c in channels) and not s.ascii_output
        self._identity = self._analog_only and channels == list(range(8))
        self._index = np.array([c if c < DIGITAL else 0 for c in channels], dtype=np.intp)
        full_scale = [RANGES_V[w >> 8 & 0xF] if (w & 0xF) < DIGITAL else 1.0 for w in entries]
        self._scale = np.array([32768.0 / fs for fs in full_scale])
        self._volts = np.zeros(len(entries))
        self._work = np.zeros(len(entries))
        self._codes = np.zeros(len(entries), dtype="<i2")
        self._packet_bytes = 16 << s.packet_code
        oversampling = s.dec > 1 and any(s.filters[c] for c in channels if c < DIGITAL)
        self._conversions = min(s.dec * s.deca, MAX_CONVERSIONS_PER_SCAN) if oversampling else 1
        self._modes = np.array([s.filters[c] if c < DIGITAL and s.dec > 1 else 0 for c in channels])
        self._samples = np.zeros((self._conversions, len(entries)))
        self._num = s.srate * s.dec * s.deca * 10**18
        self._den = DIVIDEND_HZ * (10**9 + self._clock_error_ppb) * self._conversions
        self._start_ns = t_ns
        self._conversion = 0
        self._next_ns = self._start_ns + self._num // self._den

    def _convert(self, t_ns: int) -> None:
        volts = self._analog(t_ns)
        self._conversion += 1
        self._next_ns = self._start_ns + (self._conversion + 1) * self._num // self._den
        if not self._identity:
            np.take(volts, self._index, out=self._volts)
            volts = self._volts
        if self._conversions > 1:
            phase = (self._conversion - 1) % self._conversions
            self._samples[phase] = volts
            if phase < self._conversions - 1:
                return
            volts = self._filtered()
        self.scans += 1
        if self._analog_only:
            self._emit(self._codes_of(volts).tobytes())
        elif self.settings.ascii_output:
            values = [f"{v:.4f}" for v, w in zip(volts, self._entries, strict=True) if (w & 0xF) < DIGITAL]
            self._emit(",".join(values).encode() + self.settings.eol)
        else:
            codes = self._codes_of(volts)
            for i, word in enumerate(self._entries):
                if (word & 0xF) >= DIGITAL:
                    codes[i] = self._digital_code(word, t_ns)
            self._emit(codes.tobytes())

    def _filtered(self) -> Volts:
        """Return the last point, average, maximum or minimum per channel (page 51)."""
        s, m = self._samples, self._modes
        return np.select([m == 1, m == 2, m == 3], [s.mean(0), s.max(0), s.min(0)], s[-1])

    def _codes_of(self, volts: Volts) -> np.ndarray:
        work = np.multiply(volts, self._scale, out=self._work)
        np.rint(work, out=work)
        np.maximum(work, -32768.0, out=work)
        np.minimum(work, 32767.0, out=work)
        self._codes[:] = work
        return self._codes

    def _digital_code(self, word: int, t_ns: int) -> int:
        """Return the digital, rate and counter words (pages 60, 66)."""
        function = word & 0xF
        if function == DIGITAL:
            levels = self._din()
            code = (levels << 8) | (~levels & 0x3)
        elif function == RATE:
            code = min(int(self.pulse_hz / RATE_RANGES_HZ[(word >> 8 & 0xF) - 1] * 65536), 65535) - 32768
        else:
            code = int(self.pulse_hz * (t_ns - self._counter_zero_ns) * 1e-9) % 65536 - 32768
        return code - 65536 if code > 32767 else code

    def _emit(self, data: bytes) -> None:
        room = self._fifo_bytes - len(self._out) - len(self._partial) - self.unread
        if len(data) > room:
            self._partial += data[: max(room, 0) // 2 * 2]
            self._overflow()
            return
        if not self._partial and len(data) == self._packet_bytes:
            self._out += data
            return
        self._partial += data
        if full := len(self._partial) // self._packet_bytes * self._packet_bytes:
            self._out += self._partial[:full]
            del self._partial[:full]

    def _end_scan(self, tail: bytes) -> None:
        self.scanning = False
        self._out += self._partial
        self._partial.clear()
        self._out += tail

    def _overflow(self) -> None:
        self.overflows += 1
        self._end_scan(b"stop 01")

    def _skip_to(self, t_ns: int) -> None:
        period = self._num // self._den
        self._conversion = (t_ns - self._start_ns) // max(period, 1)
        self._next_ns = self._start_ns + (self._conversion + 1) * self._num // self._den

    # ------------------------------------------------------------------ commands

    def _execute(self, line: str) -> None:
        name, _, rest = line.partition(" ")
        if name == "stop" and not rest:
            if self.scanning:
                self._end_scan(b"")
            self._out += b"stop\r"
            return
        if name == "start":
            if rest not in ("", "0"):
                self._reply(NOT_FOUND)
            elif not self.scanning:
                self._prepare_scan(self._now_ns)
                self.scanning = bool(self._entries)
            return
        handler = self._commands.get(name)
        try:
            reply = handler(line, rest) if handler else NOT_FOUND
        except (ValueError, IndexError):
            reply = NOT_FOUND
        self._reply(reply)

    def _reply(self, text: str) -> None:
        if not self.scanning:  # page 16: no echo that would interrupt the data stream
            self._out += text.encode("latin-1") + b"\r"

    def _command_table(self) -> dict[str, Callable[[str, str], str]]:
        s = self.settings
        return {
            "*IDN?": lambda line, rest: f"*IDN? DATAQ,DI-4108,{self._serial_number},{self._firmware / 100:.2f}",
            "info": self._info,
            "ps": self._ps,
            "encode": self._setter(0, 1, lambda v: setattr(s, "ascii_output", bool(v))),
            "eol": self._eol,
            "slist": self._slist,
            "srate": self._setter(375, 65535, lambda v: setattr(s, "srate", v)),
            "dec": self._setter(1, 512, lambda v: setattr(s, "dec", v)),
            "deca": self._setter(1, 40000, lambda v: setattr(s, "deca", v)),
            "filter": self._filter,
            "ffl": self._setter(1, 64, lambda v: setattr(s, "ffl", v)),
            "led": self._setter(0, 7, lambda v: setattr(self, "led", v)),
            "endo": self._setter(0, 127, self._set_endo),
            "dout": self._setter(0, 127, self._set_dout),
            "din": lambda line, rest: NOT_FOUND if rest else f"din {self._din()}",
            "reset": self._setter(1, 1, lambda v: setattr(self, "_counter_zero_ns", self._now_ns)),
        }

    @staticmethod
    def _setter(lo: int, hi: int, apply: Callable[[int], None]) -> Callable[[str, str], str]:
        def command(line: str, rest: str) -> str:
            apply(_integer(rest, lo, hi))
            return line

        return command

    def _info(self, line: str, rest: str) -> str:
        number, _, text = rest.partition(" ")
        if number == "5" and text:
            self.settings.description = text.strip('"')[:31]
            return line
        answers = {
            "0": "DATAQ",
            "1": self.model,
            "2": f"{self._firmware:X}",
            "5": self.settings.description,
            "6": self._serial_number,
            "9": str(DIVIDEND_HZ),
        }
        return f"{line} {answers[number]}" if number in answers and not text else NOT_FOUND

    def _ps(self, line: str, rest: str) -> str:
        if rest:
            self.settings.packet_code = _integer(rest, 0, 7)
            return line
        return f"ps {16 << self.settings.packet_code}"

    def _eol(self, line: str, rest: str) -> str:
        """Obey ``eol`` (page 38): it acts in ASCII mode only. The vendor's examples send it before ``encode 1``."""
        code = _integer(rest, 0, 2)
        self.settings.eol = (b"\r", b"\n", b"\r\n")[code]
        return line

    def _slist(self, line: str, rest: str) -> str:
        """Obey ``slist`` (page 39): position 0 starts a new list; positions are in sequence; each channel occurs
        once."""
        first, second = rest.split(" ")
        words = self.settings.words
        position, word = _integer(first, 0, 10), _integer(second, 0, 0xFFFF)
        kept = [] if position == 0 else words
        function = word & 0xF
        is_duplicate = any(w & 0xF == function for i, w in enumerate(kept) if i != position and w != IGNORE)
        if position > len(kept) or (word != IGNORE and (is_duplicate or not _legal_word(word))):
            return NOT_FOUND
        self.settings.words = [*kept[:position], word, *kept[position + 1 :]]
        return line

    def _filter(self, line: str, rest: str) -> str:
        channel, mode = rest.split(" ")
        self.settings.filters[_integer(channel, 0, 7)] = _integer(mode, 0, 3)
        return line

    def _set_endo(self, mask: int) -> None:
        self._endo = mask
        self._set_dout(0)  # page 57: all ports are re-initialised

    def _set_dout(self, mask: int) -> None:
        before, self.switches = self.switches, mask & self._endo
        if self.switches != before and self._on_switches is not None:
            self._on_switches(self.switches, self._now_ns)

    def _din(self) -> int:
        return (self.digital_levels & ~self._endo & 0x7F) | self.switches


def _integer(text: str, lo: int, hi: int) -> int:
    if not (text.isascii() and text.isdigit()) or not lo <= int(text) <= hi:
        raise ValueError(text)
    return int(text)


def _legal_word(word: int) -> bool:
    """Return True for a legal word (page 44): function in bits 3..0, range code in bits 11..8, all others 0."""
    function, code = word & 0xF, word >> 8 & 0xF
    if word & 0xF0F0 or function > COUNTER:
        return False
    if function < DIGITAL:
        return code < len(RANGES_V)
    return 1 <= code <= len(RATE_RANGES_HZ) if function == RATE else code == 0
