"""Nothing dead: what the product defines, the rooms, the benchmarks or the examples of plug-ins use (vulture).

What tests alone use counts as dead.
"""

from __future__ import annotations

from pathlib import Path

from vulture import Vulture

ROOT = Path(__file__).parents[3]
READ = ("hal", "drivers", "firmware_py", "sim_devices", "tools", "benches", "benchmarks", "examples", "tests/examples")
NOT_JUDGED = ("benchmarks", "tests", "tools/research")
KINDS = ("function", "class", "method", "property")
# a framework finds these by a decorator
DECORATORS = [
    "*command*", "*callback*", "*validator*", "*serializer*", "@overload*", "@pytest.fixture*", "*setter",
    "@typeof_impl*", "@lower_constant*",
]  # fmt: skip
CALLED = [
    # by a framework: numba, IPython, matplotlib, pyserial, click
    "AnyClone", "get_suitable_cache_subpath", "get_call_signatures", "on_start", "_repr_*", "reset_input_buffer",
    "parse_args", "__setitem__",
    # by name: the list of commands, and the module that export writes
    "doctor", "emulate", "simulate_command", "curved", "legendre", "loop_with_speed",
    # by users: notebooks, tests of other projects, writers of drivers and twins
    "open_run", "to_dataframe", "to_html", "smbus", "write_quick", "read_byte*", "write_byte*", "read_word_data",
    "write_word_data", "UserTwin",
]  # fmt: skip


def find_dead(folder: Path, read: tuple[str, ...]) -> list[str]:
    """Return functions, classes and methods below ``folder`` that no file below the folders ``read`` names."""
    vulture = Vulture(ignore_names=CALLED, ignore_decorators=DECORATORS)
    vulture.scavenge([str(folder / name) for name in read])
    unused = [item for item in vulture.get_unused_code() if item.typ in KINDS]
    return [f"{item.filename.relative_to(folder)}:{item.first_lineno}: {item.name}" for item in unused]


def test_it_sees_what_is_dead(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text("@app.command()\ndef a(): ...\nclass B:\n    def c(self): ...\ndef d(): B()\n")
    assert find_dead(tmp_path, ("a.py",)) == ["a.py:4: c", "a.py:5: d"]


def test_nothing_is_dead() -> None:
    assert [found for found in find_dead(ROOT, READ) if not found.startswith(NOT_JUDGED)] == []
