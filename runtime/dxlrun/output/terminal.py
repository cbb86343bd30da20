"""Terminal: prints results to stdout and errors to stderr, in colour on a terminal, plain in a pipe.

The layout is computed here, line by line. rich only colours lines on a terminal, and is not loaded for a
pipe.
"""

from __future__ import annotations

import sys
import textwrap
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import IO, TYPE_CHECKING, TypeAlias, cast

from dxlrun.output.escaping import escaped
from dxlrun.output.json import NO_REASON, Report, answer_text
from dxlrun.output.text_table import Part, Sentence, Table, Tone

if TYPE_CHECKING:
    from rich.console import Console

Line: TypeAlias = Sequence[tuple[str, str]]
"""A line of output as pieces of text, each with its style for rich."""
STYLES: dict[Tone, str] = {"plain": "", "good": "green", "warning": "yellow", "error": "red"}
_PIPE = 200
"""Assumed width of a pipe, columns, so that tables are not wrapped."""
_WIDEST = 120
"""Most columns to which text is wrapped, in any terminal or pipe: longer lines are hard to read."""
_FOLDED = 28
"""Smallest width of a table's column with wrapped text, columns."""
_USUAL = 60
"""Width of a terminal, columns, from which every table of dxlrun is printed as a table."""
_SHORTEST_TEXT = 20
_SHORTEST_NAME = 14
"""Smallest widths to which columns of texts and of names are truncated."""
_LONGEST_WORD = 40
"""Longest word, such as a path, that is not broken in a table, characters."""
_LIVE = 77
"""Most columns of a status line: together with the spinner, it fits into a terminal of 80 columns."""
_REFRESH_S = 0.25
_ASCII = str.maketrans({"\N{BOX DRAWINGS LIGHT HORIZONTAL}": "-", "\N{HORIZONTAL ELLIPSIS}": "~"})


def out(pipe: int = _PIPE) -> Console:
    """Return the console for stdout; into a pipe it writes plain text, `pipe` columns wide."""
    return _console(sys.stdout.isatty(), pipe, stderr=False)


def err(pipe: int = _PIPE) -> Console:
    """Return the console for stderr, for progress while stdout is read by a program; otherwise as `out`."""
    return _console(sys.stderr.isatty(), pipe, stderr=True)


def show_parts(*parts: Part, console: Console | None = None, folded: bool = False) -> None:
    """Print lines, tables and graphs to stdout or a console; tables without rows are omitted.

    Lines are wrapped only if `folded`, so that a command in them can be copied.
    """
    console = console or out()
    plain = ascii_only(console)
    for part in parts:
        for line in _lines(part, console, folded=folded):
            _print([(text.translate(_ASCII), style) for text, style in line] if plain else line, console)
    # A reader of a pipe waits for it.
    console.file.flush()


def _lines(part: Part, console: Console, *, folded: bool) -> Iterator[Line]:
    if isinstance(part, Table):
        if part.rows:
            yield from [[("", "")], [(escaped(part.title), "bold")]] if part.title else []
            yield from fitted(part, console.width)
    elif isinstance(part, str | Sentence):
        line = Sentence(part) if isinstance(part, str) else part
        for text in escaped(line.text).split("\n"):
            for piece in textwrap.wrap(text, console.width) or [""] if folded else [text]:
                yield [(piece, STYLES[line.tone])]
    else:
        from dxlrun.output.graph_text import graph_text

        yield from [[("", "")], [(escaped(part.title), "bold")]]
        drawn = escaped(graph_text(part, console.width, ascii_only=ascii_only(console)))
        yield from ([(text, "")] for text in drawn.split("\n"))


def _print(line: Line, console: Console | Pipe) -> None:
    if isinstance(console, Pipe):
        console.print("".join(text for text, _ in line))
        return
    from rich.text import Text

    console.print(Text.assemble(*line), soft_wrap=True)


def ascii_only(console: Console) -> bool:
    """Return True if the console's encoding is not a Unicode one, so that only ASCII is safe."""
    return not (getattr(console.file, "encoding", None) or "utf-8").lower().startswith("utf")


def show_json(
    result: object,
    *,
    code: int = 0,
    errors: Report = (),
    warnings: Report = (),
    reason: Mapping[str, object] = NO_REASON,
) -> None:
    """Print the answer of a command with --json to stdout: one line in a pipe, indented on a terminal.

    Args:
        result: Result of the command; None without one.
        code: Exit code; `ok` is true for 0.
        errors: Problems with places, or sentences `problem; fix`.
        warnings: As `errors`, for problems that do not change the exit code.
        reason: `code` and `fields` of the refusal of a running robot.
    """
    indent = 2 if sys.stdout.isatty() else None
    text = answer_text(result, errors, warnings, reason, ok=code == 0, indent=indent)
    sys.stdout.write(f"{text}\n")
    # A reader of a pipe waits for it.
    sys.stdout.flush()


def print_error(line: str) -> None:
    """Print an error to stderr in one line, so that an editor can jump to its `file:line:column`."""
    _print_to_stderr(line, "bold red")


def print_warning(line: str) -> None:
    """Print a warning to stderr in one line."""
    _print_to_stderr(line, "yellow")


@contextmanager
def progress_bar(*, hidden: bool) -> Iterator[Callable[[str, float], None]]:
    """Context manager that yields a function to draw a progress bar: text, and share from 0 to 1.

    It has no thread: the bar is drawn by the call, so a measurement between two calls is not disturbed.
    """
    if hidden or not sys.stderr.isatty():
        yield lambda *_: None
        return
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

    columns = TextColumn("{task.description}"), BarColumn(), TaskProgressColumn()
    console = _console(terminal=True, pipe=_PIPE, stderr=True)
    with Progress(*columns, console=console, auto_refresh=False, transient=True) as progress:
        task = progress.add_task("", total=1.0)
        drawn = 0.0

        def draw_progress(text: str, share: float) -> None:
            nonlocal drawn
            if time.monotonic() - drawn > _REFRESH_S:
                drawn = time.monotonic()
                progress.update(task, description=escaped(text), completed=share, refresh=True)

        yield draw_progress


def live_line(text: str, more: str) -> str:
    """Return a status line that fits next to a spinner: with `more`, without it, or truncated."""
    if len(text) + len(more) <= _LIVE:
        return text + more
    return text if len(text) <= _LIVE else f"{text[: _LIVE - 1]}…"


def fitted(table: Table, width: int) -> list[Line]:
    """Lay out a table as lines for a terminal of `width` columns.

    A table that is too wide is narrowed in steps: wrap the heads, move columns that are equal in all rows to
    a caption, omit details, wrap texts, truncate texts, truncate names. On a terminal narrower than _USUAL,
    nothing is truncated; each row becomes a paragraph instead.
    """
    table = table.escaped()
    caption, rest = table.without_constants()
    alike = len(rest.columns) == 1 < len(table.columns)
    variants = [("", table)]
    least_table, caption = (table, "") if alike else (rest, caption)
    while True:
        variants.append((caption, least_table))
        if (less := least_table.less()) is None:
            break
        least_table = less
    for said, part in variants:
        for tight in (False, True):
            least = _width(part, tight=tight)
            if least <= width:
                drawn = _drawn(part, min(width, max(least, _WIDEST)), tight=tight)
                return [*_caption(said, width), *drawn]
    if alike and any(column.name for column in table.columns):
        return fitted(table.turned(), width)
    cut = _cut(least_table, width) if width >= _USUAL else None
    if cut is None:
        return [[(line, "")] for line in _paragraphs(table, width)]
    return [*_caption(caption, width), *_drawn(cut, width, tight=True)]


def _caption(said: str, width: int) -> list[Line]:
    return [[(line, "dim")] for line in _filled(f"in all rows: {said}", width)] if said else []


def _cut(table: Table, width: int) -> Table | None:
    """Truncate the widest texts, then the widest names, until a table fits; None if it cannot fit."""
    widths = [
        max(map(len, (*column.name.split(" "), *(row[index].text for row in table.rows))))
        for index, column in enumerate(table.columns)
    ]
    excess = sum(widths) + len(widths) - 1 - width
    for kind, floor in (("text", _SHORTEST_TEXT), ("name", _SHORTEST_NAME)):
        while excess > 0:
            longest = max(
                (index for index, column in enumerate(table.columns) if column.kind == kind),
                key=lambda index: widths[index],
                default=None,
            )
            if longest is None or widths[longest] <= floor:
                break
            widths[longest] -= 1
            excess -= 1
    if excess > 0:
        return None
    columns = tuple(one._replace(kind="name" if one.kind == "text" else one.kind) for one in table.columns)
    rows = (
        tuple(
            cell if len(cell.text) <= most else cell._replace(text=f"{cell.text[: most - 1].rstrip()}…")
            for cell, most in zip(row, widths, strict=True)
        )
        for row in table.rows
    )
    return table._replace(columns=columns, rows=tuple(rows))


def _width(table: Table, *, tight: bool) -> int:
    """Return the smallest width of a table, columns; `tight`: with wrapped heads and narrow gaps."""
    heads = [column.name.split(" ") if tight else [column.name] for column in table.columns]
    widths = (max(*map(len, head), _least(table, index)) for index, head in enumerate(heads))
    return sum(widths) + (len(heads) - 1) * (1 if tight else 2)


def _least(table: Table, index: int) -> int:
    """Return the smallest width of a column's cells; texts may be wrapped between words."""
    texts = [row[index].text for row in table.rows]
    longest = max(map(len, texts))
    if table.columns[index].kind != "text":
        return longest
    word = max((len(word) for text in texts for word in text.split()), default=0)
    return max(min(longest, _FOLDED), min(word, _LONGEST_WORD))


def _drawn(table: Table, width: int, *, tight: bool) -> Iterator[Line]:
    """Yield a table as lines of at most `width` columns, with head and rule; texts are wrapped."""
    names = [column.name.replace(" ", "\n") if tight else column.name for column in table.columns]
    texts = [[name, *(row[index].text for row in table.rows)] for index, name in enumerate(names)]
    widths = [max(len(line) for text in column for line in text.split("\n")) for column in texts]
    foldable = [column.kind == "text" for column in table.columns]
    gap = 1 if tight else 2
    excess = sum(widths) + gap * (len(widths) - 1) - width
    # Narrow the widest text columns together.
    while excess > 0:
        widest = max(each for each, text in zip(widths, foldable, strict=True) if text)
        for index, each in enumerate(widths):
            if excess > 0 and foldable[index] and each == widest:
                widths[index] -= 1
                excess -= 1
    if any(names):
        heads = [name.split("\n") for name in names]
        most = max(map(len, heads))
        bottom = [[*[""] * (most - len(head)), *head] for head in heads]
        yield from _row(bottom, ["dim"] * len(heads), widths, table, gap)
        yield [("\N{BOX DRAWINGS LIGHT HORIZONTAL}" * (sum(widths) + gap * (len(widths) - 1)), "")]
    for row in table.rows:
        cells = [
            _folded(cell.text, each) if text else cell.text.split("\n")
            for cell, each, text in zip(row, widths, foldable, strict=True)
        ]
        yield from _row(cells, [STYLES[cell.tone] for cell in row], widths, table, gap)


def _folded(text: str, width: int) -> list[str]:
    lines = (textwrap.wrap(line, width, break_on_hyphens=False) or [""] for line in text.split("\n"))
    return [piece for line in lines for piece in line]


def _row(
    cells: Sequence[Sequence[str]], styles: Sequence[str], widths: Sequence[int], table: Table, gap: int
) -> Iterator[Line]:
    """Yield the lines of one row; `cells` has the already wrapped lines of each cell."""
    for number in range(max(map(len, cells))):
        pieces = []
        for index, (cell, style, width) in enumerate(zip(cells, styles, widths, strict=True)):
            text = cell[number] if number < len(cell) else ""
            right = table.columns[index].kind == "number"
            pieces += [
                (" " * gap * (index > 0), ""),
                (text.rjust(width) if right else text.ljust(width), style),
            ]
        yield pieces


def _paragraphs(table: Table, width: int) -> Iterator[str]:
    """Yield each row of a table as wrapped text: `joint: bus main, ID 3, ...`."""
    names = [column.name for column in table.columns]
    for first, *rest in table.rows:
        subject = f"{names[0]} {first.text}" if first.text.isdigit() else first.text
        facts = (
            f"{name} {cell.text}".strip() for name, cell in zip(names[1:], rest, strict=True) if cell.text
        )
        yield from _filled(f"{subject}: {', '.join(facts)}", width)


def _filled(text: str, width: int) -> list[str]:
    """Wrap a text between words, with continuation lines indented."""
    return textwrap.wrap(
        text, max(width - 1, 20), subsequent_indent="  ", break_on_hyphens=False, break_long_words=False
    )


def _print_to_stderr(line: str, style: str) -> None:
    # A path or a name may contain line breaks or escape sequences; one problem stays one line.
    safe = escaped(line).replace("\n", "\\n")
    # stderr may be full or closed; the exit code still reports the error.
    with suppress(OSError):
        _print([(safe, style)], err())


def _console(terminal: bool, pipe: int, *, stderr: bool) -> Console:
    if not terminal:
        return cast("Console", Pipe(sys.stderr if stderr else sys.stdout, pipe))
    from rich.console import Console

    return Console(stderr=stderr, highlight=False, force_terminal=True)


class Pipe:
    """Stands in for a rich console in pipes and files: prints plain lines, ignores status."""

    is_terminal = False

    def __init__(self, file: IO[str], width: int) -> None:
        self.file = file
        self.width = width
        self.console = self

    def print(self, text: str = "", **_: object) -> None:
        """Write a line without trailing spaces."""
        self.file.write(f"{text.rstrip(' ')}\n")

    @contextmanager
    def status(self, text: str) -> Iterator[Pipe]:
        """Context manager like a console's status, which shows nothing."""
        yield self

    def update(self, text: str) -> None:
        """Ignore a new status text."""
