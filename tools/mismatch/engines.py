"""The one way to a diagnosis: every caller asks here, and here alone is said which engine answers."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

from tools.errors import InputError

if TYPE_CHECKING:
    from tools.mismatch.engine.report import Report
    from tools.mismatch.recording import Recording

Engine = Literal["old", "new"]
DEFAULT: Engine = "old"


def diagnose(
    recording: Recording, *, held_out: float = 0.3, seed: int = 0, jobs: int = 1,
    progress: Callable[[str, int, int], None] | None = None, engine: str | None = None,
) -> Report:  # fmt: skip
    """Diagnose a recording with an engine, which is loaded now. Raises ``InputError`` where there is no such engine."""
    if check_engine(engine) == "new":
        from tools.mismatch.infer import diagnose as run
    else:
        from tools.mismatch.engine.diagnose import diagnose as run
    return run(recording, held_out=held_out, seed=seed, jobs=jobs, progress=progress)


def check_engine(engine: str | None) -> Engine:
    """The engine of this name, the default one for None. Raises ``InputError`` where there is no such engine."""
    if engine is None:
        return DEFAULT
    if engine == "old" or engine == "new":
        return engine
    raise InputError(f"--engine {engine}: there is no such engine; use old or new")
