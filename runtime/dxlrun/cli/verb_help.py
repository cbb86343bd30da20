"""`dxlrun help VERB`: the help of one command, with the examples of its docstring."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

from dxlrun.cli.app import build
from dxlrun.cli.help import print_help
from dxlrun.cli.inputs import known_file
from dxlrun.errors import InputError
from dxlrun.output.terminal import show

_EXAMPLES = re.compile(r"^Examples\n-+\n(.*?)(?:\n\n|\Z)", re.MULTILINE | re.DOTALL)


def show_help(*verb: str) -> int:
    """Show the help of a command with examples: `dxlrun help check`.

    Parameters
    ----------
    verb
        The command; without it, all commands.

    Examples
    --------
    dxlrun help
    dxlrun help check
    dxlrun help bench rate
    """
    if not verb:
        print_help()
        return 0
    app = build(verb[0])
    chain, apps, unknown = app.parse_commands(list(verb))
    if not chain:
        known_file(Path(verb[0]))
    if unknown or not chain:
        raise InputError(f"there is no command {' '.join(verb)}; `dxlrun help` lists all of them")
    app.help_print(list(verb))
    commands = (apps[-1], *apps[-1].resolved_commands().values())
    examples = [line for one in commands for line in examples_of(one.default_command)]
    show(*["", "Examples", *examples] if examples else ())
    return 0


def examples_of(command: object) -> list[str]:
    """Return the command lines below `Examples` in the docstring of a command."""
    found = _EXAMPLES.search(inspect.getdoc(command) or "")
    return found[1].splitlines() if found else []
