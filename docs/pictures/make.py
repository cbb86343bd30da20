"""The pictures of the README, made anew from a run: `python docs/pictures/make.py`.

The torso runs in real time on simulated servos, by the README's first command. `terminal.svg` is what that
command and `dxlrun analyze` print on a terminal; `report.png` is the page that `--report` writes, its head
and some of its plots, as Chromium shows it; without Chromium that picture is left out. Needs the extra
`report`. `--into DIRECTORY` writes them elsewhere; other options are for the run.
"""

from __future__ import annotations

import argparse
import fcntl
import io
import os
import pty
import re
import shutil
import struct
import subprocess
import sys
import tempfile
import termios
from pathlib import Path

from PIL import Image, ImageChops  # comes with bokeh
from rich.console import Console
from rich.terminal_theme import DIMMED_MONOKAI
from rich.text import Text

ROOT = Path(__file__).parents[2]
RUN = ("robots/bioloid_torso.yaml", "--play", "robots/motions/three_parts.yaml")
COLUMNS, ROWS = 104, 50
LEFT_OUT = re.compile("(\x1b\\[[0-9;]*m)*(Controllers|Servos)\\b")
"""The terminal's picture ends above these tables of `dxlrun analyze`."""
FIGURES = ("lateness", "steps", "joint-7")
"""Plots of the page, by their names in it; joint-7 is head_yaw_joint."""
WIDTH, HEIGHT = 1040, 2000
"""Of the report's picture, px."""
COLOURS = 48
"""Of the report's picture, so that it is small."""

TERMINAL = """<svg class="rich-terminal" viewBox="0 0 {width} {height}" xmlns="http://www.w3.org/2000/svg">
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


def printed(words: tuple[str, ...], directory: Path) -> list[str]:
    """Return the lines that `dxlrun WORDS` leaves on a terminal, with their colours."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, COLUMNS, 0, 0))
    environment = os.environ | {"TERM": "xterm-256color", "COLUMNS": str(COLUMNS)}
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
    if process.wait():
        raise SystemExit(f"dxlrun {' '.join(words)} ended with {process.returncode}\n{received.decode()}")
    lines: list[str] = []
    for line in received.decode().split("\r\n"):
        # a progress line is drawn over itself, and at last cleared
        above, _, last = line.rpartition("\x1b[2K")
        if "\x1b[1A" in above:
            lines.pop()
        lines.append(re.sub(r"\x1b\[\?25[lh]|\r", "", last))
    return lines[:-1]


def terminal(commands: list[tuple[str, list[str]]]) -> str:
    """Return the picture of commands and what they print."""
    console = Console(
        record=True, width=COLUMNS, file=io.StringIO(), force_terminal=True, legacy_windows=False
    )
    for command, lines in commands:
        console.print(Text.assemble(("$ ", "bold green"), (command, "bold")))
        for line in lines:
            console.print(Text.from_ansi(line))
        console.print()
    return console.export_svg(
        title="dxlrun", theme=DIMMED_MONOKAI, code_format=TERMINAL, unique_id="terminal"
    )


def report(page: str, directory: Path, target: Path) -> None:
    """Take a picture of a page of `--report`: its head, and FIGURES one below the other."""
    chromium = shutil.which("chromium")
    if chromium is None:
        return
    shown = ", ".join(f"#{name}" for name in FIGURES)
    hidden = ".table, nav, #worst, #machine, #buses, #steering, #events, main p:not(.legend), footer"
    style = f"<style>figure:not({shown}), {hidden} {{ display: none }}</style>"
    shortened = directory / "shown.html"
    shortened.write_text(page.replace("</head>", f"{style}</head>"))
    taken = directory / "taken.png"
    words = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--hide-scrollbars",
        "--virtual-time-budget=30000",
    ]
    words += [f"--window-size={WIDTH},{HEIGHT}", f"--screenshot={taken}", shortened.as_uri()]
    subprocess.run([chromium, *words], check=True, capture_output=True, timeout=100)
    with Image.open(taken) as picture:
        opaque = picture.convert("RGB")
        below = ImageChops.difference(opaque, Image.new("RGB", opaque.size, "white")).getbbox()
        cut = opaque.crop((0, 0, WIDTH, min(HEIGHT, below[3] + 30) if below else HEIGHT))
        cut.quantize(COLOURS).save(target, optimize=True)


def main() -> None:
    """Run the torso, analyze its log, draw both pictures."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--into", type=Path, default=Path(__file__).parent)
    options, more = parser.parse_known_args()
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name)
        (directory / "robots").symlink_to(ROOT / "robots")
        ran = printed((*RUN, *more), directory)
        analyzed = printed(("analyze", "--report", "report.html"), directory)
        report((directory / "report.html").read_text(), directory, options.into / "report.png")
    end = next(number for number, line in enumerate(analyzed) if LEFT_OUT.match(line))
    commands = [(f"dxlrun {' '.join((*RUN, *more))}", ran), ("dxlrun analyze", [*analyzed[:end], "..."])]
    (options.into / "terminal.svg").write_text(terminal(commands))


if __name__ == "__main__":
    main()
