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
end. The short tests of its room run, those first that name its module; with `--deep` then the whole suite.
What takes longer than the limit has not found the fault: a test that nobody waits for finds nothing.
"""

from __future__ import annotations

import argparse
import re
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))  # as a program, its own folder is the first

from tests.kit import selection  # noqa: E402  in the repository, not in the folder of this program

FOLDER = Path(__file__).parent
LIMIT_S = 240.0


class Fault(NamedTuple):
    """A block of a file."""

    path: str
    effect: str
    old: str
    new: str
    result: str

    def text(self) -> str:
        """Return the block."""
        lines = [f"{self.path}: {self.effect}"]
        lines += [f"- {line}" for line in self.old.splitlines()]
        lines += [f"+ {line}" for line in self.new.splitlines()]
        return "\n".join([*lines, *([self.result] if self.result else [])])


def parsed(text: str) -> Iterator[Fault]:
    """Yield the faults of a text."""
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


def tests_of(path: str) -> list[str]:
    """Return the short test files of the room of a product file, those first that name its module."""
    module = selection.module_of(path)
    long = {name for name, _ in selection.long_files()}
    folders = selection.tests_of(selection.room_of(module))
    files = [file for folder in folders for file in sorted((ROOT / "tests" / folder).rglob("test_*.py"))]
    parent, _, name = module.rpartition(".")
    names = re.compile(rf"\b({re.escape(module)}|from {re.escape(parent)} import .*\b{re.escape(name)})\b")
    files.sort(key=lambda file: names.search(file.read_text("utf-8")) is None)
    return [path for file in files if (path := str(file.relative_to(ROOT))) not in long]


def run_tests(words: Sequence[str]) -> str:
    """Return the first test that fails; empty if none does within the limit."""
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-x",
        "-n",
        "0",
        "-p",
        "no:cacheprovider",
        "--timeout=120",
    ]
    with subprocess.Popen(
        [*command, *words], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as ran:
        try:
            output, _ = ran.communicate(timeout=LIMIT_S)
        except subprocess.TimeoutExpired:
            ran.send_signal(signal.SIGINT)  # lets the tests end what they started
            ran.communicate()
            return ""
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", output, re.MULTILINE)
    return failed[1] if failed else "" if ran.returncode == 0 else "tests end with an error"


def build() -> None:
    """Compile the C sources again."""
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "-e", "."]
    subprocess.run(command, cwd=ROOT, check=True)


def tried(fault: Fault, *, deep: bool) -> Fault:
    """Apply a fault, run the tests, and take it back."""
    path = ROOT / fault.path
    before = path.read_text("utf-8")
    path.write_text(before.replace(f"{fault.old}\n", f"{fault.new}\n" if fault.new else "", 1), "utf-8")
    try:
        if path.suffix == ".c":
            build()
        found = run_tests(tests_of(fault.path)) or (run_tests(()) if deep else "")
    finally:
        path.write_text(before, "utf-8")
        if path.suffix == ".c":
            build()
    return fault._replace(result=f"found by: {found}" if found else "not found")


def main() -> None:
    """Print the table, or try what has no result yet."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--try", dest="files", nargs="+", default=(), metavar="FILE", help="files to try")
    parser.add_argument(
        "--deep", action="store_true", help="run all short tests where those of the room pass"
    )
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # takes the fault back, as Ctrl-C does
    for name in options.files:
        path = FOLDER / name
        faults = [*parsed(path.read_text("utf-8"))]
        for index, fault in enumerate(faults):
            if not fault.result and not [*problems(fault)]:
                faults[index] = tried(fault, deep=options.deep)
                print(f"{fault.path}: {fault.effect}: {faults[index].result}", flush=True)
                path.write_text("\n\n".join(one.text() for one in faults) + "\n", "utf-8")
    for path in sorted(FOLDER.glob("*.txt")):
        tally = Counter(
            one.result.partition(":")[0] or "not tried" for one in parsed(path.read_text("utf-8"))
        )
        print(f"{path.name}: " + ", ".join(f"{count} {result}" for result, count in sorted(tally.items())))


if __name__ == "__main__":
    main()
