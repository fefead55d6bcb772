"""Lists every finding that interrupts or ends normal operation, with its message, its cause and its consequence.

A finding is *recoverable* or *latched*. A recoverable one has a cause that can pass, and what follows can be checked
before the outputs move again: the outputs ramp to neutral, hold there, and go on (``holds.py``). A latched one says
that what is known of the sensors or the outputs is wrong, or that a person wanted the end: the outputs stay in the
safe state until a person acts. A hold begins only in the state RUNNING; ``Incidents.report`` says what a recoverable
finding does in the other states.
Models: ArduPilot's failsafe actions, IEC 61800-5-2 (a stop that holds against one that removes power), the fault
protection of F Prime. ``docs/findings.md`` is this table, made by ``python -m tools.research.reports.findings_page``.
"""

from __future__ import annotations

from enum import Enum, StrEnum, unique
from typing import NamedTuple

from hal.errors import (
    BusError,
    Disconnected,
    ErrorKind,
    HalError,
    HalTimeout,
    LeaseLost,
    Overrun,
    ProtocolError,
)


class CauseClass(StrEnum):
    """Names the place where the cause of a finding lies."""

    HOST = "host"
    LINK = "link"
    DEVICE = "device"
    OPERATOR = "operator"


class FindingEntry(NamedTuple):
    """Holds one row of the table. ``says`` is the message with its fields in braces, ``why`` the reason for the row's
    consequence."""

    title: str
    cause: CauseClass
    recoverable: bool
    says: str
    why: str
    normal: bool = False
    """True for an ordinary end of a run, which exits with status 0."""


def _recoverable(title: str, cause: CauseClass, says: str, why: str) -> FindingEntry:
    return FindingEntry(title, cause, True, says, why)


def _latched(title: str, cause: CauseClass, says: str, why: str) -> FindingEntry:
    return FindingEntry(title, cause, False, says, why)


def _end(title: str, says: str, why: str) -> FindingEntry:
    return FindingEntry(title, CauseClass.OPERATOR, False, says, why, normal=True)


_HOST, _LINK, _DEVICE, _OPERATOR = CauseClass


@unique
class Finding(Enum):
    """Enumerates all findings. The value of a member is its row of the table."""

    # -- scans
    SCANS_MISSING = _recoverable(
        "no scans",
        _LINK,
        "{device}: no new scan for {limit_ms:g} ms; check its link",
        "A link that is silent for a while has said nothing that is wrong; what comes later can be checked.",
    )
    HOST_OVERSLEPT = _recoverable(
        "the host stood still",
        _HOST,
        "this host stood still for {stall_ms:.1f} ms, and {device} has had no new scan since; see docs/lab-machine.md",
        "The loop itself was not awake, so its silence says nothing of the device.",
    )
    HOST_LATE = _recoverable(
        "the host was late",
        _HOST,
        "the host stood still: {scans} scans of {device} came at once; see docs/lab-machine.md",
        "All scans are there and the filters see every one; only the outputs were left alone too long.",
    )
    SUPERVISION_SILENT = _recoverable(
        "the supervision was silent",
        _HOST,
        "Python beside the compiled loop was silent for {silent_ms:.0f} ms: the loop took the outputs to neutral",
        "The loop ran, but nobody watched over it; what comes later can be watched again.",
    )
    DAQ_OVERFLOW = _recoverable(
        "scans overflowed",
        _DEVICE,
        "{error}",
        "The device stopped itself and says so; a scan that is started anew is whole again.",
    )
    DAQ_OVERFLOW_BY_HOST = _recoverable(
        "scans overflowed while the host stood still",
        _HOST,
        "this host stood still for {stall_ms:.1f} ms: {error}",
        "The device stopped itself because nobody read; a scan that is started anew is whole again.",
    )
    DAQ_TRANSFER = _recoverable(
        "a transfer of scans failed",
        _LINK,
        "{error}",
        "Bytes were lost and the driver knows it; a scan that is started anew is aligned again.",
    )
    DAQ_GONE = _latched(
        "the DAQ is gone",
        _LINK,
        "{error}",
        "What comes back on a port that went away may be another device: it must be opened and probed anew.",
    )
    DAQ_FAILED = _latched(
        "the DAQ failed",
        _DEVICE,
        "{error}",
        "It answered what its manual does not allow, or could not be started again.",
    )
    # -- readings
    INPUT_IMPOSSIBLE = _latched(
        "an input read something impossible",
        _DEVICE,
        "{what}",
        "A wire, sensor or converter is broken; loose contacts come and go, and six axes have no spare.",
    )
    AXES_CONTRADICT = _latched(
        "axes contradict each other",
        _DEVICE,
        "{what}",
        "Which axis is wrong is not known, and no waiting tells.",
    )
    PAIRS_DISAGREE = _latched(
        "parallel axes disagree",
        _DEVICE,
        "{what}",
        "One of the two has drifted or is calibrated wrongly, and no waiting tells which.",
    )
    NOT_A_NUMBER = _latched(
        "not a number",
        _DEVICE,
        "a reading or estimate is not a number; see the recording",
        "The estimate is broken, or the code that made it; neither mends itself.",
    )
    SATURATED = _recoverable(
        "saturation",
        _DEVICE,
        "an accelerometer has been beyond its range for {limit_ms:g} ms; is the instrument falling?",
        "Motion that is too fast for the sensors ends, and the attitude aligns again.",
    )
    TEMPERATURE_OUTSIDE = _recoverable(
        "temperature",
        _DEVICE,
        "temperature {value:.2f} degC is outside {low:g}..{high:g} degC",
        "The calibration does not hold outside its range and holds again inside.",
    )
    SUPPLY_OUTSIDE = _recoverable(
        "supply",
        _DEVICE,
        "supply {value:.2f} V is outside {low:g}..{high:g} V",
        "The sensors are ratiometric: with their supply back they read as before.",
    )
    MAGNETOMETER_SILENT = _recoverable(
        "magnetometer",
        _LINK,
        "{error}",
        "The heading may coast only so long; it is right again with the first fresh field.",
    )
    MAGNETOMETER_HANGS = _recoverable(
        "magnetometer hangs",
        _DEVICE,
        "{device}: its converter gives one reading for all axes; it hangs",
        "As for a silent one: nothing false is used, and fresh readings show that it works again.",
    )
    # -- sensors of another kind
    SAMPLES_MISSING = _recoverable(
        "no samples",
        _LINK,
        "{device}: no sample for {limit_ms:g} ms; check its link and battery",
        "A sensor that is silent has said nothing that is wrong; the view goes on from where it stands.",
    )
    SENSOR_TRANSFER = _recoverable(
        "a transfer from a sensor failed",
        _LINK,
        "{error}",
        "The driver knows that the reading was lost; the next one is whole.",
    )
    SENSOR_FAILED = _latched(
        "a sensor failed",
        _DEVICE,
        "{error}",
        "It went away, or answered what its manual does not allow: it must be opened and probed anew.",
    )
    # -- outputs
    OUTPUT_TRANSFER = _recoverable(
        "a transfer to the outputs failed",
        _LINK,
        "{error}",
        "A command did not arrive and the driver knows it; the ramp and the arming read the outputs back.",
    )
    OUTPUT_TAKEN = _recoverable(
        "the guardian has the outputs",
        _HOST,
        "{device}: the host stood still: the guardian has the outputs and takes them to neutral",
        "The guardian reads neutral back, and gives the outputs back in a handshake.",
    )
    LEASE_LOST = _recoverable(
        "the host stood still too long for its outputs",
        _HOST,
        "{error}",
        "As above; the command that was late was not sent.",
    )
    GUARDIAN_LOST = _recoverable(
        "the guardian is lost",
        _HOST,
        "the guardian of the outputs is lost: {what}; a new one is started",
        "Nobody would take the outputs to neutral if the firmware died; they wait there until a new guardian watches.",
    )
    GUARDIAN_FAILED = _latched(
        "no new guardian",
        _HOST,
        "the guardian of the outputs was lost, and {error}",
        "Outputs that nobody watches over are not armed.",
    )
    MONITOR_DEAF = _recoverable(
        "monitor",
        _LINK,
        "{error}",
        "Unwatched outputs are not known to be wrong; they wait at neutral until they are watched again.",
    )
    OUTPUT_DIFFERS = _latched(
        "an output differs from its command",
        _DEVICE,
        "{device}: {what}",
        "The amplifier, a cable or a stack is broken, the converter restarted, or somebody else commands it.",
    )
    OUTPUT_FAILED = _latched(
        "the outputs failed",
        _DEVICE,
        "{error}",
        "The output went away, contradicted its command, refused it as unsafe, or could not be armed.",
    )
    NEUTRAL_NOT_REACHED = _latched(
        "neutral not confirmed",
        _DEVICE,
        "{what}",
        "A hold needs outputs that are known to be at neutral.",
    )
    # -- stop button
    BUTTON_PRESSED = _latched(
        "stop button",
        _OPERATOR,
        "stop button pressed",
        "A person wants the end.",
    )
    BUTTON_SILENT = _recoverable(
        "stop button silent",
        _LINK,
        "{device}: the stop button is not heard any more; check the CAN bus and the button",
        "Nobody could stop the instrument; at neutral that may be waited out.",
    )
    BUTTON_BUS = _recoverable(
        "the bus of the stop button failed",
        _LINK,
        "{error}",
        "As for a silent button; a CAN controller recovers from bus-off by itself where it is set so.",
    )
    BUTTON_GONE = _latched(
        "the stop button's adapter is gone",
        _LINK,
        "{error}",
        "An adapter that went away must be opened anew.",
    )
    # -- the run
    SELF_TEST_FAILED = _latched(
        "self-test",
        _DEVICE,
        "self-test: {what} after {limit_ms:g} ms",
        "What did not become good in that time needs a look.",
    )
    SELF_TEST_DISTURBED = _latched(
        "self-test disturbed",
        _HOST,
        "self-test: {what} after {limit_ms:g} ms, in which this host stood still again and again; "
        "see docs/lab-machine.md",
        "Sensors cannot be watched without interruption by a loop that is interrupted.",
    )
    TOO_MANY_HOLDS = _latched(
        "too many holds",
        _DEVICE,
        "hold {count} within a minute, more than [firmware.safety] holds_per_minute = {limit}: {what}",
        "What passes again and again has not passed.",
    )
    HOLD_TOO_LONG = _latched(
        "hold too long",
        _DEVICE,
        "{what}; it has not passed within {limit_ms:g} ms ([firmware.safety] hold_limit_ms)",
        "What does not pass by itself needs a person.",
    )
    DEVICE_FAILED = _latched(
        "a device failed",
        _DEVICE,
        "{error}",
        "An error that no other row knows.",
    )
    FIRMWARE_FAILED = _latched(
        "the firmware failed",
        _HOST,
        "{error}",
        "A program that is wrong is not to be trusted with outputs.",
    )
    STOPPED = _end("stopped by the operator", "stopped by the operator ({signal})", "A person wants the end.")
    STOPPED_ON_PAGE = _end(
        "stopped on the page", "stopped by the operator (safe button of the bench page)", "A person wants the end."
    )
    TARGETS_REACHED = _end("targets reached", "all targets reached", "The experiment is over.")
    FINISHED = _end("finished", "run finished", "The time that was asked for is over.")


def classify_scan_error(error: HalError, stall_ms: float) -> Finding:
    """Return the finding for an error of reading scans. ``stall_ms`` is how long this host has just stood still (ms),
    0 if it has not."""
    match error:
        case Disconnected():
            return Finding.DAQ_GONE
        case Overrun():
            return Finding.DAQ_OVERFLOW_BY_HOST if stall_ms else Finding.DAQ_OVERFLOW
        case BusError() | HalTimeout():
            return Finding.DAQ_TRANSFER
        case ProtocolError(kind=ErrorKind.FRAMING):
            return Finding.DAQ_TRANSFER
        case _:
            return Finding.DAQ_FAILED


def classify_sensor_error(error: HalError) -> Finding:
    """Return the finding for an error of reading a sensor that has no scans."""
    match error:
        case Disconnected():
            return Finding.SENSOR_FAILED
        case BusError() | HalTimeout():
            return Finding.SENSOR_TRANSFER
        case _:
            return Finding.SENSOR_FAILED


def classify_button_error(error: HalError) -> Finding:
    """Return the finding for an error of the stop button's bus."""
    return Finding.BUTTON_GONE if isinstance(error, Disconnected) else Finding.BUTTON_BUS


def classify_output_error(error: HalError) -> Finding:
    """Return the finding for an error of a command or a read-back. An error that contradicts a command is never taken
    for a lost transfer."""
    match error:
        case LeaseLost():
            return Finding.LEASE_LOST
        case BusError() | HalTimeout():
            return Finding.OUTPUT_TRANSFER
        case _:
            return Finding.OUTPUT_FAILED
