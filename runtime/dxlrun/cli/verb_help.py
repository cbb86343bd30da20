"""`dxlrun help VERB`: the help of one command, with examples."""

from __future__ import annotations

from pathlib import Path

from dxlrun.cli.app import build
from dxlrun.cli.help import print_help
from dxlrun.cli.inputs import known_file
from dxlrun.cli.verb_registry import examples_of
from dxlrun.errors import InputError
from dxlrun.output.terminal import show_parts


def show_help(*verb: str) -> int:
    """Show the help of a command with examples: `dxlrun help check`.

    Parameters
    ----------
    verb
        Name of the command. Default: list all commands.
    """
    if not verb:
        print_help()
        return 0
    app = build(verb[0])
    chain, _, unknown = app.parse_commands(list(verb))
    if not chain:
        known_file(Path(verb[0]))
    if unknown or not chain:
        raise InputError(f"there is no command {' '.join(verb)}; `dxlrun help` lists all of them")
    app.help_print(list(verb))
    examples = examples_of(verb)
    show_parts(*["", "Examples", *examples] if examples else ())
    return 0
