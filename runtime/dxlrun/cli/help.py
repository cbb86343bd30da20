"""Help: prints the stored text of `dxlrun --help`, because making it would import every command.

A test compares the stored text with the commands.
"""

from __future__ import annotations

import re
import sys
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

from dxlrun.installed_plugins import distribution_name, installed_plugins

if TYPE_CHECKING:
    from dxlrun.contract.hookspecs import Command

TEXT = Path(__file__).with_name("help.txt")
_COLUMNS = 80
_EVERY_DAY = "Every day"
_MORE = "`dxlrun --help` lists all commands, `dxlrun help COMMAND` shows one with examples."
_BEHIND = "Arguments"
"""First heading of the help after the groups of commands."""


def print_help() -> None:
    """Print the stored help, with the commands of other installed packages added."""
    text = TEXT.read_text("utf-8")
    publishers = {distribution_name(each.publisher) for each in installed_plugins()}
    # Only then import the code of packages.
    if publishers - {"dxlrun"}:
        from dxlrun.cli.verb_registry import packaged

        for command in packaged().values():
            if not re.search(rf"^{command.name} ", text, re.MULTILINE):
                text = _with_verb(text, command)
    sys.stdout.write(text)


def print_short_help() -> None:
    """Print the usage and the commands of the group `Every day`."""
    parts = TEXT.read_text("utf-8").split("\n\n")
    (commands,) = (part for part in parts if part.startswith(f"{_EVERY_DAY}\n"))
    lines = [line for line in commands.splitlines() if not line.startswith("help ")]
    sys.stdout.write("\n".join([parts[0], "", *lines, "", _MORE]) + "\n")


def _with_verb(text: str, command: Command) -> str:
    """Return the help text with a package's command added, at the end of its group or in a new group."""
    parts = text.split("\n\n")
    headings = [part.partition("\n")[0] for part in parts]
    if command.group not in headings:
        headings.insert(headings.index(_BEHIND), command.group)
        parts.insert(headings.index(command.group), command.group)
    place = headings.index(command.group)
    first = re.search(r"\n(\S+ +)", parts[place])
    width = max(len(first[1]) if first else 0, len(command.name) + 2)
    about = in_list(command.help or command.place)
    about = textwrap.indent(textwrap.fill(about, _COLUMNS - width), " " * width)
    parts[place] += f"\n{command.name.ljust(width)}{about[width:]}"
    return "\n\n".join(parts)


def in_list(about: str) -> str:
    """Return the entry of a command in a list: its summary up to the first colon or semicolon."""
    return " ".join(re.split("[:;]", about)[0].split()).removesuffix(".") + "."


def version() -> str:
    """Return the version of dxlrun, followed by whether its compiled parts can be used."""
    from importlib import metadata  # not above: only --version needs it

    from dxlrun.channels.c_sources import missing

    why = missing()
    return f"{metadata.version('dxlrun')}, {f'but {why}' if why else 'with its compiled parts'}"
