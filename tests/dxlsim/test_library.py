"""dxlsim as a library: what it imports, its face, its examples, its fixture and its program."""

from __future__ import annotations

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
from dxlwire.exceptions import InputError

pytest_plugins = ["dxlsim.pytest_plugin"]

ROOM = Path(dxlsim.__file__).parent
README = (ROOM / "README.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
MODULES = sorted(one.name for one in pkgutil.walk_packages([str(ROOM)], "dxlsim."))
PING_1 = bytes.fromhex("ff ff fd 00 01 03 00 01 19 4e")


def printed(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout


def test_no_module_imports_the_runtime() -> None:
    names = [name for name in MODULES if not name.endswith("__main__")]
    loaded = printed(f"import sys, {', '.join(names)}; print(*sys.modules)").split()
    assert [name for name in loaded if name.partition(".")[0] in ("dxlrun", "pydantic")] == []
    assert len(names) > 40


def test_import_of_the_face_loads_nothing_that_simulates() -> None:
    loaded = printed("import sys, dxlsim; print(*sys.modules)").split()
    assert [name for name in loaded if name == "numpy" or name.startswith("dxlsim.")] == []


@pytest.mark.parametrize("name", dxlsim.__all__)
def test_each_name_of_the_face_is_documented(name: str) -> None:
    value = getattr(dxlsim, name)
    assert value.__doc__ or not isinstance(value, type | FunctionType)  # an alias of a type has none


def test_face_has_no_other_names() -> None:
    assert set(dxlsim.__all__) <= set(dir(dxlsim))
    with pytest.raises(AttributeError, match="'dxlsim' has no attribute 'Servo'"):
        getattr(dxlsim, "Servo")  # noqa: B009  mypy knows that it is not there


def test_examples_of_docstrings_are_right() -> None:
    results = [doctest.testmod(import_module(name)) for name in MODULES if name != "dxlsim.__main__"]
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
    ("word", "output"),
    [
        ("serve_bus", "[85.0, 30.0]\n"),
        ("VirtualPorts", "ff ff 01 02 00 fc 620000\n"),
    ],
)
def test_scripts_of_the_readme_print_what_happens(word: str, output: str) -> None:
    (script,) = (block for block in BLOCKS if f"import {word}" in block or f", {word}" in block)
    with contextlib.redirect_stdout(io.StringIO()) as out:
        exec(compile(script, "README.md", "exec"), {})  # noqa: S102  our own README
    assert out.getvalue() == output


def ping(bus: ServedBus) -> bytes:
    with serial.Serial(bus.path, bus.baud_rate, timeout=5.0) as port:
        port.write(PING_1)
        return bytes(port.read(14))


def test_fixture_serves_two_servos_and_keeps_every_byte(dynamixel_bus: ServedBus) -> None:
    reply = ping(dynamixel_bus)
    assert [servo.id for servo in dynamixel_bus.snapshot_servos()] == [1, 2]
    passed = [(entry.direction, entry.data) for entry in dynamixel_bus.ledger.entries]
    assert passed == [("in", PING_1), ("out", reply)]


@pytest.mark.dynamixel_bus("XM430-W350:1", baud_rate=1_000_000, faults=["overheat servo=1 celsius=90"])
def test_mark_chooses_the_servos_of_the_fixture(dynamixel_bus: ServedBus) -> None:
    (servo,) = dynamixel_bus.snapshot_servos()
    assert (dynamixel_bus.baud_rate, servo.model, servo.temperature) == (1_000_000, "XM430-W350", 90.0)


def test_bus_is_gone_after_it_was_closed(tmp_path: Path) -> None:
    link = tmp_path / "ttyDXL"
    with serve_bus("XL430-W250:1", link=link) as bus:
        assert os.readlink(link) == bus.path
    assert not link.is_symlink()
    with pytest.raises(serial.SerialException):
        serial.Serial(bus.path)
    bus.close()


def test_device_of_an_unplugged_adapter_has_no_path_until_it_is_back() -> None:
    with serve_bus("XL430-W250:1") as bus:
        before = bus.path
        bus.inject("unplug for=50ms")
        until(lambda: bus.path not in ("", before))
        assert len(ping(bus)) == 14


@pytest.mark.parametrize("fault", ["lose servo=9", "explode servo=1"])
def test_fault_that_cannot_happen_is_refused(fault: str) -> None:
    with serve_bus("XL430-W250:1") as bus, pytest.raises(InputError):
        bus.inject(fault)
    with pytest.raises(InputError):
        serve_bus("XL430-W250:1", faults=[fault])


def program(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "dxlsim", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=DEADLINE_S, check=False)


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
        with serial.Serial(str(link), 57_600, timeout=5.0) as port:
            port.write(PING_1)
            assert len(port.read(14)) == 14
        served.send_signal(number)
        assert served.wait(DEADLINE_S) == 0
    assert not link.is_symlink()
    assert [entry.data for entry in read_ledger(ledger) if entry.direction == "in"] == [PING_1]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ((), "--servo is missing"),
        (("--servo", "XL430-W250"), "this is not MODEL:IDS"),
        (("--servo", "XL430-W250:1", "--fault", "lose servo=7"), "has no servo 7"),
        (("--servo", "XL430-W250:1", "--latency-timer", "4"), "--latency-timer: '4' is not a duration"),
        (("--servo", "XL430-W250:1", "--link", "/proc/no/link"), "No such file"),
        (("--servo", "XL430-W250:1", "--ledger", "/"), "/ cannot be written"),
    ],
)
def test_program_refuses_wrong_words(words: tuple[str, ...], sentence: str) -> None:
    done = program(*words)
    assert done.returncode == 2
    assert sentence in done.stderr
    assert "Traceback" not in done.stderr


def test_help_of_the_program_shows_examples_and_faults() -> None:
    assert "python -m dxlsim --servo XL430-W250:1-6" in program("--help").stdout
    assert "silence servo=ID" in program("--faults").stdout
