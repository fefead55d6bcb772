"""An edit that a kernel can see changes its cache's name; any other edit does not."""

from __future__ import annotations

from pathlib import Path

from hal.compiled import ROOT, AnyClone, cache_folder, imported_sources, kernel, source_fingerprint


def tree(root: Path, inner: str = "X = 1\n", other: str = "Y = 1\n") -> Path:
    (root / "hal").mkdir(parents=True)
    (root / "firmware_py" / "room").mkdir(parents=True)
    (root / "hal" / "inner.py").write_text(inner)
    (root / "hal" / "other.py").write_text(other)
    (root / "firmware_py" / "room" / "__init__.py").write_text("from hal.inner import X\n")
    (root / "firmware_py" / "middle.py").write_text("import numpy\nfrom firmware_py import room\n")
    top = root / "firmware_py" / "top.py"
    top.write_text("from firmware_py.middle import room\n")
    return top


def test_what_is_reached_through_two_imports_counts(tmp_path: Path):
    before = source_fingerprint(tree(tmp_path / "a"), tmp_path / "a")
    assert source_fingerprint(tree(tmp_path / "b"), tmp_path / "b") == before
    assert source_fingerprint(tree(tmp_path / "c", inner="X = 2\n"), tmp_path / "c") != before
    assert source_fingerprint(tree(tmp_path / "d", other="Y = 2\n"), tmp_path / "d") == before


def test_only_our_own_packages_are_followed(tmp_path: Path):
    top = tree(tmp_path)
    assert imported_sources(top, tmp_path) == {tmp_path / "firmware_py" / "middle.py"}


def test_what_is_imported_only_for_types_or_within_a_function_is_not_followed(tmp_path: Path):
    top = tree(tmp_path)
    top.write_text(
        "from typing import TYPE_CHECKING\n"
        "try:\n    from hal.inner import X\nexcept ImportError:\n    X = 0\n"
        "if TYPE_CHECKING:\n    from hal.other import Y\n"
        "else:\n    import firmware_py.room\n"
        "def later():\n    from firmware_py import middle\n"
    )
    room = tmp_path / "firmware_py" / "room" / "__init__.py"
    assert imported_sources(top, tmp_path) == {tmp_path / "hal" / "inner.py", room}


def test_division_by_zero_is_a_number_and_not_an_exception():
    @kernel
    def ratio(a: float, b: float) -> float:
        return a / b

    assert ratio(1.0, 0.0) == float("inf")


def test_the_cache_has_no_clone_in_its_path_and_numbas_own_settings_are_left_alone():
    from numba.core import config

    theirs = config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES

    @kernel
    def twice(a: float) -> float:
        return 2.0 * a

    assert theirs == (config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES)
    here = Path(__file__).resolve()
    assert Path(twice._cache.cache_path) == cache_folder(here) / "tests.unit.hal"
    assert AnyClone.get_suitable_cache_subpath(str(ROOT / "firmware_py" / "frame.py")) == "firmware_py"
