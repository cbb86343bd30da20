"""`dxlrun --help`: a text that is read, as making it would import every command; a test keeps it true."""

from __future__ import annotations

import sys
import textwrap
from importlib.metadata import entry_points
from pathlib import Path

TEXT = Path(__file__).with_name("help.txt")
_COLUMNS = 80


def print_help() -> None:
    """Print the help; verbs of packages that did not come with dxlrun stand at its end."""
    sys.stdout.write(TEXT.read_text("utf-8"))
    foreign = {one.name for one in entry_points(group="dxlrun") if one.dist and one.dist.name != "dxlrun"}
    if foreign:  # only then is the code of packages imported
        from dxlrun.cli.verbs import package_of, packaged

        added = [command for command in packaged().values() if not package_of(command.name)]
        for group in dict.fromkeys(command.group for command in added):
            rows = [(command.name, command.help) for command in added if command.group == group]
            sys.stdout.write(f"\n{group} of other packages\n" + "".join(map(_row, rows)))


def _row(row: tuple[str, str]) -> str:
    name, about = row
    return textwrap.fill(about, _COLUMNS, initial_indent=f"{name:<22}", subsequent_indent=" " * 22) + "\n"
