"""The lines of a robot file's buses, opened for this process alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager

from dxlrun.description.bus import SIMULATED
from dxlrun.dynamixel.tools.tool_line import ToolLine, TunablePort
from dxlrun.errors import InputError, suggestion
from dxlrun.output.terminal import print_error

Opened = Callable[[str], TunablePort]
"""Opens a port by its path."""


@contextmanager
def opened_lines(ports: Mapping[str, str], opened: Opened = TunablePort) -> Iterator[dict[str, ToolLine]]:
    """Open the port of each bus; raises PortError, InputError for simulated ones: they have no port."""
    for bus, port in ports.items():
        if port == SIMULATED:
            raise InputError(
                f"bus {bus} is simulated, and has no port where servos could be: give one, such as "
                "port:=/dev/ttyUSB0; `dxlrun sim ROBOT.yaml --link /tmp/line` has simulated ones at /tmp/line"
            )
    with ExitStack() as stack:
        yield {bus: ToolLine(stack.enter_context(opened(port))) for bus, port in ports.items()}


def chosen_names(
    words: Sequence[str], known: Sequence[str], groups: Mapping[str, Sequence[str]]
) -> list[str]:
    """Return the names that are meant by words, groups among them; all without a word. Raises InputError."""
    wrong = [word for word in words if word not in known and word not in groups]
    if wrong:
        every = (*known, *groups)
        raise InputError(
            "\n".join(f"the robot file has no joint {word}; {suggestion(word, every)}" for word in wrong)
        )
    meant = {name for word in words for name in groups.get(word, (word,))}
    return [name for name in known if name in meant or not words]


@contextmanager
def ending_with(sentence: Callable[[], str]) -> Iterator[None]:
    """Print how things are left when what is inside ends early, by Ctrl-C or an error; empty: nothing."""
    try:
        yield
    except BaseException:
        if left := sentence():
            print_error(left)
        raise
