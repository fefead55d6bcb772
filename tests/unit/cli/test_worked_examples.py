"""The worked example of each command's help does what it says: run to the letter, on inputs made as the guides say.

Options are added in two cases: virtual time where the example means the bench in front of you, and less of the same
(seconds, cases, kinds of fault). The two that need a running bench page are run where one is, in ``tests/bench``; the
one that needs a server of files in ``tests/unit/cli/test_data.py``.
"""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import Result

from sim_devices.plant.lab import main as lab
from tests.command import micron
from tests.examples.conftest import install
from tests.unit.calibrate.test_gyroscope import log
from tests.unit.cli.test_examples import ALL, EXAMPLE

ROOT = Path(__file__).parents[3]
BENCHES, DOCS, CHIP = ROOT / "benches", ROOT / "docs", ROOT / "tests" / "examples" / "i2c_chip"
ADDED = {
    "dump": "--virtual",
    "capture": "--virtual",
    "faults": "--seeds 1 --jobs 1 --only 'clock steps by 2.5 ms'",
    "hands": "--seconds 8",
    "imu": "--seconds 5",
    "latency": "--hours 0.001 --policy other --no-firmware",
    "mismatch calibrate": "--samples 500 --minutes 0.001",
    "mismatch heal": "--runs 3 --seconds 5",
    "mismatch prove": "--cases 1 --jobs 1",
    "ramp": "--virtual",
    "read": "--virtual",
    "run": "--seconds 3 --record out/run.mcap",
    "scan": "--virtual",
    "scope": "--virtual --seconds 0.5",
    "soak": "--seconds 60",
    "tremor report": "--section detectors",
    "tremor train": "--window 20 --units 1",
}
OF_A_RUN = ("export", "recover", "replay")
# recordings of people, which are not part of the repository
OF_HANDS = ("hands", "tremor evaluate", "tremor inspect", "tremor report", "tremor train")
# over two seconds each: `make test-all`
SLOW = (
    "calibrate piezo",
    "endoscope tables",
    "faults",
    "hands",
    "imu",
    "mismatch apply",
    "mismatch diagnose",
    "mismatch heal",
    "mismatch plan",
    "mismatch prove",
    "mismatch simulate",
    "reproduce",
    "sensing budget",
    "soak",
    "tremor budget",
    "tremor evaluate",
    "tremor inspect",
    "tremor report",
    "tremor train",
)
WITH_A_PAGE = ("bench", "log")
WITH_A_SERVER = ("data fetch",)


def example(name: str) -> str:
    """The line of the help, with what is added to it, without ``micron``."""
    found = EXAMPLE.search(ALL[name][1].help or "")
    assert found is not None
    return f"{found.group(1).strip().splitlines()[0].removeprefix('micron ')} {ADDED.get(name, '')}"


def call(name: str) -> Result:
    return micron(*shlex.split(example(name), comments=True))


def logs() -> None:
    """``log.npz``: turns between poses; ``turned.npz``: a field from every side; ``rest.npz``: white noise."""
    force, rate = log(30)
    columns = {f"{s}_{a}_raw": v[:, i] for s, v in (("acc", force), ("gyro", rate)) for i, a in enumerate("xyz")}
    np.savez("log.npz", t_s=np.arange(len(force)) / 100.0, **columns)
    rng = np.random.default_rng(1)
    way = rng.standard_normal((400, 3))
    field = 400.0 * way / np.linalg.norm(way, axis=1)[:, None] + [20.0, -30.0, 5.0] + rng.standard_normal((400, 3))
    np.savez("turned.npz", **{f"mag_{a}_raw": field[:, i] for i, a in enumerate("xyz")})
    np.savez("rest.npz", x=rng.standard_normal(20_000))


def stacks() -> None:
    for axis in range(3):
        assert lab(["piezo", "--axis", str(axis), "--profile", "set", "--out", f"out/stack{axis}"]) == 0


def recorded_stack(folder: str) -> None:
    assert lab(["piezo", "--profile", "sawtooth", "--rate-hz", "5", "--seconds", "4", "--out", folder]) == 0


def diagnosed() -> None:
    recorded_stack("rec")
    done = micron("mismatch", "diagnose", "rec", "--json", "rec.json")
    assert done.exit_code == 0, done.output


def recorded_twin() -> None:
    """A stack and the twin that its recording names."""
    assert lab(["piezo", "--profile", "sawtooth", "--rate-hz", "5", "--seconds", "90", "--out", "rec"]) == 0
    said = Path("rec/recording.toml").read_text()
    Path("twin.toml").write_text(f"format = 1\n\n{said[said.index('[twin]') : said.index('[[channels]]')]}")


def rig() -> None:
    """Somebody's measurement: a force and where it moved something."""
    t = np.arange(400) / 100.0
    Path("rig").mkdir()
    np.savetxt("rig/data.csv", np.column_stack([t, np.sin(t), np.cos(t)]), delimiter=";", header="t_s;force_N;x_mm")


def pages() -> None:
    """The results that a new part is put into."""
    for name in ("long-runs", "tremor-on-real-hands"):
        shutil.copy(DOCS / "results" / f"{name}.json", f"docs/results/{name}.json")


MADE: dict[str, Callable[[], object]] = {
    "calibrate accelerometer": logs,
    "calibrate gyroscope": logs,
    "calibrate magnetometer": logs,
    "calibrate manipulator": lambda: lab(["manipulator", "--per-axis", "4", "--out", "out/scan"]),
    "calibrate piezo": stacks,
    "calibrate positions": lambda: lab(["pivot", "--seconds", "14", "--out", "out/pivot"]),
    "calibrate sensors": lambda: lab(["tumble", "--positions", "24", "--seconds", "1", "--out", "out/tumble"]),
    "mismatch apply": diagnosed,
    "mismatch simulate": lambda: (diagnosed(), call("mismatch apply")),
    "mismatch cut": lambda: recorded_stack("rec"),
    "mismatch diagnose": lambda: recorded_stack("recordings/stack"),
    "mismatch new": rig,
    "mismatch plan": lambda: recorded_stack("recordings/stack"),
    "mismatch watch": recorded_twin,
    "noise": logs,
    "read": lambda: shutil.copy(CHIP / "bench.toml", "lab.toml"),
    "soak": pages,
    "tremor report": pages,
    "trust": lambda: recorded_stack("recordings/from-a-stranger"),
}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One second of the default bench."""
    folder = tmp_path_factory.mktemp("recording")
    files = ["--record", str(folder / "run.mcap"), "--picture", str(folder / "run.png")]
    done = micron("run", "--virtual", "--seconds", "1", *files)
    assert done.exit_code == 0, done.output
    return folder / "run.mcap"


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder as a new user has it: the benches, and room for what is made."""
    shutil.copytree(BENCHES, tmp_path / "here" / "benches")
    for folder in ("docs/results", "out"):
        (tmp_path / "here" / folder).mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here")
    return tmp_path / "here"


LONG = (pytest.mark.slow, pytest.mark.timeout(900))
MARKS = {"latency": pytest.mark.realtime, **dict.fromkeys(SLOW, LONG)}
RUN = [pytest.param(name, marks=MARKS.get(name, ())) for name in sorted(set(ALL) - {*WITH_A_PAGE, *WITH_A_SERVER})]


@pytest.mark.parametrize("name", RUN)
def test_the_worked_example_works(name: str, place: Path, request: pytest.FixtureRequest) -> None:
    if name in OF_HANDS:
        (place.parent / "shared").mkdir()
        (place.parent / "shared" / "data").symlink_to(request.getfixturevalue("shared_data"))
    if name in OF_A_RUN:
        shutil.copy(request.getfixturevalue("recording"), "out")
    if name == "read":
        install(CHIP, place.parent, request.getfixturevalue("monkeypatch"))
    MADE.get(name, lambda: None)()
    done = call(name)
    assert done.exit_code == 0, done.output
    for word in shlex.split(example(name), comments=True):
        made = place / word
        if word.startswith("out/") and made.suffix:
            assert made.stat().st_size > 0


def test_a_part_of_a_run_differs_because_of_what_came_before_it(recording: Path, tmp_path: Path) -> None:
    part = str(tmp_path / "part.mcap")
    cut = micron("export", recording, part, "--raw", "--from", "0.5", "--to", "0.8")
    assert cut.exit_code == 0, cut.output
    done = micron("replay", part)
    assert done.exit_code == 1
    said = " ".join(done.output.split())
    assert re.search(r"of 300 ticks differ; the first: row 0, \w+: \S+ recorded, \S+ replayed", said)
    assert "The recording starts at tick 499 of its run, and what the filters held then is not in it." in said
