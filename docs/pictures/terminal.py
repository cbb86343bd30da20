"""Pictures of a terminal: what a command prints there, as SVG."""

from __future__ import annotations

import fcntl
import io
import os
import pty
import re
import struct
import subprocess
import sys
import termios
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.terminal_theme import DIMMED_MONOKAI
from rich.text import Text

COLUMNS, ROWS = 104, 50

TEMPLATE = """<svg class="rich-terminal" viewBox="0 0 {width} {height}" xmlns="http://www.w3.org/2000/svg">
<style>
.{unique_id}-matrix {{ font-family: "DejaVu Sans Mono", Menlo, Consolas, monospace;
  font-size: {char_height}px; line-height: {line_height}px; font-variant-east-asian: full-width; }}
{styles}
</style>
<defs><clipPath id="{unique_id}-clip-terminal">
<rect x="0" y="0" width="{terminal_width}" height="{terminal_height}" />
</clipPath>
{lines}
</defs>
{chrome}
<g transform="translate({terminal_x}, {terminal_y})" clip-path="url(#{unique_id}-clip-terminal)">
{backgrounds}
<g class="{unique_id}-matrix">
{matrix}
</g></g></svg>
"""
"""The template of rich without its web fonts, so that the picture loads nothing."""


def printed(words: Sequence[str], directory: Path, *, code: int = 0, columns: int = COLUMNS) -> list[str]:
    """Return the lines that `dxlrun WORDS` leaves on a terminal, with their colours; it ends with `code`."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, columns, 0, 0))
    environment = os.environ | {"TERM": "xterm-256color", "COLUMNS": str(columns)}
    command = [sys.executable, "-c", "import sys; from dxlrun.cli import main; sys.exit(main())", *words]
    process = subprocess.Popen(
        command, cwd=directory, env=environment, stdin=theirs, stdout=theirs, stderr=theirs
    )
    os.close(theirs)
    received = b""
    while True:
        try:
            received += os.read(ours, 65536)
        except OSError:  # the last one to have the other end has closed it
            break
    os.close(ours)
    if process.wait() != code:
        last = "\n".join(lines_of(received.decode()))
        raise SystemExit(f"dxlrun {' '.join(words)} ended with {process.returncode}\n{last}")
    return lines_of(received.decode())


def lines_of(received: str) -> list[str]:
    """Return the lines that stay on a terminal: a line that is drawn again shows its last text."""
    lines: list[str] = []
    for line in received.split("\r\n"):
        # A progress line is drawn over itself, and cleared at the end.
        above, _, last = re.sub(r"\r\x1b\[K", "\x1b[2K", line).rpartition("\x1b[2K")
        if "\x1b[1A" in above:
            lines.pop()
        lines.append(re.sub(r"\x1b\[\?25[lh]|\r", "", last))
    return lines[:-1]


def terminal(commands: Sequence[tuple[str, Sequence[str]]], columns: int = COLUMNS) -> str:
    """Return the picture of commands and what they print."""
    console = Console(
        record=True, width=columns, file=io.StringIO(), force_terminal=True, legacy_windows=False
    )
    for command, lines in commands:
        console.print(Text.assemble(("$ ", "bold green"), (command, "bold")))
        for line in lines:
            console.print(Text.from_ansi(line))
        console.print()
    return console.export_svg(
        title="dxlrun", theme=DIMMED_MONOKAI, code_format=TEMPLATE, unique_id="terminal"
    )
