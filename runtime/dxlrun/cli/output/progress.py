"""How far a command has come, as a bar on the terminal."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

_REFRESH_S = 0.25


@contextmanager
def progress_bar(*, hidden: bool) -> Iterator[Callable[[str, float], None]]:
    """Give what shows words and the share that is done, on a terminal.

    It has no thread: the bar is drawn when it is called, so a measurement between two calls is undisturbed.
    """
    if hidden or not sys.stderr.isatty():
        yield lambda *_: None
        return
    columns = TextColumn("{task.description}"), BarColumn(), TaskProgressColumn()
    with Progress(*columns, console=Console(stderr=True), auto_refresh=False, transient=True) as progress:
        task = progress.add_task("", total=1.0)
        drawn = 0.0

        def show(words: str, share: float) -> None:
            nonlocal drawn
            if time.monotonic() - drawn > _REFRESH_S:
                drawn = time.monotonic()
                progress.update(task, description=words, completed=share, refresh=True)

        yield show
