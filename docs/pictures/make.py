"""The pictures of the README, made anew from a run: `python docs/pictures/make.py`.

The torso runs in real time on simulated servos, by the README's first command. `terminal.svg` is what that
command and `dxlrun analyze` print on a terminal; `report.svg` is the head of the page that `--report` writes,
with some of its figures. Needs the extra `report`. `--into DIRECTORY` writes them elsewhere; other options
are for the run (on virtual time the page has no figure of the wake-up latency, and so the picture has none).
"""

from __future__ import annotations

import argparse
import fcntl
import html
import io
import os
import pty
import re
import struct
import subprocess
import sys
import tempfile
import termios
from pathlib import Path

from rich.console import Console
from rich.terminal_theme import DIMMED_MONOKAI
from rich.text import Text

ROOT = Path(__file__).parents[2]
RUN = ("robots/bioloid_torso.yaml", "--play", "robots/motions/three_parts.yaml")
COLUMNS, ROWS = 104, 50
LEFT_OUT = re.compile("(\x1b\\[[0-9;]*m)*(Controllers|Servos)\\b")
"""The terminal's picture ends above these tables of `dxlrun analyze`."""
FIGURES = ("latency-histogram", "budget-typical", "joint-7")
"""Figures of the page, by their names in it; joint-7 is head_yaw_joint."""
WIDTH, MARGIN = 720, 36
"""Of the report's picture, px."""

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


def report(page: str) -> str:
    """Return a picture of a page of `--report`: its head, and FIGURES one below the other."""
    head = page[: page.index("</header>")]
    name, when = between(head, "h1")[0], between(head, "p")[0]
    verdict, *sentences = between(head, "h2") + between(head, "p")[1:]
    parts, y = [], 52.0
    parts.append(text(MARGIN, y, name, "font-size: 26px; font-weight: 700"))
    parts.append(text(MARGIN, y + 24, when, "font-size: 13px; fill: var(--muted)"))
    y += 44
    height = 42 + 21 * len(sentences)
    inner = WIDTH - 2 * MARGIN
    parts.append(f'<rect x="{MARGIN}" y="{y}" width="{inner}" height="{height}" fill="var(--panel)"/>')
    parts.append(f'<rect x="{MARGIN}" y="{y}" width="5" height="{height}" fill="var(--good)"/>')
    parts.append(text(MARGIN + 18, y + 26, verdict, "font-size: 16px; font-weight: 700; fill: var(--good)"))
    for number, sentence in enumerate(sentences):
        parts.append(text(MARGIN + 18, y + 49 + 21 * number, sentence, "font-size: 13.5px"))
    y += height + 30
    keys = list(zip(between(head, "dt"), between(head, "dd"), strict=True))
    for number, (key, value) in enumerate(keys):
        x = MARGIN + inner * number / len(keys)
        parts.append(text(x, y, key, "font-size: 10px; fill: var(--muted)"))
        parts.append(text(x, y + 20, value, "font-size: 14px; font-weight: 600"))
    y += 38
    for figure in FIGURES:
        found = re.search(rf'<svg [^>]*aria-labelledby="{figure}-title.*?</svg>', page, re.DOTALL)
        if found is None:
            continue
        drawing = found[0]
        (title,) = between(drawing, "title")
        (box,) = re.findall(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', drawing)
        scaled = inner * float(box[1]) / float(box[0])
        parts.append(text(MARGIN, y + 22, title, "font-size: 15px; font-weight: 600"))
        drawing = re.sub(r"(?<=[ML\d] )(\d+\.\d\d)\d+", r"\1", drawing)
        parts.append(
            re.sub("^<svg ", f'<svg x="{MARGIN}" y="{y + 30}" width="{inner}" height="{scaled}" ', drawing)
        )
        y += scaled + 42
    colours = between(page, "style")[0]
    colours = colours[: colours.index("* {")]
    style = (
        f"{colours} text {{ font-family: 'DejaVu Sans', Verdana, sans-serif; fill: var(--ink) }}"
        " svg svg * { stroke-linejoin: round; stroke-linecap: butt }"
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {y:.0f}"><style>{style}</style>'
        f'<rect width="{WIDTH}" height="{y:.0f}" rx="8" fill="var(--paper)"/>{"".join(parts)}</svg>\n'
    )


def text(x: float, y: float, words: str, style: str) -> str:
    """Return a line of text; `words` are as they stand in the page."""
    escaped = html.escape(html.unescape(words), quote=False)
    return f'<text x="{x:.1f}" y="{y:.1f}" style="{style}">{escaped}</text>'


def between(page: str, tag: str) -> list[str]:
    """Return what stands in each element of a tag."""
    return re.findall(rf"<{tag}(?: [^>]*)?>(.*?)</{tag}>", page, re.DOTALL)


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
        page = (directory / "report.html").read_text()
    end = next(number for number, line in enumerate(analyzed) if LEFT_OUT.match(line))
    commands = [(f"dxlrun {' '.join((*RUN, *more))}", ran), ("dxlrun analyze", [*analyzed[:end], "..."])]
    for picture, drawn in (("terminal.svg", terminal(commands)), ("report.svg", report(page))):
        (options.into / picture).write_text(drawn)


if __name__ == "__main__":
    main()
