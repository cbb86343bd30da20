"""Inputs: parts that the commands share: options, reading of words and files, compiling a robot file."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dxlrun.cli import verb_registry
from dxlrun.errors import DxlrunError, InputError, missing_extra, suggestion
from dxlrun.output.target import check_target, write_target

if TYPE_CHECKING:
    from cyclopts import Token

    from dxlrun.compile.robot_compiler import Ask, CompiledRobot
    from dxlwire.bus_plan import BusPlan
    from dxlwire.packets import PacketSink

Flag = Annotated[bool, Parameter(negative=(), show_default=False)]
"""Type of an option without a value, such as `--json`; it has no `--no-` form."""
JsonOfItsOwn = Annotated[Flag, Parameter(name="--json")]
JsonFlag = Annotated[JsonOfItsOwn, Parameter(help="Print the result as JSON.")]
"""Option `--json`; commands that describe it in their docstring use `JsonOfItsOwn`."""
DebugFlag = Annotated[Flag, Parameter(help="Print the traceback of an error.")]
"""Option `--debug` of all commands."""


def _switch(name: str) -> Parameter:
    """Return the declaration of an option `--name` / `--no-name`; the help shows the default form."""
    return Parameter(
        name=f"--{name}",
        negative=f"--no-{name}",
        show_default=lambda on: f"--{name}" if on else f"--no-{name}",
    )


WaitFlag = Annotated[bool, _switch("wait")]
RecordFlag = Annotated[bool, _switch("record")]
StressFlag = Annotated[bool, _switch("stress")]
GatewayFlag = Annotated[bool, _switch("gateway")]
PageFlag = Annotated[bool, _switch("page")]
GraphFile = Annotated[
    tuple[Path, ...] | None, Parameter(negative=(), show_default=False, consume_multiple=(0, 1))
]
"""Option `--graph`; without a file it is an empty tuple, and None when it is not given."""
RobotPath = Annotated[Path, Parameter(help="Robot file.")]
RobotName = Annotated[str | None, Parameter(help="Name of the robot, if several run.")]
Motions = Annotated[tuple[str, ...], Parameter(negative=(), show_default=False, name="--play")]
"""Motion files, or names of motions; the option can be given several times."""
Without = Annotated[
    tuple[str, ...],
    Parameter(
        negative=(),
        show_default=False,
        help="Joint or group to omit, as if its servos were not installed. Can be given several times.",
    ),
]
"""Option `--without` of commands that compile a robot file for a run."""
AssignmentOfItsOwn = Annotated[str, Parameter(name="arg:=value")]
Assignment = Annotated[
    AssignmentOfItsOwn, Parameter(help="Arguments of the robot file, for example port:=/dev/ttyUSB0.")
]
"""An argument of the robot file on the command line, `name:=value`."""


def _of(quantity: str) -> Parameter:
    """Return an option's parser for a quantity of `description.units`; a number without unit is SI."""

    def parse_token(_: object, tokens: Sequence[Token]) -> float:
        # Imported here because help and completion need no pydantic.
        from dxlrun.description import units

        try:
            value: float = getattr(units, quantity)(tokens[0].value)
        except ValueError as error:
            # For pydantic's own subclass, the parser shows another part.
            raise ValueError(str(error)) from None
        return value

    return Parameter(converter=parse_token)


Seconds = Annotated[float, _of("seconds")]
"""A time on the command line, s: `3`, `3s` or `500ms`."""
Hertz = Annotated[float, _of("rate")]
"""A rate on the command line, Hz: `50`, `50Hz` or `1kHz`."""

REPORT_MARK = '<script type="application/json" id="report">'
"""Text that is in each report of `output.html`; an existing file without it is not overwritten."""
SHORTEST_S, LONGEST_S = 1e-6, 1e9
"""Limits of `--duration`, s; 31 years still fit into the log's nanoseconds."""


def compiled(
    robot: Path,
    assignments: Sequence[str],
    play: Sequence[Path | str],
    duration: float | None,
    ask: Ask | None = None,
    *,
    without: Sequence[str] = (),
) -> CompiledRobot:
    """Read and compile a robot file with arguments and motion files; `duration` is that of the run, s.

    `ask`: function that reads the models of joints with `model: auto` from their servos. `without`: joints
    and groups that are omitted. Raises InputError with all mistakes of files and command line.
    """
    known_file(robot)
    arguments = parse_assignments(assignments)
    duration_ns = None
    if duration is not None:
        # Also refuses NaN.
        if not SHORTEST_S <= duration <= LONGEST_S:
            raise InputError(
                f"--duration {duration:g} is not a valid duration; "
                f"give a number of seconds from {SHORTEST_S:g} to {LONGEST_S:g}"
            )
        duration_ns = round(duration * 1e9)
    # Imported here because a wrong argument needs neither numpy nor pydantic.
    from dxlrun.compile.robot_compiler import compile_files

    return compile_files(robot, arguments, play, duration_ns, ask, without=without)


def read_models(
    buses: Sequence[BusPlan], joints: Sequence[str], packets: Mapping[str, PacketSink] | None = None
) -> Mapping[str, str]:
    """Return joint -> model as read from the servos, for joints with `model: auto`; `packets` logs each bus.

    The module is imported here because most robots have no such joints.
    """
    from dxlrun.dynamixel.tools import inspection

    return inspection.read_models(buses, joints, packets or {})


def parse_assignments(assignments: Sequence[str]) -> dict[str, str]:
    """Return the robot file's arguments by name from words `name:=value`; raises InputError for any other
    word.
    """
    arguments: dict[str, str] = {}
    if len(assignments) == 3 and assignments[1] in ("=", ":=", ":"):
        # The argument was written with spaces; the sign is checked below.
        assignments = ["".join(assignments)]
    for word in assignments:
        name, sign, value = word.partition(":=")
        if not sign or not name:
            raise InputError(f"{word!r} is not an argument of the robot file; write {_assignment_for(word)}")
        if name in arguments:
            raise InputError(f"argument {name} is given twice; give it once")
        arguments[name] = value
    return arguments


def _assignment_for(word: str) -> str:
    """Return a suggestion for a word that is not `name:=value`: that form, or `--play` for a YAML file."""
    if word.endswith((".yaml", ".yml")):
        return f"--play {word.removeprefix('play=').removeprefix('play:')}"
    if word == "sim" or re.match(r"/dev/|COM\d+$", word):
        return f"port:={word}"
    match = re.fullmatch(r"([A-Za-z_]\w*)\s*[=:]\s*(.*)", word, re.DOTALL)
    return f"{match[1]}:={match[2] or 'VALUE'}" if match else "name:=value"


def parse_size(option: str, text: str) -> int:
    """Return a size such as `10GB` in bytes; raises InputError that names the option."""
    # Imported here for the same reason as in `_of`.
    from dxlrun.description.units import size

    try:
        return size(text)
    except ValueError as error:
        raise InputError(f"{option} {text}: {error}") from None


def parse_pair(word: str, example: str) -> tuple[str, str]:
    """Return key and value of a word `key=value`; raises InputError, with `example`, for any other word."""
    key, sign, value = (part.strip() for part in word.partition("="))
    if not sign or not value or not all(part.isidentifier() for part in key.split(".")):
        raise InputError(f"{word!r} is not key=value; write for example {example}")
    return key, value


def pose_text(positions: Mapping[str, str]) -> str:
    """Return positions by joint as one line, as `send` and `frames --at` read them: `elbow=20.0deg
    jaw=5.00mm`.
    """
    return " ".join(f"{name}={position.replace(' ', '')}" for name, position in positions.items())


@contextmanager
def terminated_as_interrupted() -> Iterator[None]:
    """Handle SIGTERM like Ctrl-C in the block, so that the results of a measurement are kept and shown."""
    # Imported here because few commands measure.
    import signal

    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def check_report(target: Path, library: str = "matplotlib") -> None:
    """Raise InputError, before a measurement begins, when its HTML report could not be written.

    `library`: Python library that draws the plots and must be installed.
    """
    if target.suffix.lower() not in {".html", ".htm"}:
        raise InputError(f"{target} is not a name for a report; end it in .html")
    check_target(target, REPORT_MARK)
    if missing := missing_extra("a report", "report", library):
        raise InputError(missing)


def write_report(target: Path, page: str) -> None:
    """Write a report as an HTML file; only an older report is overwritten. Raises InputError on failure."""
    write_target(target, page, REPORT_MARK)


def known_file(robot: Path) -> None:
    """Raise InputError with a suggestion when a word is not an existing robot file."""
    if robot.exists() and not robot.is_dir():
        return  # what is not a regular file is refused when it is read
    word = str(robot)
    if robot.is_dir():
        raise InputError(f"{word} is a directory; give the robot file in it")
    if robot.suffix in (".yaml", ".yml") or len(robot.parts) > 1:
        raise InputError(f"robot file {word} not found; {_other_file(robot)}")
    verb_registry.require_package(word)
    if (named := robot.with_suffix(".yaml")).is_file():
        raise InputError(f"file {word} not found; write `{named}`")
    if is_example(robot.name):
        raise InputError(f"file {word} not found; copy the example of this name by `dxlrun examples {word}`")
    otherwise = "run a robot by `dxlrun ROBOT.yaml`, list the commands by `dxlrun help`"
    hint = suggestion(word, verb_registry.names(), otherwise)
    raise InputError(f"{word!r} is neither a command nor a robot file; {hint}")


def _other_file(robot: Path) -> str:
    """Return a suggestion for the name of a missing robot file, from the files in its directory."""
    beside = [path.name for path in robot.parent.glob("*.y*ml")] if robot.parent.is_dir() else []
    copies = f"copy the example of this name by `dxlrun examples {robot.stem}`"
    return suggestion(robot.name, beside, copies if is_example(robot.stem) else "check the path")


def examples_directory() -> Path:
    """Return the directory of the example robots, in the installed package or in an editable clone.

    Raises DxlrunError when it is missing.
    """
    package = Path(__file__).parents[1]
    for place in (package / "examples", package.parents[1] / "robots"):
        if place.is_dir():
            return place
    raise DxlrunError("this installation of dxlrun has no examples; reinstall it")


def is_example(name: str) -> bool:
    """Return True when dxlrun has an example robot of this name."""
    return (examples_directory() / f"{name}.yaml").is_file()
