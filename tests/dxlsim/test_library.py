"""dxlsim as a library: what it imports, its face, its examples, its fixture and its program."""

import contextlib
import doctest
import io
import os
import pkgutil
import re
import signal
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import FunctionType

import pytest
import serial
from tests.kit.awaited import DEADLINE_S, until

import dxlsim
from dxlsim import ServedBus, read_ledger, serve_bus
from dxlsim.__main__ import main
from dxlwire.exceptions import InputError

pytest_plugins = ["dxlsim.pytest_plugin"]

ROOM = Path(dxlsim.__file__).parent
BLOCKS = re.findall(r"```python\n(.*?)```", (ROOM / "README.md").read_text(), re.DOTALL)
MODULES = [
    one.name
    for one in pkgutil.walk_packages([str(ROOM)], "dxlsim.")
    if not one.name.rpartition(".")[2].startswith(("__main__", "lib"))  # compiled objects are no modules
]
PING_1 = bytes.fromhex("ff ff fd 00 01 03 00 01 19 4e")


def test_the_face_loads_nothing_that_simulates_and_no_module_the_runtime() -> None:
    code = f"import sys, dxlsim; print(*sys.modules); import {', '.join(MODULES)}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    face, whole = (line.split() for line in done.stdout.splitlines())
    assert [name for name in face if name == "numpy" or name.startswith("dxlsim.")] == []
    assert [name for name in whole if name.partition(".")[0] in ("dxlrun", "pydantic")] == []
    assert len(MODULES) > 40


def test_each_name_of_the_face_is_documented_and_there_are_no_others() -> None:
    assert dxlsim.__all__
    for name in dxlsim.__all__:
        value = getattr(dxlsim, name)
        # an alias of a type has no text
        assert value.__doc__ or not isinstance(value, type | FunctionType), name
    assert set(dxlsim.__all__) <= set(dir(dxlsim))
    with pytest.raises(AttributeError, match="'dxlsim' has no attribute 'Servo'"):
        getattr(dxlsim, "Servo")  # noqa: B009  mypy knows that it is not there


def test_examples_of_docstrings_are_right() -> None:
    results = [doctest.testmod(import_module(name)) for name in MODULES]
    assert sum(result.failed for result in results) == 0
    assert sum(result.attempted for result in results) >= 5


def test_tests_of_the_readme_pass(tmp_path: Path) -> None:
    conftest, example = (block for block in BLOCKS if "pytest" in block)
    (tmp_path / "conftest.py").write_text(conftest)
    (tmp_path / "test_example.py").write_text(example)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--strict-markers", "."]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")}
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment, check=False)
    assert "2 passed" in done.stdout, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("word", "output"), [("serve_bus", "[85, 30]\n"), ("VirtualPorts", "ff ff 01 02 00 fc 620000\n")]
)
def test_scripts_of_the_readme_print_what_happens(word: str, output: str) -> None:
    (script,) = (block for block in BLOCKS if f"import {word}" in block or f", {word}" in block)
    with contextlib.redirect_stdout(io.StringIO()) as out:
        exec(compile(script, "README.md", "exec"), {})  # noqa: S102  our own README
    assert out.getvalue() == output


def ping(path: str, baud_rate: int = 57_600) -> bytes:
    with serial.Serial(path, baud_rate, timeout=DEADLINE_S) as port:
        port.write(PING_1)
        return bytes(port.read(14))


def test_fixture_serves_two_servos_and_keeps_every_byte(dynamixel_bus: ServedBus) -> None:
    reply = ping(dynamixel_bus.path)
    assert [servo.id for servo in dynamixel_bus.snapshot_servos()] == [1, 2]
    passed = [(entry.direction, entry.data) for entry in dynamixel_bus.ledger.entries]
    assert passed == [("in", PING_1), ("out", reply)]


@pytest.mark.dynamixel_bus("XM430-W350:1", baud_rate=1_000_000, faults=["overheat servo=1 celsius=90"])
def test_mark_chooses_the_servos_of_the_fixture(dynamixel_bus: ServedBus) -> None:
    (servo,) = dynamixel_bus.snapshot_servos()
    assert (dynamixel_bus.baud_rate, servo.model, round(servo.temperature)) == (1_000_000, "XM430-W350", 90)


def test_bus_has_its_link_until_it_is_closed_and_a_path_only_while_it_is_plugged_in(tmp_path: Path) -> None:
    link = tmp_path / "ttyDXL"
    with serve_bus("XL430-W250:1", link=link) as bus:
        before = bus.path
        assert os.readlink(link) == before
        bus.inject("unplug for=50ms")
        until(lambda: bus.path not in ("", before))
        assert len(ping(bus.path)) == 14
    assert not link.is_symlink()
    with pytest.raises(serial.SerialException):
        serial.Serial(bus.path)
    bus.close()


@pytest.mark.parametrize("fault", ["lose servo=9", "explode servo=1"])
def test_fault_that_cannot_happen_is_refused(fault: str) -> None:
    with serve_bus("XL430-W250:1") as bus, pytest.raises(InputError):
        bus.inject(fault)
    with pytest.raises(InputError):
        serve_bus("XL430-W250:1", faults=[fault])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_program_serves_until_a_signal(tmp_path: Path, number: signal.Signals) -> None:
    link, ledger = tmp_path / "ttyDXL", tmp_path / "bus.jsonl"
    words = ("--servo", "XL430-W250:1-6", "--link", str(link), "--ledger", str(ledger))
    command = [sys.executable, "-m", "dxlsim", *words, "--fault", "silence servo=2"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as served:
        assert served.stdout is not None
        first = served.stdout.readline() + served.stdout.readline()
        assert "XL430-W250 1, 2, 3, 4, 5, 6 at 57600 bit/s, Protocol 2.0" in first
        assert "fault: silence servo=2" in first
        assert len(ping(str(link))) == 14
        served.send_signal(number)
        assert served.wait(DEADLINE_S) == 0
    assert not link.is_symlink()
    assert [entry.data for entry in read_ledger(ledger) if entry.direction == "in"] == [PING_1]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("", "--servo is missing"),
        ("--servo XL430-W250", "this is not MODEL:IDS"),
        ("--servo XL430-W250:1 --fault lose+servo=7", "has no servo 7"),
        ("--servo XL430-W250:1 --latency-timer 4", "--latency-timer: '4' is not a duration"),
        ("--servo XL430-W250:1 --link /proc/no/link", "No such file"),
        ("--servo XL430-W250:1 --ledger /", "/ cannot be written"),
        ("--help", "python -m dxlsim --servo XL430-W250:1-6"),
        ("--faults", "silence servo=ID"),
    ],
)
def test_program_refuses_wrong_words_and_helps(words, sentence, capsys) -> None:
    code, before = 0, signal.getsignal(signal.SIGINT)
    try:
        code = main([word.replace("+", " ") for word in words.split()]) or 0
    except SystemExit as ended:
        code = int(ended.code or 0)
    said = capsys.readouterr()
    helps = words.startswith("--help") or words == "--faults"
    assert (code, sentence in (said.out if helps else said.err)) == (0 if helps else 2, True)
    assert signal.getsignal(signal.SIGINT) is before
