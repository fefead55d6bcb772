"""Offers the engine to notebooks: recordings from arrays or files, twins from a table or any function, and results.

Importing this module loads numpy and nothing larger; the engine is loaded by ``diagnose``, pandas by ``to_dataframe``,
matplotlib by ``plot``.
"""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from tools.errors import InputError
from tools.mismatch.recording import Array, Simulate, TwinText
from tools.mismatch.recording import Recording as Loaded

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

    from tools.mismatch.engine.report import PhysicsFound, Report

Columns = Mapping[str, str] | Iterable[str]
"""Maps signals to the columns that hold them, or lists names that are both."""


@dataclass(frozen=True)
class Twin:
    """Describes a simulation: a ``kind`` of docs/own-data.md with its ``parameters``, or any function.

    ``model`` is the kind, or ``simulate(inputs, parameters, dt)`` with each input (n,) by name, the parameters and the
    time step in s; it returns each output (n,) by name, or one array. A function runs in this process. Numbers in
    ``parameters`` may be fitted, but for those in ``fixed``. ``tables`` are further tables of the kind (of an ``ode``:
    ``states``, ``equations``, ``outputs``, ``units``).
    """

    model: str | Simulate
    parameters: Mapping[str, Any] = field(default_factory=dict[str, Any])
    fixed: Sequence[str] = ()
    tables: Mapping[str, Any] = field(default_factory=dict[str, Any])

    @property
    def kind(self) -> str:
        """Return the kind, or the name of the function."""
        return self.model if isinstance(self.model, str) else getattr(self.model, "__name__", "function")

    def text(self) -> TwinText | None:
        """Return the engine's twin of a function; None for a kind."""
        if isinstance(self.model, str):
            return None
        if self.tables:
            raise InputError("tables belong to a kind of twin, not to a function")
        for name in self.fixed:
            if name not in self.parameters:
                raise InputError(f"fixed parameter '{name}' is not in parameters: {', '.join(self.parameters)}")
        return TwinText(self.kind, dict(self.parameters), simulate=self.model, fixed=tuple(self.fixed))

    def table(self) -> dict[str, Any]:
        """Return the table ``[twin]`` of a kind."""
        fixed = {"fixed": list(self.fixed)} if self.fixed else {}
        return {"kind": self.model, **self.tables, "parameters": dict(self.parameters) | fixed}


@dataclass(frozen=True)
class Recording:
    """Holds a measurement: inputs, outputs and context, arrays (n,) by the twin's names, every ``dt`` seconds.

    ``units`` by signal (``mm``, ``N``, ``deg/s``); a signal without one is taken in the unit of the twin. ``noise_rms``
    of an output, in its unit, where the instrument's noise is known. ``test`` is the range of samples that no fit sees
    (default: the engine chooses).
    """

    inputs: Mapping[str, ArrayLike]
    outputs: Mapping[str, ArrayLike]
    dt: float
    units: Mapping[str, str] = field(default_factory=dict[str, str])
    context: Mapping[str, ArrayLike] = field(default_factory=dict[str, ArrayLike])
    noise_rms: Mapping[str, float] = field(default_factory=dict[str, float])
    test: tuple[int, int] | None = None
    title: str = "recording"
    loaded: Loaded | None = field(default=None, repr=False, compare=False)
    """The recording of a descriptor, with its own twin."""

    def __post_init__(self) -> None:
        sizes: dict[str, int] = {}
        for part in ("inputs", "outputs", "context"):
            arrays: dict[str, Array] = {}
            for signal, values in getattr(self, part).items():
                array = np.asarray(values, np.float64)
                if array.ndim != 1:
                    raise InputError(f"{part} '{signal}' has shape {array.shape}; one dimension is needed")
                if signal in sizes:
                    raise InputError(f"signal '{signal}' is given twice")
                arrays[signal] = array
                sizes[signal] = array.size
            object.__setattr__(self, part, arrays)
        if len(set(sizes.values())) > 1:
            lengths = ", ".join(f"{signal} {n}" for signal, n in sizes.items())
            raise InputError(f"signals differ in length ({lengths})")
        if not (np.isfinite(self.dt) and self.dt > 0):
            raise InputError(f"dt must be a positive number of seconds, not {self.dt}")

    @classmethod
    def load(cls, path: str | Path) -> Recording:
        """Load a recording folder or descriptor with its own twin. Raises ``InputError`` if it is faulty."""
        from tools.mismatch.recording_load import load

        found = load(path)
        return cls(
            found.inputs, found.outputs, found.dt, found.unit, found.context,
            {s: v for s, v in found.noise.items() if v is not None}, None, found.title, found,
        )  # fmt: skip

    @classmethod
    def read(
        cls,
        path: str | Path,
        inputs: Columns,
        outputs: Columns,
        context: Columns = (),
        *,
        time: str | None = None,
        rate_hz: float | None = None,
        units: Mapping[str, str] | None = None,
        noise_rms: Mapping[str, float] | None = None,
    ) -> Recording:
        """Read columns of a data file (csv, npz, mat, mcap, parquet, nc, mf4).

        ``inputs``, ``outputs`` and ``context`` map signals of the twin to columns (``{"force": "force_N"}``), or list
        names that are both. ``time`` is the column of time in s, else ``rate_hz`` is needed. Units that the file has
        itself are used where ``units`` has none. Raises ``InputError``.
        """
        from tools.mismatch.recording_clock import uniform
        from tools.mismatch.recording_columns import column_units, read_columns

        file = Path(path)
        named = {
            part: dict(c) if isinstance(c, Mapping) else {n: n for n in ([c] if isinstance(c, str) else c)}
            for part, c in (("inputs", inputs), ("outputs", outputs), ("context", context))
        }
        at = {signal: column for part in named.values() for signal, column in part.items()}
        columns = read_columns(file, list(dict.fromkeys([*at.values(), *([time] if time else [])])))
        dt, columns = uniform(file, columns, time, rate_hz)
        in_file = column_units(file)
        known = {signal: in_file[column] for signal, column in at.items() if column in in_file}
        parts = {part: {signal: columns[c] for signal, c in of.items()} for part, of in named.items()}
        return cls(
            parts["inputs"], parts["outputs"], dt, {**known, **(units or {})}, parts["context"],
            noise_rms or {}, None, file.stem,
        )  # fmt: skip

    @property
    def signals(self) -> dict[str, Array]:
        """Return all signals, each (n,), inputs first."""
        return {s: np.asarray(x) for part in (self.inputs, self.outputs, self.context) for s, x in part.items()}

    @property
    def n(self) -> int:
        """Return the number of samples."""
        return next(iter(self.signals.values())).size

    @property
    def t(self) -> Array:
        """Return the time (n,), s, from zero."""
        return np.asarray(np.arange(self.n) * self.dt, np.float64)

    def with_twin(self, twin: Twin | None) -> Loaded:
        """Return the recording beside a twin, checked, as the engine takes it. Raises ``InputError``."""
        from tools.mismatch.recording_load import from_table

        if twin is None:
            if self.loaded is None:
                raise InputError("no twin: give one, diagnose(recording, Twin(...))")
            return self.loaded
        channels: list[dict[str, object]] = []
        for role, part in (("input", self.inputs), ("output", self.outputs), ("context", self.context)):
            for signal in part:
                channel: dict[str, object] = {"column": signal, "role": role, "signal": signal}
                if signal in self.units:
                    channel["unit"] = self.units[signal]
                if signal in self.noise_rms:
                    channel["noise_rms"] = self.noise_rms[signal]
                channels.append(channel)
        text: dict[str, Any] = {"format": 1, "title": self.title, "rate_hz": 1.0 / self.dt, "channels": channels}
        as_function = twin.text()
        if as_function is None:
            text["twin"] = twin.table()
        if self.test is not None:
            text["split"] = {"test": list(self.test)}
        return replace(from_table(Path(f"{self.title}.toml"), text, self.signals, as_function), dt=self.dt)

    def plot(self) -> Figure:
        """Draw every signal over time."""
        from tools.mismatch.notebook_plot import plot_signals

        return plot_signals(self.t, self.signals, self.units)

    def to_dataframe(self) -> DataFrame:
        """Return the signals as columns, time in s as the index. ``InputError`` without pandas."""
        return _frame(self.signals, self.t)

    def to_json(self) -> dict[str, Any]:
        """Return the recording as JSON values."""
        return {
            "format": 1,
            "title": self.title,
            "dt": self.dt,
            "units": dict(self.units),
            **{p: {s: np.asarray(x).tolist() for s, x in getattr(self, p).items()} for p in ("inputs", "outputs")},
            "context": {s: np.asarray(x).tolist() for s, x in self.context.items()},
        }

    def _repr_html_(self) -> str:
        rows = [
            (s, role, self.units.get(s, ""), f"{np.min(x):.4g}", f"{np.max(x):.4g}")
            for role, part in (("input", self.inputs), ("output", self.outputs), ("context", self.context))
            for s, x in part.items()
        ]
        head = f"{self.title}: {self.n} samples, {1 / self.dt:.6g} Hz, {self.n * self.dt:.4g} s"
        return _table(head, ("signal", "role", "unit", "least", "greatest"), rows)


@dataclass(frozen=True)
class Diagnosis:
    """Holds the result of ``diagnose``. ``report`` has every figure; the properties give the most used ones."""

    report: Report

    @property
    def verdict(self) -> str:
        """Return the verdict: ``agrees``, ``recalibrate``, ``missing_physics`` or ``unexplained``."""
        return self.report.verdict

    @property
    def summary(self) -> str:
        """Return the answer in words."""
        return self.report.summary

    @property
    def physics(self) -> tuple[PhysicsFound, ...]:
        """Return the effects that the twin lacks, with fitted parameters and 95 % intervals."""
        return self.report.physics

    def plot(self, output: str | None = None) -> Figure:
        """Draw an output as measured, simulated and with physics, and the residuals.

        The default is the output with the largest residual. Raises ``InputError`` for an unknown output.
        """
        from tools.mismatch.notebook_plot import plot_report

        return plot_report(self.report, output)

    def to_dataframe(self) -> DataFrame:
        """Return one row per fitted parameter: effect (``base`` for the twin's own), output, value and interval.

        ``InputError`` without pandas.
        """
        rows = [
            {"effect": p.name, "output": p.output, "stage": p.stage, "parameter": n, "value": v.value, "unit": v.unit,
             "low": v.ci95[0], "high": v.ci95[1], "given": np.nan}
            for p in self.report.physics for n, v in p.parameters.items()
        ] + [
            {"effect": "base", "output": "", "stage": "", "parameter": b.name, "value": b.with_effects, "unit": b.unit,
             "low": b.ci95[0], "high": b.ci95[1], "given": b.given}
            for b in self.report.fit.base_parameters
        ]  # fmt: skip
        names = ("effect", "output", "stage", "parameter", "value", "unit", "low", "high", "given")
        return _frame({name: [row[name] for row in rows] for name in names})

    def series(self) -> DataFrame:
        """Return the courses that were compared: every input by its name, ``OUTPUT.measured``, ``OUTPUT.as_given``,
        ``OUTPUT.recalibrated``, ``OUTPUT.with_physics``, and ``held_out``; time in s is the index.

        ``InputError`` without pandas.
        """
        p = self.report.pictures
        if p is None:
            raise InputError(
                "this report carries no courses, as one that was read from JSON; diagnose the recording again"
            )
        columns: dict[str, Any] = dict(p.signals)
        for output in p.measured:
            kinds = (
                ("measured", p.measured),
                ("as_given", p.as_given),
                ("recalibrated", p.recalibrated),
                ("with_physics", p.fitted),
            )
            columns |= {f"{output}.{name}": of[output] for name, of in kinds}
        return _frame({**columns, "held_out": p.held_out}, p.t)

    def to_json(self) -> dict[str, Any]:
        """Return the JSON that ``micron mismatch diagnose --json`` writes."""
        return self.report.to_json()

    def to_html(self) -> str:
        """Return the page that ``micron mismatch diagnose --html`` writes, with pictures and equations."""
        from tools.mismatch.report.page import html_page

        return html_page(self.report)

    def _repr_html_(self) -> str:
        from tools.mismatch.report.wording import VERDICTS, number, words

        fit = self.report.fit
        rows = [
            (words(p.name), p.output, n, number(v.value), f"{number(v.ci95[0])} to {number(v.ci95[1])}", v.unit)
            for p in self.physics
            for n, v in p.parameters.items()
        ]
        found = _table("", ("physics", "output", "parameter", "value", "95 % interval", "unit"), rows) if rows else ""
        residuals = [
            (o, *(number(of[o]) for of in (fit.base_rms, fit.recalibrated_rms, fit.fitted_rms, fit.noise_floor_rms)), u)
            for o, u in fit.unit.items()
        ]
        headings = ("residual, rms", "as given", "recalibrated", "with physics", "noise floor", "unit")
        head = f"{VERDICTS[self.report.verdict]}: {self.summary}"
        return _table(head, headings, residuals) + found


def diagnose(
    recording: Recording, twin: Twin | None = None, *, held_out: float = 0.3, seed: int = 0, jobs: int = 1,
) -> Diagnosis:  # fmt: skip
    """Find where a twin and a recording differ, which physics the twin lacks, and fit it.

    ``twin`` may be left out where the recording was loaded from a descriptor that has one. ``held_out`` is the share of
    the record that no fit sees, ``jobs`` the number of processes. Raises ``InputError`` for a bad recording or twin.
    """
    if not 0.1 <= held_out <= 0.6:
        raise InputError(f"held_out must be a share between 0.1 and 0.6, not {held_out}")
    from tools.mismatch.infer import diagnose as run

    return Diagnosis(run(recording.with_twin(twin), held_out=held_out, seed=seed, jobs=jobs))


def _frame(columns: Mapping[str, Any], t: Array | None = None) -> DataFrame:
    from tools.formats.packages import need

    (pandas,) = need("to_dataframe", "notebook", "pandas")
    return pandas.DataFrame(dict(columns), index=None if t is None else pandas.Index(t, name="t_s"))


def _table(head: str, headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table as HTML; every text is escaped."""

    def row(cells: Sequence[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(c)}</{tag}>" for c in cells) + "</tr>"

    above = f"<p>{html.escape(head)}</p>" if head else ""
    body = "".join(row(cells, "td") for cells in rows)
    return f"<div>{above}<table><thead>{row(headings, 'th')}</thead><tbody>{body}</tbody></table></div>"
