"""Every fault of the campaign, by the room in which it happens. Names are stable: results are compared by them."""

from __future__ import annotations

from dataclasses import replace

from tools.research.faults.fault import Expected, Fault, InWorld, Kill, OnBus, OnHost, OutOfMemory

DAC, ADC = 0x0C, 0x48
DAQ = ("daq", "acc", "DAQ input")
PIEZO = ("piezo", "0x0c")
NO_SUM = "the DI-4108 protocol has no checksum; an error below the jump limit looks like motion"
ONE_BYTE = (
    "each wrong command stands for 1 ms; registers are read back at 100 Hz, outputs measured at 400 Hz; with "
    "`read_back = true` at the amplifier every command is read back within its own transfer (0.21 ms more of the bus), "
    "and each wrong one is known: benches/micron-read-back.toml, below"
)
LOOKS = "each output is measured every 7.5 ms, a small difference twice before it is believed"
RESUMES_S = 0.7
"""Watched for so long where outputs are expected to hold and to resume: the cause, 20 ms, 200 ms, a new alignment."""
GUARDED = "the guardian notices after 8 ms, and takes the outputs to neutral after 40 ms without a command"


def faults() -> tuple[Fault, ...]:
    """Return all faults, in the order of the table."""
    rooms = (serial_line, daq_device, sensors, output_bus, magnetometer, can_bus, actuators, host)
    return tuple(fault for room in rooms for fault in room())


def serial_line() -> tuple[Fault, ...]:
    def line(
        name: str, expected: str, *, names: tuple[str, ...] = DAQ, why: str = "", watch_s: float = 0.15, **plan: float
    ) -> Fault:
        return Fault(f"serial: {name}", OnBus("daq0", plan), expected, names, watch_s, effect=1, why=why)  # type: ignore[arg-type]

    return (
        line("one byte in a thousand lost", "holds", loss=0.001),
        line("a burst of lost bytes", "holds", loss=0.3, for_s=0.004),
        line("one bit in ten thousand bytes flipped", "cannot be seen", corruption=1e-4, why=NO_SUM),
        line("one bit in a hundred bytes flipped", "safe state", corruption=0.01),
        line("bytes doubled", "holds", duplication=0.001),
        line("neighbouring bytes exchanged", "safe state", reorder=0.05),
        line("reads cut short", "holds", truncation=0.02),
        line("every tenth read 2 ms late", "noticed", delay=0.1, delay_s=0.002),
        line("a read 20 ms late now and then", "noticed", delay=0.02, delay_s=0.020, why=GUARDED),
        line("silence of 3 ms", "noticed", silent_after_s=0.0, silent_for_s=0.003),
        line("silence of 50 ms", "resumes", watch_s=RESUMES_S, silent_after_s=0.0, silent_for_s=0.05),
        line("silence", "holds", silent_after_s=0.0),
        line("cable pulled", "safe state", disconnect_after_s=0.0),
        line("cable pulled for 100 ms", "safe state", disconnect_after_s=0.0, reconnect_after_s=0.1),
    )


def daq_device() -> tuple[Fault, ...]:
    step = "arrivals vary by as much; the time line follows it"
    small = "100 ppm of a sample period is 0.1 us a tick; the time line follows it"
    return (
        Fault("daq: unplugged", InWorld("unplug", "daq"), "safe state", ("daq",)),
        Fault("daq: frozen", InWorld("freeze", "daq"), "holds", ("daq",)),
        Fault("daq: frozen for 3 ms", InWorld("freeze", "daq", "thaw", 0.003), "noticed", ("daq",)),
        Fault("daq: FIFO overflow", InWorld("overflow", "daq"), "resumes", ("overflow",), RESUMES_S),
        Fault("daq: crystal 100 ppm fast", InWorld("clock=100", "daq"), "harmless", why=small, redraws=True),
        Fault("daq: crystal 100 ppm slow", InWorld("clock=-100", "daq"), "harmless", why=small, redraws=True),
        Fault("daq: clock steps by 0.1 ms", InWorld("clock_step=100", "daq"), "cannot be seen", redraws=True, why=step),
        Fault("daq: clock steps by 0.4 ms", InWorld("clock_step=400", "daq"), "noticed", ("daq",), redraws=True),
        Fault("daq: clock steps by 2.5 ms", InWorld("clock_step=2500", "daq"), "noticed", ("daq",), redraws=True),
        Fault("daq: another model at start", InWorld("model=2108", "daq"), "refused", ("DI-4108",), at_start=True),
        Fault("daq: does not answer at start", InWorld("freeze", "daq"), "refused", ("daq",), at_start=True),
    )


def sensors() -> tuple[Fault, ...]:
    def one(name: str, fault: str, expected: str, channel: int = 1, why: str = "", watch_s: float = 0.15) -> Fault:
        words = ("acc", "DAQ input")
        how = InWorld(fault, str(channel))
        part = f"DAQ input {channel}"
        return Fault(f"sensor: {name}", how, expected, words, watch_s, why=why, redundant="noticed", part=part)  # type: ignore[arg-type]

    def plain(
        name: str, fault: str, target: str, expected: Expected, names: tuple[str, ...] = (), why: str = ""
    ) -> Fault:
        """Return a fault of an input that is an axis only in the layout with eight axes."""
        return Fault(f"sensor: {name}", InWorld(fault, target), expected, names, why=why, redundant="noticed")

    noise = (
        "six axes have no parity in motion (erratum 15): a few mV move the tip as far as they would if they were true; "
    )
    slow = noise + "parallel axes disagree after 0.4 s, longer than this run"
    fast = noise + "parallel axes disagree after 0.05 to 0.08 s, by more than tremor spreads them"
    return (
        one("stuck", "sensor_stuck", "safe state"),
        one("wire broken", "sensor_open", "safe state"),
        one("short to the supply", "sensor_short", "safe state"),
        one("at the end of its range", "sensor_saturate", "safe state"),
        one("drifts 0.05 V/s", "sensor_drift", "cannot be seen", why=slow),
        one("drifts 1 V/s", "sensor_drift=1", "safe state", watch_s=0.3, why=fast),
        one("one spike of 0.5 V", "sensor_spike", "safe state"),
        one("50 mV of noise", "sensor_noise", "safe state"),
        one("half the sensitivity", "sensor_gain", "safe state"),
        one("sign turned round", "sensor_sign", "safe state"),
        replace(one("exchanged with its neighbour", "sensor_swap", "safe state", 2), redundant=None, part="DAQ input"),
        Fault("sensor: supply sags to 4.25 V", InWorld("supply=0.85", ""), "safe state", ("supply", "acc"), 0.3),
        Fault(
            "sensor: supply sags by 1 %",
            InWorld("supply=0.99", ""),
            "noticed",
            ("acc",),
            redundant="safe state",
            why="ratiometric: it cancels but for the spread of the sensors' filters",
        ),
        plain("temperature wire broken", "sensor_open", "7", "safe state", ("temperature",)),
        plain("supply wire broken", "sensor_open", "6", "safe state", ("supply",)),
        plain("supply reading stuck", "sensor_stuck", "6", "harmless", ("supply",), why="the supply moves slowly"),
        Fault("sensor: stuck at start", InWorld("sensor_stuck", "1"), "refused", ("acc", "DAQ input"), at_start=True),
        Fault("sensor: wire broken at start", InWorld("sensor_open", "1"), "refused", ("acc", "DAQ"), at_start=True),
        Fault("sensor: exchanged at start", InWorld("sensor_swap", "2"), "refused", ("acc", "DAQ"), at_start=True),
    )


def output_bus() -> tuple[Fault, ...]:
    def piezo(
        name: str, expected: Expected, *, why: str = "", watch_s: float = 0.15, slow: bool = False, **plan: float
    ) -> Fault:
        how, own = OnBus("i2c0", plan, only=DAC), "write_corruption" in plan
        return Fault(
            f"output bus: {name}", how, expected, PIEZO, watch_s, own_output=own, effect=4, why=why, slow=slow
        )  # fmt: skip

    deaf, stuck = InWorld("nack", "piezo", "ack", 0.002), InWorld("stuck", "i2c0", "free", 0.005)
    return (
        Fault("output bus: DAC refuses its address", InWorld("nack", "piezo"), "safe state", PIEZO),
        Fault("output bus: DAC refuses data", InWorld("nack_data", "piezo"), "safe state", PIEZO),
        Fault("output bus: DAC deaf for 2 ms", deaf, "resumes", PIEZO, RESUMES_S),
        Fault("output bus: SDA stuck", InWorld("stuck", "i2c0"), "safe state", ("piezo", "i2c", "SDA")),
        Fault("output bus: SDA stuck for 5 ms", stuck, "resumes", ("SDA",), RESUMES_S),
        Fault("output bus: DAC restarts", InWorld("brown_out", "piezo"), "safe state", PIEZO, own_output=True),
        Fault("output bus: DAC holds its outputs", InWorld("freeze", "piezo"), "safe state", PIEZO),
        piezo("one transfer in a hundred refused", "holds", watch_s=0.6, nack=0.01),
        piezo("half of the transfers lost", "holds", loss=0.5),
        piezo("a bit wrong in every transfer", "safe state", write_corruption=1.0, why=ONE_BYTE),
        piezo("a bit wrong in one transfer of ten", "safe state", write_corruption=0.1, why=ONE_BYTE, slow=True),
        piezo("a bit wrong in one transfer of a thousand", "cannot be seen", write_corruption=0.001, why=ONE_BYTE),
        piezo("transfers 1 ms late", "noticed", delay=1.0, delay_s=0.001),
        piezo("transfers sent twice", "noticed", duplication=1.0),
        piezo("silence", "safe state", silent_after_s=0.0),
        piezo("adapter unplugged", "safe state", disconnect_after_s=0.0),
        Fault("output bus: no DAC at start", InWorld("nack", "piezo"), "refused", ("piezo", "0x0c"), at_start=True),
        Fault("output bus: DAC holds at start", InWorld("freeze", "piezo"), "refused", PIEZO, at_start=True),
    )


def magnetometer() -> tuple[Fault, ...]:
    coasts = "the heading coasts for 150 ms"
    waits = "the driver waits for the longest conversion of the data sheet and does not ask the bit"
    return (
        Fault("magnetometer: ADC refuses its address", InWorld("nack", "mag_adc"), "holds", ("mag", "0x48"), 0.3),
        Fault("magnetometer: ADC never ready", InWorld("freeze", "mag_adc"), "holds", ("mag",), 0.3),
        Fault("magnetometer: ADC always says ready", InWorld("always_ready", "mag_adc"), "harmless", why=waits),
        Fault("magnetometer: one transfer in ten refused", OnBus("i2c1", {"nack": 0.1}, ADC), "noticed", ("mag",)),
        Fault(
            "magnetometer: bits of its readings flipped", OnBus("i2c1", {"corruption": 0.1}, ADC), "noticed", ("mag",),
            why="gated by the field's norm; " + coasts,
        ),
        Fault("magnetometer: no ADC at start", InWorld("nack", "mag_adc"), "refused", ("0x48",), at_start=True),
    )  # fmt: skip


def can_bus() -> tuple[Fault, ...]:
    def frames(name: str, expected: str, *, watch_s: float = 0.3, why: str = "", **plan: float) -> Fault:
        names = ("CAN", "stop button", "can0", "bus-off")
        return Fault(f"can: {name}", OnBus("can0", plan), expected, names, watch_s, effect=1, why=why)  # type: ignore[arg-type]

    heard = "the button is heard often enough"
    return (
        Fault("can: stop button pressed", InWorld("press", ""), "safe state", ("stop button",), 0.3),
        Fault("can: bus silent", InWorld("silence", "can0"), "holds", ("stop button",), 1.8),
        frames("one frame in five lost", "harmless", loss=0.2, why=heard),
        frames("bits of frames flipped", "harmless", corruption=0.2, why="counters and range checks; " + heard),
        frames("frames doubled", "harmless", duplication=0.5, why=heard),
        frames("frames out of order", "harmless", reorder=0.5, why=heard),
        frames("frames cut short", "harmless", truncation=0.2, why=heard),
        frames("controller bus-off", "holds", watch_s=1.8, bus_off_after_s=0.0),
        frames("error frames", "harmless", error_frames_hz=500.0, why=heard),
        frames("a node babbles", "harmless", babble_hz=4000.0, why="a poll reads a bounded number of frames"),
        frames("adapter unplugged", "safe state", watch_s=1.8, disconnect_after_s=0.0),
    )


def actuators() -> tuple[Fault, ...]:
    def one(name: str, fault: str) -> Fault:
        how = InWorld(f"actuator_{fault}", "1")
        return Fault(f"actuator: {name}", how, "safe state", ("output 2 is at",), why=LOOKS)

    return (
        one("open", "open"),
        one("short to the rail", "rail"),
        one("stuck", "stuck"),
        one("slow", "slow"),
        one("half its gain", "weak"),
    )


def host() -> tuple[Fault, ...]:
    return (
        Fault("host: stalls for 3 ms", OnHost(3.0), "noticed", ("daq",), effect=0),
        Fault("host: stalls for 5 ms", OnHost(5.0), "noticed", ("daq",), effect=0),
        Fault("host: stalls for 50 ms", OnHost(50.0), "resumes", ("guardian",), RESUMES_S, effect=0, why=GUARDED),
        Fault("host: stalls for 500 ms", OnHost(500.0), "resumes", ("daq", "host"), 1.1, effect=0, why=GUARDED),
        Fault(
            "host: 8 MB of memory left",
            OutOfMemory(8.0),
            "harmless",
            ("memory",),
            effect=0,
            why="a tick allocates nothing",
        ),
        Fault("host: firmware killed (kill -9)", Kill("firmware"), "safe state", ("firmware died",), 0.3),
        Fault("host: guardian killed (kill -9)", Kill("guardian"), "resumes", ("guardian",), 1.1),
    )
