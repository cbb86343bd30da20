"""Inputs of `dxlrun sim`: parse servos, faults and options of the adapter."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from msgspec.structs import replace

from dxlrun.description.document import read_file
from dxlrun.errors import InputError, Mark, Problem, what_and_fix

if TYPE_CHECKING:
    from dxlsim.faults.fault import Fault
    from dxlsim.simulation_plan import BusConfig

Split = Literal["whole", "byte", "random"]
Absent = Literal["silent", "slot"]


class InputMistakes:
    """Collector of the InputErrors of independent options, which are reported together."""

    def __init__(self) -> None:
        self._errors: list[InputError] = []

    @contextmanager
    def collected(self) -> Iterator[None]:
        """Catch the InputError of a block and store it for `raise_errors`."""
        try:
            yield
        except InputError as error:
            self._errors.append(error)

    def raise_errors(self) -> None:
        """Raise the stored errors as one InputError; return when there are none."""
        if len(self._errors) == 1:
            raise self._errors[0]
        if self._errors:
            raise InputError("\n".join(str(error) for error in self._errors))


def servo_bus(words: Sequence[str], baud_rate: int | None, protocol: float | None) -> BusConfig:
    """Return a bus with the servos of `--servo MODEL:IDS` words, whose models may be from plug-ins.

    Raises InputError.
    """
    from dxlrun.control.controllers.plugin_loading import load_plugins
    from dxlsim.texts.servo_words import bus_of_servos

    load_plugins()
    return bus_of_servos(words, baud_rate, protocol)


def read_latency(text: str | None) -> int | None:
    """Return the time of `--latency-timer` in ns, None without it; raises InputError for an invalid one."""
    from dxlrun.description.units import duration

    try:
        return None if text is None else duration(text)
    except ValueError as error:
        raise InputError(f"--latency-timer {text!r}: {error}") from None


def with_adapter(bus: BusConfig, given: Mapping[str, object], absent: Absent | None, seed: int) -> BusConfig:
    """Return a bus with the options of its adapter replaced by those that are given (not None), and with
    the seed.
    """
    keys = {name: value for name, value in given.items() if value is not None}
    absent = absent or bus.adapter.absent
    return replace(bus, adapter=replace(bus.adapter, seed=seed, absent=absent, **keys))


def read_faults(lines: Sequence[str], file: Path | None) -> tuple[Fault, ...]:
    """Return the faults of `--fault` and of the file of `--faults`; raises InputError with all wrong lines.

    In a file, empty lines and comments after # are ignored.
    """
    from dxlsim.faults.fault import parse_fault

    faults: list[Fault] = []
    wrong: list[str] = []
    for line in lines:
        try:
            faults.append(parse_fault(line))
        except InputError as error:
            wrong.append(f"--fault {line!r}: {error}")
    placed, problems = ([], []) if file is None else _faults_of(file)
    if problems and not wrong:
        # Problems with places, for an editor.
        raise InputError(problems)
    if wrong:
        raise InputError("\n".join([*wrong, *map(str, problems)]))
    return (*faults, *placed)


def _faults_of(file: Path) -> tuple[list[Fault], list[Problem]]:
    from dxlsim.faults.fault import parse_fault

    try:
        text = read_file(file).decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not text"
        raise InputError(f"the faults in {file} cannot be read ({reason}); give a text file") from None
    faults: list[Fault] = []
    problems: list[Problem] = []
    for number, whole in enumerate(text.splitlines(), start=1):
        line = whole.partition("#")[0].strip()
        if not line:
            continue
        try:
            faults.append(parse_fault(line))
        except InputError as error:
            column = 1 + len(whole) - len(whole.lstrip())
            problems.append(Problem(Mark(str(file), number, column), *what_and_fix(error)))
    return faults, problems
