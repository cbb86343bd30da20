"""The application: which commands there are, and what becomes of what they raise."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Mapping, Sequence
from importlib import metadata
from types import MappingProxyType

from cyclopts import App, CycloptsError

from dxlrun.cli.analyze import analyze
from dxlrun.cli.bench import bench
from dxlrun.cli.check import check
from dxlrun.cli.doctor import doctor
from dxlrun.cli.examples import examples
from dxlrun.cli.output.terminal import out, print_refusal, say_error, say_warning
from dxlrun.cli.replay import replay
from dxlrun.cli.run import run
from dxlrun.cli.schema import schema
from dxlrun.cli.servos.models import models
from dxlrun.cli.servos.scan import scan
from dxlrun.cli.servos.servo import servo
from dxlrun.cli.simulated.sim import sim
from dxlrun.cli.steering.steer import (
    list_robots,
    load,
    pause,
    rate,
    resume,
    send,
    set_register,
    stop,
    switch,
    unload,
)
from dxlrun.errors import DxlrunError, InputError, Problem, Refused

INTERRUPTED = 130
"""128 + SIGINT, as shells say it."""

_PIPED_HELP = 80
"""Columns."""
RUNNING = "Commands for a robot that runs"

HELP = """Run a robot of Dynamixel servos from one YAML file.

`dxlrun ROBOT.yaml` runs it, `dxlrun check ROBOT.yaml` looks at it without touching hardware,
`dxlrun sim ROBOT.yaml` simulates its servos for other programs,
`dxlrun analyze` says what happened in a run, `dxlrun list` shows the robots that run,
`dxlrun examples` has robots to start with."""

USAGE = """Usage: dxlrun ROBOT.yaml [ARG:=VALUE ...] [OPTIONS]
       dxlrun COMMAND ...
"""

EPILOGUE = """Exit codes: 0 good, 1 the robot or the run failed, 2 the input is wrong, 130 interrupted."""


def build() -> App:
    """Return the application with all its commands."""
    app = App(
        name="dxlrun",
        help=HELP,
        help_epilogue=EPILOGUE,
        usage=USAGE,
        console=None if sys.stdout.isatty() else out(_PIPED_HELP),
        version=lambda: metadata.version("dxlrun"),
        suppress_keyboard_interrupt=False,  # an interrupt is said by us, like everything else
    )
    app.default(run)
    app.command(examples)
    app.command(check)
    app.command(analyze)
    app.command(replay)
    app.command(sim)
    app.command(schema)
    app.command(models)
    app.command(scan)
    app.command(servo)
    app.command(doctor)
    app.command(bench)
    app.command(list_robots, name="list", group=RUNNING)
    app.command(set_register, name="set", group=RUNNING)
    app.register_install_completion_command(
        help="Install tab completion for bash, zsh or fish (--shell), from the next shell on.",
        version_flags=[],
    )
    for verb in (switch, send, rate, pause, resume, load, unload, stop):
        app.command(verb, group=RUNNING)
    return app


def run_tokens(tokens: Sequence[str]) -> int:
    """Run one command line and return its exit code; nothing leaves here as a traceback but with --debug."""
    app = build()
    try:
        if not tokens:
            app.help_print([])
            return InputError.exit_code
        code = app(list(tokens), exit_on_error=False, print_error=False, result_action="return_value")
        sys.stdout.flush()  # a reader that went away is noticed here, not when the interpreter ends
    except KeyboardInterrupt:
        _refuse(tokens, ("interrupted",))
        return INTERRUPTED
    except BrokenPipeError:
        # the reader went away (`dxlrun check ... | head`): nothing is left to say, not even at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except Exception as error:
        if "--debug" in tokens:
            traceback.print_exc()
        if isinstance(error, InputError) and error.problems:
            _refuse(tokens, (), error.problems)
            return error.exit_code
        sentences, code = _explained(error)
        reason = {"code": error.code, "fields": error.fields} if isinstance(error, Refused) else {}
        _refuse(tokens, sentences, reason=reason)
        return code
    return code if isinstance(code, int) else 0


def _refuse(
    tokens: Sequence[str],
    sentences: Sequence[str],
    problems: Sequence[Problem] = (),
    reason: Mapping[str, object] = MappingProxyType({}),
) -> None:
    """Say why a command is not done: in lines for a person, or in JSON for a program that asked for it."""
    if "--json" in tokens:
        print_refusal(problems, sentences, reason)
        return
    for problem in problems:
        (say_error if problem.severity == "error" else say_warning)(str(problem))
    for sentence in sentences:
        say_error(sentence if sentence == "interrupted" else f"dxlrun: {sentence}")


def _explained(error: Exception) -> tuple[tuple[str, ...], int]:
    """Return an error without places in files, in one sentence a problem, and the exit code."""
    if isinstance(error, DxlrunError):
        return tuple(str(error).splitlines()) or (type(error).__name__,), error.exit_code
    if isinstance(error, CycloptsError):
        usage = " ".join(("dxlrun", *(error.command_chain or ()), "--help"))
        what = " ".join(str(error).split()).removesuffix(".")
        return (f"{what}; `{usage}` shows the usage",), InputError.exit_code
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return (f"{where}{error.strerror or error}; --debug shows what was being done",), 1
    what = f"internal error: {type(error).__name__}: {error}; please report it, with what --debug prints"
    return (what,), 1
