"""Consoles that print what they are given: brackets in a message are text, never markup.

Rich reads ``[running]`` or ``[firmware]`` as a style and leaves it out. Style is given by ``rich.text.Text`` or
``style=`` instead, so that no message has to be escaped. Some parts of rich read markup whatever the console was told
(spinners, titles of panels, columns of a progress display): they are made here, or get constants or ``Text``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console, RenderableType
from rich.progress import Progress, ProgressColumn, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.status import Status
from rich.table import Column, Table
from rich.text import Text


class PlainStatus(Status):
    """Shows a spinner with a text that may change."""

    def update(self, status: RenderableType | None = None, **options: Any) -> None:
        """Show ``status``; ``options`` as for ``rich.status.Status.update``."""
        super().update(_plain(status), **options)


class PlainConsole(Console):
    """See ``plain_console``."""

    def status(self, status: RenderableType, **options: Any) -> PlainStatus:
        """Return a spinner beside ``status``, as ``rich.console.Console.status`` does."""
        return PlainStatus(_plain(status) or "", console=self, **options)


def plain_console(**options: Any) -> Console:
    """Return a console without markup, emoji codes and highlighting; ``options`` as for ``rich.console.Console``."""
    return PlainConsole(markup=False, emoji=False, highlight=False, **options)


def table_of(title: str | None, *headings: str, left: int = 1, no_wrap: bool = False, **options: Any) -> Table:
    """Return a table whose first ``left`` columns are text and whose others are numbers, to the right.

    Text that is too long for its column is folded. ``options`` as for ``rich.table.Table``.
    """
    columns = (
        Column(heading, justify="left" if i < left else "right", overflow="fold", no_wrap=no_wrap)
        for i, heading in enumerate(headings)
    )
    return Table(*columns, title=title, title_justify="left", **options)


def pairs_of(rows: Iterable[tuple[str, str | Text]]) -> Table:
    """Return names, dim, beside what belongs to each; text that is too long is folded."""
    grid = Table.grid(Column(style="dim", no_wrap=True), Column(overflow="fold"), padding=(0, 2, 0, 0))
    for name, value in rows:
        grid.add_row(name, Text(value) if isinstance(value, str) else value)
    return grid


def progress_bar(console: Console, *columns: ProgressColumn) -> Progress:
    """Return a progress display that leaves nothing behind. In a file or pipe it prints nothing.

    Rich's own prints an empty line there at its end.
    """
    return Progress(*columns, console=console, transient=True, disable=not console.is_interactive)


def task_name() -> TextColumn:
    """Return the column of a progress display that names the task, as plain text."""
    return TextColumn("{task.description}", markup=False)


@contextmanager
def spinner(console: Console) -> Iterator[Callable[[str], None]]:
    """Show that work goes on, and since when; the function that it yields shows what is being done."""
    with progress_bar(console, SpinnerColumn(), task_name(), TimeElapsedColumn()) as progress:
        task = progress.add_task("starting")
        yield lambda text: progress.update(task, description=text)


def _plain(text: RenderableType | None) -> RenderableType | None:
    return Text(text) if isinstance(text, str) else text
