"""Faults: mistakes that were written by hand into the product, to see which test finds each.

    python tests/faults/faults.py                       # the table: found, not found, not tried, gone
    python tests/faults/faults.py --try control.txt     # try those without a result, and write the result

A fault is a block of `tests/faults/*.txt`: the file and what would go wrong, lines to replace, lines to put
in their place, and the result:

    runtime/dxlrun/control/goals.py: a goal that is reached in its last cycle counts as missed
    -     if error <= tolerance:
    +     if error < tolerance:
    found by: tests/control/test_goals.py::test_goal_within_tolerance_is_reached

The lines to replace occur once in the file; a fault whose lines are gone cannot be tried any more. The fault
is applied to this checkout, which must be clean and installed with `pip install -e`, and is taken back at the
end. Its tests are the short ones that execute it, or those of its room (tests/faults/trials.py).
"""

import argparse
import signal
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
FOLDER = Path(__file__).parent


class Fault(NamedTuple):
    """A block of a file."""

    path: str
    effect: str
    old: str
    new: str
    result: str

    def text(self) -> str:
        lines = [f"{self.path}: {self.effect}"]
        lines += [f"- {line}" for line in self.old.splitlines()]
        lines += [f"+ {line}" for line in self.new.splitlines()]
        return "\n".join([*lines, *([self.result] if self.result else [])])


def parsed(text: str) -> Iterator[Fault]:
    for block in filter(None, map(str.strip, text.split("\n\n"))):
        head, *lines = block.splitlines()
        path, _, effect = head.partition(": ")
        old = "\n".join(line[2:] for line in lines if line.startswith("-"))
        new = "\n".join(line[2:] for line in lines if line.startswith("+"))
        result = "".join(line for line in lines if line.startswith(("found by: ", "not found")))
        yield Fault(path, effect, old, new, result)


def problems(fault: Fault) -> Iterator[str]:
    """Yield why a fault cannot be tried."""
    path = ROOT / fault.path
    if not path.is_file():
        yield f"{fault.path} is not a file"
    elif (count := path.read_text("utf-8").count(f"{fault.old}\n")) != 1:
        yield f"{fault.path}: the lines of {fault.effect!r} occur {count} times"
    if fault.old == fault.new:
        yield f"{fault.path}: {fault.effect!r} changes nothing"


def texts_of(fault: Fault) -> tuple[str, str]:
    """Return the file of a fault, without and with it."""
    right = (ROOT / fault.path).read_text("utf-8")
    return right, right.replace(f"{fault.old}\n", f"{fault.new}\n" if fault.new else "", 1)


@contextmanager
def applied(fault: Fault) -> Iterator[None]:
    """Apply a fault to this checkout, and take it back at the end."""
    path = ROOT / fault.path
    right, wrong = texts_of(fault)
    path.write_text(wrong, "utf-8")
    try:
        yield
    finally:
        path.write_text(right, "utf-8")


def main() -> None:
    """Print the table, or try what has no result yet."""
    sys.path[0] = str(ROOT)  # as a program, its own folder is the first
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--try", dest="files", nargs="+", default=(), metavar="FILE", help="files to try")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # takes the fault back, as Ctrl-C does
    for name in options.files:
        from tests.faults.trials import tried

        path = FOLDER / name
        faults = [*parsed(path.read_text("utf-8"))]
        for result in tried([one for one in faults if not one.result and not [*problems(one)]]):
            faults = [result if one == result._replace(result="") else one for one in faults]
            print(f"{result.path}: {result.effect}: {result.result}", flush=True)
            path.write_text("\n\n".join(one.text() for one in faults) + "\n", "utf-8")
    for path in sorted(FOLDER.glob("*.txt")):
        tally = Counter(
            one.result.partition(":")[0] or "not tried" for one in parsed(path.read_text("utf-8"))
        )
        print(f"{path.name}: " + ", ".join(f"{count} {result}" for result, count in sorted(tally.items())))


if __name__ == "__main__":
    main()
