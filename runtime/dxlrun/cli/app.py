"""App: the command-line application with its commands, and the messages for their errors."""

from __future__ import annotations

import os
import re
import shlex
import sys
import traceback
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal

from cyclopts import (
    App,
    CoercionError,
    CycloptsError,
    Group,
    MissingArgumentError,
    UnknownOptionError,
    UnusedCliTokensError,
)

from dxlrun.cli import verb_registry
from dxlrun.cli.run import run
from dxlrun.errors import DxlrunError, InputError, Problem, Refused, near
from dxlrun.output.terminal import out, print_error, print_warning, show_json, show_parts
from dxlrun.output.text_table import Table

if TYPE_CHECKING:
    from cyclopts.help import HelpEntry, HelpPanel
    from rich.console import Console, ConsoleOptions

INTERRUPTED = 130
"""Exit code after Ctrl-C: 128 + SIGINT, as in shells."""

_PIPED_HELP = 80
"""Width of the help, columns, when it is not printed to a terminal."""
_BEHIND = 100
"""Sort key of the groups that come after the groups of commands in the help."""
_PARAMETERS = Group("Parameters", sort_key=_BEHIND + 1)
HELP = """Run a robot of Dynamixel servos from one YAML file.

`dxlrun ROBOT.yaml` runs the robot. `dxlrun check ROBOT.yaml` checks the file without touching hardware.
`dxlrun examples` lists robots to start with. `dxlrun help COMMAND` shows a command with examples."""

USAGE = """Usage: dxlrun ROBOT.yaml [ARG:=VALUE ...] [OPTIONS]
       dxlrun COMMAND ...
"""

EPILOGUE = """Exit codes: 0 success, 1 failure of the robot or the run, 2 invalid input, 130
interrupted."""


def build(verb: str = "", *, listed: bool = False) -> App:
    """Return the application, with only those commands that a line beginning with `verb` needs.

    `listed`: import all commands, for a list of them.
    """
    app = App(
        name="dxlrun",
        help=HELP,
        help_epilogue=EPILOGUE,
        # rich.markdown takes as long to import as everything else together.
        help_format="plaintext",
        help_formatter=_Help(),
        usage=USAGE,
        version=_version,
        # `run_tokens` reports an interrupt.
        suppress_keyboard_interrupt=False,
        group_arguments=Group("Arguments", sort_key=_BEHIND),
        group_parameters=_PARAMETERS,
    )
    app.default(run)
    found = {
        name: (place, group)
        for group, places in verb_registry.GROUPS.items()
        for name, place in places.items()
    }
    if verb in found and not listed:
        # Each other command costs time in every step of the parser.
        found = {verb: found[verb]}
    if listed or (verb_registry.is_verb(verb) and verb not in found):
        for added in verb_registry.packaged().values():
            if not listed or verb_registry.is_importable(added):
                found[added.name] = added.place, added.group
    headings = {group: Group(group, sort_key=order) for order, group in enumerate(verb_registry.GROUPS)}
    first = [*verb_registry.GROUPS[verb_registry.EVERY_DAY], *found]
    for name, (place, group) in found.items():
        heading = headings.setdefault(group, Group(group, sort_key=len(headings)))
        # The commands of every day have a fixed order; all others are alphabetical.
        order = first.index(name) if group == verb_registry.EVERY_DAY else 0
        app.command(place, name=name, group=heading, sort_key=order)
    if listed:
        # Imported here because only a list of all commands needs it.
        from dxlrun.cli.help import in_list

        for command in app.resolved_commands().values():
            # Formatting the rest takes time.
            command.help = in_list(command.help.partition("\n\n")[0])
    app.command(install_completion, name="--install-completion", version_flags=[])
    for flag in ("--help", "--version", "--install-completion"):
        app[flag].group = _PARAMETERS
    return app


def install_completion(*, shell: Literal["bash", "zsh", "fish"] | None = None) -> None:
    """Install tab completion for bash, zsh or fish (--shell). New shells use it.

    Parameters
    ----------
    shell
        Shell to install completion for. Default: the shell that runs this command.
    """
    # Imported here because the import takes long.
    from cyclopts.completion.install import create_install_completion_command

    create_install_completion_command(build(listed=True).install_completion, add_to_startup=True)(shell=shell)


class _Help:
    """Formatter that prints help with the same tables as results."""

    def __call__(self, console: Console, options: ConsoleOptions, panel: HelpPanel) -> None:
        """Print the commands or the options of one group as a table."""
        facts = ((" ".join(entry.display_labels_with_metavar), _about(entry)) for entry in panel.entries)
        show_parts(Table.facts(str(panel.title), facts), console=out(_PIPED_HELP))

    def render_usage(self, console: Console, options: ConsoleOptions, usage: object) -> None:
        """Print the usage line of a command."""
        show_parts(str(usage) if str(usage).startswith("Usage") else f"Usage: {usage}")

    def render_description(self, console: Console, options: ConsoleOptions, description: object) -> None:
        """Print the description of a command, folded to the width."""
        show_parts(_filled(description), console=out(_PIPED_HELP), folded=True)


def _about(entry: HelpEntry) -> str:
    choices = f"One of {', '.join(entry.choices)}." if entry.choices else ""
    default = f"Default: {entry.default}." if entry.default not in (None, '""') else ""
    return " ".join(filter(None, (_filled(entry.description), choices, default)))


def _filled(text: object) -> str:
    """Return a docstring's text with each paragraph joined to one line."""
    plain = str(getattr(text, "primary_renderable", text) or "").strip()
    return re.sub(r"(?<!\n)\n(?!\n)", " ", plain)


def _version() -> str:
    # Imported here because only --version needs it.
    from dxlrun.cli.help import version

    return version()


def run_tokens(tokens: Sequence[str]) -> int:
    """Run one command line, print its errors (a traceback only with --debug), and return the exit code."""
    app = build(tokens[0] if tokens else "")
    try:
        _refuse_other_words(tokens)
        code = app(list(tokens), exit_on_error=False, print_error=False, result_action="return_value")
        # Notice a closed reader here, not at the interpreter's exit.
        sys.stdout.flush()
    except KeyboardInterrupt:
        _refuse(tokens, ("interrupted",))
        return INTERRUPTED
    except BrokenPipeError:
        # The reader has closed the pipe (`dxlrun check ... | head`): print nothing more, not even at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except Exception as error:
        if "--debug" in tokens:
            traceback.print_exc()
        if isinstance(error, InputError) and error.problems:
            _refuse(tokens, (), error.problems)
            return error.exit_code
        sentences, code = _explained(error, tokens)
        reason = {"code": error.code, "fields": dict(error.fields)} if isinstance(error, Refused) else {}
        _refuse(tokens, sentences, reason=reason)
        return code
    return code if isinstance(code, int) else 0


def _refuse(
    tokens: Sequence[str],
    sentences: Sequence[str],
    problems: Sequence[Problem] = (),
    reason: Mapping[str, object] = MappingProxyType({}),
) -> None:
    """Print why a command failed: as lines on stderr, or as JSON with --json.

    `problems` have places in files, `sentences` have none; `reason` is the code of a robot's refusal.
    """
    if "--json" in tokens:
        errors = [one for one in problems if one.severity == "error"]
        warnings = [one for one in problems if one.severity == "warning"]
        # The reader is gone; the exit code still reports the error.
        with suppress(OSError):
            show_json(None, code=1, errors=[*errors, *sentences], warnings=warnings, reason=reason)
        return
    for problem in problems:
        (print_error if problem.severity == "error" else print_warning)(str(problem))
    for sentence in sentences:
        print_error(sentence if sentence == "interrupted" else f"dxlrun: {sentence}")


def _refuse_other_words(tokens: Sequence[str]) -> None:
    """Raise InputError, with the right command line, when the first word is a command of another program.

    The command of an absent package is refused here, because its options are not known.
    """
    word = tokens[0] if tokens else ""
    if Path(word).exists():
        return
    verb_registry.require_package(word)
    verb = verb_registry.verb_for(word)
    if verb is None or word in verb_registry.names():
        return
    given = [*verb.split(), *_without_output(tokens[1:])]
    line = shlex.join(("dxlrun", *given)) if given else "dxlrun ROBOT.yaml"
    raise InputError(f"'{word}' is not a command; write `{line}`")


def _without_output(tokens: Sequence[str]) -> list[str]:
    """Return the words of a command line without --json and --debug."""
    return [token for token in tokens if token not in ("--json", "--debug")]


_OF_ROBOT = ("robot", "file", "config", "f")
"""Names that other programs give to their option for the robot file, which is positional here."""
_SIMULATED = ("sim", "simulate", "simulated", "simulation")
"""Names that other programs give to their option for simulated servos."""
_TIMES = {"in", "for", "time", "duration", "seconds"}
"""Names that verbs of dxlrun, and other programs, give to an option for a time."""
_FIRST = {"torque": "on|off", "servo": "/.*"}
"""Verb -> pattern of its first word, which people write last, too: the state, or the port."""


def _right_form(error: CycloptsError, tokens: Sequence[str]) -> str:
    """Return the command line that was probably meant, with the given values; empty when it is not known."""
    verb = list(error.command_chain or ())
    given = _without_output(tokens[len(verb) :])
    if isinstance(error, UnknownOptionError):
        return _without_options(error, verb, given)
    if {"=", ":="} & set(given) and verb:
        return shlex.join(("dxlrun", *verb, *(word for word in given if word not in ("=", ":="))))
    is_apart = verb == ["rate"] and len(given) == 2 and given[1].isalpha()  # `rate 50 Hz`
    if isinstance(error, UnusedCliTokensError) and (verb == ["switch"] or is_apart):
        words = ["".join(given)] if is_apart else ["--activate", *given]
        return shlex.join(("dxlrun", *verb, *words))
    place = error.argument
    if isinstance(error, MissingArgumentError) and verb and place and place.field_info.is_positional:
        # `set base gain=400`, `set base.gain 400`: two words were joined to one.
        for sign in (".",) if verb == ["send"] else (":=", "=", "."):
            words = [part for word in given for part in _parts(word, sign)]
            if len(words) == len(given) + 1 and all(words):
                return shlex.join(("dxlrun", *verb, *words))
    return _in_order(verb, given) if isinstance(error, CoercionError) else ""


def _in_order(verb: Sequence[str], given: Sequence[str]) -> str:
    """Return the command line with the word that `_FIRST` describes as the first one; empty without one."""
    form = _FIRST.get(" ".join(verb))
    early = next((word for word in given[1:] if form and re.fullmatch(form, word)), "")
    return shlex.join(("dxlrun", *verb, early, *(word for word in given if word != early))) if early else ""


def _parts(word: str, sign: str) -> list[str]:
    whole = word.startswith("-") or word.endswith((".yaml", ".yml"))
    return [word] if whole else word.split(sign, 1)


def _without_options(error: UnknownOptionError, verb: Sequence[str], given: Sequence[str]) -> str:
    """Return a command line whose unknown options became positional values or `name:=value`.

    Empty when the place of one is not known.
    """
    known = error.argument_collection
    places = {place.name.lower() for place in known if place.field_info.is_positional}
    options = {name for each in known for name in each.names}
    first: list[str] = []
    words: list[str] = []
    last: list[str] = []
    rest = [*given]
    while rest:
        option, sign, value = rest.pop(0).partition("=")
        name = option.lstrip("-")
        if option == name or option in options:
            words.append(f"{option}{sign}{value}")
            continue
        if not sign and rest and rest[0][:1] != "-":
            value = rest.pop(0)
        if value and name in _OF_ROBOT:
            first.append(value)
        elif value and name in places:
            words.append(value)
        elif value and name in _declared((*words, *rest)):
            last.append(f"{name}:={value}")
        elif not value and name in _SIMULATED and "port" in _declared((*words, *rest)):
            last.append("port:=sim")
        else:
            return ""
    return shlex.join(("dxlrun", *verb, *first, *words, *last))


def _declared(words: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the arguments that the robot file among the words declares; empty without one."""
    # Imported here because only a wrong command line needs it.
    from dxlrun.description.including import read_sources

    robot = next((word for word in words if word.endswith((".yaml", ".yml"))), None)
    if robot is None:
        return ()
    try:
        blocks = [source.declared.data.get("arguments") for source in read_sources(Path(robot))]
    except InputError:
        return ()
    return tuple(name for block in blocks if isinstance(block, dict) for name in block)


def _usage_error(error: CycloptsError, tokens: Sequence[str]) -> str:
    """Return a message for a wrong command line, with the corrected line or a hint to the usage."""
    usage = " ".join(("dxlrun", *(error.command_chain or ()), "--help"))
    what, fix = " ".join(str(error).split()).removesuffix("."), f"`{usage}` shows the usage"
    if isinstance(error, UnknownOptionError):
        option = (error.token.keyword or error.token.value).partition("=")[0]
        what = f"Unknown option: {option}"
        names = {name.lstrip("-"): name for each in error.argument_collection for name in each.names}
        long = [name for name in names if names[name].startswith("--")]
        letter = option.lstrip("-") if len(option.lstrip("-")) == 1 else ""
        short = [name for name in long if letter and name.startswith(letter)]
        verb = " ".join(error.command_chain or ())
        if new := verb_registry.RENAMED.get(verb, {}).get(option):
            return f"{option} is {new} now; {fix}"
        timed = [name for name in long if {name, option.lstrip("-")} <= _TIMES]
        if meant := near(option.lstrip("-"), long) or timed or short:
            fix = f"did you mean {' or '.join(f'--{name}' for name in meant)}?"
    if isinstance(error, UnusedCliTokensError):
        what = f"unexpected {' '.join(map(repr, error.unused_tokens or ()))}"
    what = re.sub(r'unable to convert "(.*)" into int$', r"\1 is not a whole number", what)
    # With a keyword the option is there, but not its value.
    if isinstance(error, MissingArgumentError) and error.argument is not None and error.keyword is None:
        name = error.argument.name
        chain = error.command_chain or ()
        what = f"`{' '.join(('dxlrun', *chain))}` lacks {name if name[:1] == '-' else name.upper()}"
        if examples := verb_registry.examples_of(chain):
            fix = f"write for example `{examples[0]}`"
    if line := _right_form(error, tokens):
        fix = f"write `{line}`"
    return f"{what}; {fix}"


def _explained(error: Exception, tokens: Sequence[str]) -> tuple[tuple[str, ...], int]:
    """Return an exception's messages, one per problem, and the exit code for it."""
    verb = tokens[0] if tokens else ""
    if isinstance(error, DxlrunError):
        return tuple(str(error).splitlines()) or (type(error).__name__,), error.exit_code
    if isinstance(error, CycloptsError):
        return (_usage_error(error, tokens),), InputError.exit_code
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return (f"{where}{error.strerror or error}; run with --debug for details",), 1
    what = " ".join(f"{type(error).__name__}: {error}".split())
    if sys.platform != "linux" and isinstance(error, ImportError | AttributeError):
        return (f"`dxlrun {verb}` needs Linux, and this is {sys.platform}: {what}",), InputError.exit_code
    if verb in verb_registry.packaged() and not verb_registry.package_of(verb):
        place = verb_registry.packaged()[verb].place
        return (
            f"command {verb} ({place}) failed: {what}; reinstall its package, or report it to its author",
        ), 1
    return (f"internal error: {what}; please report it with the output of --debug",), 1
