"""Progress bars on a terminal; nothing if the output goes elsewhere."""

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text


class ProgressBars:
    """Bars that advance by lines, rows or scans."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress

    def start(self, description: str, total: int) -> TaskID:
        """Add a bar."""
        return self._progress.add_task(description, total=total)

    def advance(self, bar: TaskID, amount: float = 1) -> None:
        """Move a bar on."""
        self._progress.advance(bar, amount)


class RateColumn(ProgressColumn):
    """Lines, rows or scans per second."""

    def render(self, task: Task) -> Text:
        """The rate over the last half minute; nothing until it is known."""
        return Text(f"{task.speed:,.0f}/s" if task.speed else "")


@contextmanager
def progress_bars() -> Iterator[ProgressBars]:
    """Show progress bars on standard error while the block runs."""
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        RateColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        yield ProgressBars(progress)
