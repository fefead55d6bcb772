"""Compares the offers of a machine with the needs of a bench, as findings with a remedy."""

from __future__ import annotations

import glob
import importlib.util
import os
import platform
import resource
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from drivers.bus_use import bus_shares, bus_uses
from drivers.polling import polling_of
from drivers.specs import check_devices
from firmware_py.machine.settings import MachineState, read_machine
from firmware_py.machine.tree import Tree
from hal.bench import SIM_SCHEME, BenchFile

Verdict = Literal["ok", "missing", "limited"]


@dataclass(frozen=True)
class Finding:
    """Holds one line of the report. ``remedy`` says what to do and is empty when all is well."""

    part: str
    verdict: Verdict
    detail: str
    remedy: str = ""


def setting_findings(tree: Tree, ports: Sequence[str] = ()) -> list[Finding]:
    """Return one finding for each setting of the machine that decides how late a loop wakes up. ``ports``: those of
    ``read_machine``."""
    return [_setting_finding(state) for state in read_machine(tree, ports)]


def _setting_finding(state: MachineState) -> Finding:
    setting = state.setting
    if state.is_good:
        return Finding(setting.name, "ok", state.describe())
    how = setting.remedy + ("; until then `micron doctor --set`" if setting.set is not None else "")
    return Finding(
        setting.name, "limited", f"{state.describe()}; wanted: {setting.wanted}", f"{setting.explain}: {how}"
    )


def machine_findings() -> list[Finding]:
    """Return the findings about this machine, for any bench."""
    findings = [Finding("python", "ok", f"{platform.python_version()} on {platform.system()} {platform.release()}")]
    ports = sorted(glob.glob("/dev/ttyACM*") + glob.glob("/dev/ttyUSB*"))
    findings.append(Finding("serial ports", "ok" if ports else "limited", ", ".join(ports) or "none"))
    buses = sorted(glob.glob("/dev/i2c-*"))
    findings.append(
        Finding(
            "I2C buses",
            "ok" if buses else "limited",
            ", ".join(buses) or "none",
            "" if buses else "load the i2c-dev module (modprobe i2c-dev) and join the group 'i2c' for real devices",
        )
    )
    findings.append(_can_finding())
    findings.append(_priority_finding())
    memory = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    unlimited = memory == resource.RLIM_INFINITY or os.geteuid() == 0
    findings.append(
        Finding(
            "memory lock",
            "ok" if unlimited else "limited",
            "unlimited" if unlimited else f"{memory} bytes",
            "" if unlimited else "set 'memlock unlimited' for your user in /etc/security/limits.d",
        )
    )
    cores = os.cpu_count() or 1
    findings.append(
        Finding(
            "processor cores",
            "ok" if cores >= 2 else "limited",
            str(cores),
            "" if cores >= 2 else "the loop and the emulated world need a core each for real time; use --virtual",
        )
    )
    for package, need in (("nidaqmx", "NI DAQ"), ("pyarrow", "export to parquet"), ("fmpy", "FMU twins")):
        is_installed = importlib.util.find_spec(package) is not None
        extra = {"nidaqmx": "ni", "pyarrow": "parquet", "fmpy": "fmu"}[package]
        findings.append(
            Finding(
                f"package {package} ({need})",
                "ok" if is_installed else "limited",
                "installed" if is_installed else "not installed",
                "" if is_installed else f"pip install 'micron-bench[{extra}]' when you need it",
            )
        )
    return findings


def _can_finding() -> Finding:
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        return Finding(
            "SocketCAN",
            "limited",
            f"not in this kernel ({error.strerror})",
            "use slcan:// or udp-multicast:// URIs",
        )
    interfaces = [Path(p).name for p in glob.glob("/sys/class/net/*can*")]
    return Finding("SocketCAN", "ok" if interfaces else "limited", ", ".join(interfaces) or "no CAN interface up")


def _priority_finding() -> Finding:
    old = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))
        os.sched_setscheduler(0, *old)
    except PermissionError:
        return Finding(
            "real-time priority",
            "limited",
            "SCHED_FIFO is not permitted",
            "add 'rtprio 80' for your user in /etc/security/limits.d, or grant CAP_SYS_NICE",
        )
    return Finding("real-time priority", "ok", "SCHED_FIFO permitted")


def bench_findings(bench: BenchFile) -> list[Finding]:
    """Return the findings about the needs of the bench file."""
    description = bench.description
    options = check_devices(description, str(bench.path))
    uses = bus_uses(description, options, polling_of(description, options)[0])
    shares = bus_shares(uses)
    findings: list[Finding] = []
    for name, spec in description.bus.items():
        findings.append(_bus_finding(name, spec.uri))
    for name in description.bus:
        if name in shares:
            detail = f"{100 * shares[name]:.0f} % of its time: "
            detail += "; ".join(str(use) for use in uses if use.bus == name)
            findings.append(Finding(f"load of {name}", "ok", detail))
        elif any(spec.bus == name and spec.driver == "di4108" for spec in description.device.values()):
            findings.append(Finding(f"load of {name}", "ok", "USB: its baud does not limit it"))
    for name, spec in description.device.items():
        where = spec.bus or spec.daq or spec.adc or "-"
        address = f" at 0x{spec.address:02x}" if spec.address is not None else ""
        findings.append(Finding(f"device {name}", "ok", f"{spec.driver} on {where}{address}"))
    named = description.firmware.get("calibration", ())
    if isinstance(named, list):  # the firmware's own check says what is wrong with anything else
        findings += [_file_finding(bench, "calibration", str(name)) for name in named]
    return findings


def _file_finding(bench: BenchFile, what: str, name: str) -> Finding:
    """A file that the firmware reads before it opens anything; its name is relative to the bench file."""
    path = bench.path.parent / name
    if path.is_file():
        return Finding(f"{what} {path.stem}", "ok", name)
    remedy = f"copy it beside the bench file, or name the one of your instrument under [firmware] {what}"
    return Finding(f"{what} {path.stem}", "missing", f"{path} is not there", remedy)


def _bus_finding(name: str, uri: str) -> Finding:
    part = f"bus {name}"
    if uri.startswith(SIM_SCHEME):
        return Finding(part, "ok", f"{uri}: emulated")
    scheme, _, rest = uri.partition("://")
    path = {"serial": rest.split("?")[0], "slcan": rest.split("?")[0], "linux-i2c": f"/dev/i2c-{rest}"}.get(scheme)
    if path is None and scheme == "socketcan":
        path = f"/sys/class/net/{rest}"
    if path is not None and not Path(path).exists():
        return Finding(part, "missing", f"{uri}: {path} is not there", "plug it in, or correct the URI")
    if path is not None and path.startswith("/dev") and not os.access(path, os.R_OK | os.W_OK):
        return Finding(part, "missing", f"{uri}: no permission on {path}", "join the group that owns it (ls -l)")
    return Finding(part, "ok", uri)
