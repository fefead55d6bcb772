"""Entry points of other packages: found by name; a broken or ambiguous one is an error that names it."""

from __future__ import annotations

from pathlib import Path

import pytest

from hal.errors import BenchError
from hal.plugins import load


def install(folder: Path, package: str, entry: str) -> None:
    info = folder / f"{package}-1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1\n")
    (info / "entry_points.txt").write_text(f"[micron.test]\n{entry}\n")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


def test_a_name_is_loaded(folder: Path):
    install(folder, "one", "here = math:pi")
    assert load("micron.test", "here", float) == pytest.approx(3.14159, abs=1e-5)
    assert load("micron.test", "elsewhere", float) is None


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ("x = no_such_module_at_all:x", "'x' of micron.test cannot be loaded from no_such_module_at_all:x"),
        ("x = math:tau_e", "cannot be loaded from math:tau_e"),
        ("x = math:pi", "math:pi is a float, not a str"),
    ],
)
def test_a_broken_package_is_named(folder: Path, entry: str, message: str):
    install(folder, "one", entry)
    with pytest.raises(BenchError, match=message):
        load("micron.test", "x", str)


def test_one_name_from_two_packages_is_refused(folder: Path):
    install(folder, "one", "x = math:pi\ny = math:tau")
    install(folder, "two", "x = math:e")
    message = r"'x' of micron\.test is offered twice, by (one|two) \(.*\) and (one|two) \(.*\): uninstall one"
    with pytest.raises(BenchError, match=message):
        load("micron.test", "x", float)
    assert load("micron.test", "y", float) == pytest.approx(6.28319, abs=1e-5), "only the doubled name is refused"
