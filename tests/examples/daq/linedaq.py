"""A home-made DAQ that prints a line a scan: "SEQUENCE COUNTS...", 16-bit sequence, signed 16-bit counts of +-range.

Commands, each with a line feed: "who" is answered by "linedaq 1", "go RATE CHANNEL...", "halt", "out BITS".
"""

from drivers.daq.scan_by_scan import ScanByScan
from drivers.options import DaqOptions
from drivers.registry import Driver, Site
from hal.errors import ProtocolError, WrongDevice
from hal.types import ScanConfig


class LineDaq(ScanByScan):
    def __init__(self, site: Site) -> None:
        super().__init__(site.bench.serial(site.spec.bus or ""), site.bench.clock, site.name)

    def probe(self) -> str:
        self.stop()
        self._port.write(b"who\n", 0.5)
        answer = self.line(0.5)
        if answer is None or not answer.startswith(b"linedaq "):
            raise WrongDevice(f"'who' was answered by {answer!r}, not by 'linedaq'", device=self.name)
        return answer.decode()

    def begin(self, config: ScanConfig) -> None:
        self._port.write(f"go {config.rate_hz:g} {' '.join(map(str, config.channels))}\n".encode(), 0.5)

    def next_scan(self, timeout_s: float) -> tuple[int, list[int]] | None:
        line = self.line(timeout_s)
        try:
            return None if line is None else (int(line.split()[0]), [int(word) for word in line.split()[1:]])
        except (ValueError, IndexError) as error:
            raise ProtocolError(f"{line!r} is no scan", device=self.name) from error

    def write_digital(self, bits: int) -> None:
        self._port.write(f"out {bits}\n".encode(), 0.5)

    def stop(self) -> None:
        self._port.write(b"halt\n", 0.5)
        self.forget_input()


DRIVER = Driver(DaqOptions, LineDaq, "daq", bits_per_s=lambda o: o.rate_hz * 10 * 7 * (1 + len(o.channels)))
