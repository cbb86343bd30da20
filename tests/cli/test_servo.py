"""`dxlrun servo` on virtual time, the cases of servo.txt: judged by the simulated bus' ledger."""

import io
import json
import os
import re
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest
from tests.kit.answers import result_of
from tests.kit.commands import Case, Dxlrun, Said, Stage, cases, play
from tests.kit.rigs import VirtualLines

from dxlrun.dynamixel.tools import scanning
from dxlrun.dynamixel.tools.scanning import FoundServo
from dxlrun.dynamixel.tools.servo_backup import read_backup
from dxlrun.errors import InputError
from dxlrun.log.log_reader import read_log
from dxlsim.bus.ledger import LedgerEntry
from dxlsim.simulation_plan import BusConfig, DeviceConfig, ServoConfig
from dxlwire.packets import PacketKind

pytestmark = pytest.mark.long

NEW = ("--protocol", "2.0", "--baud", "1000000")
OLD = ("--protocol", "1.0", "--baud", "1000000")


def writes(entries: Iterable[LedgerEntry]) -> list[bytes]:
    """Return the ID and the parameters of each write instruction."""
    sent = [entry.data for entry in entries if entry.direction == "in"]
    new = [data[4:5] + data[8:-2] for data in sent if data[2] == 0xFD and data[7] == 3]
    return new + [data[2:3] + data[5:-1] for data in sent if data[2] != 0xFD and data[4] == 3]


class OnALine(Stage):
    """A simulated bus, whose ledger is read after the last command."""

    def __init__(self, lines: VirtualLines, dxlrun: Dxlrun) -> None:
        super().__init__()
        self._lines, self._dxlrun = lines, dxlrun
        self.given = {"servos": self._servos, "boards": self._boards, "tripped": self._await_watchdog}
        self.asked = {"written": self._written}
        self.names = {"NEW": [*NEW], "OLD": [*OLD], "FAST": [*NEW[:-1], "2000000"]}

    def _servos(self, line: str) -> None:
        model, protocol, *ids = line.replace(":", "").split()
        servos = tuple(ServoConfig(int(each), model, 2.0 - at) for at, each in enumerate(ids))
        self._serve(BusConfig("main", 1_000_000, servos, float(protocol)))

    def _boards(self, line: str) -> None:
        boards = tuple(DeviceConfig(int(each), model) for model, each in re.findall(r"([\w-]+): (\d+)", line))
        protocol = 1.0 if line.startswith("1.0") else 2.0
        servos = (ServoConfig(1, "MX-28" if protocol == 1.0 else "XL430-W250", 3.0),)
        self._serve(BusConfig("main", 1_000_000, servos, protocol, devices=boards))

    def _serve(self, bus: BusConfig) -> None:
        path, self._finish = self._lines.serve(bus)
        self.names["PORT"] = [path]

    def _await_watchdog(self, servo_id: str) -> None:
        """Wait while no instruction reaches the servo."""
        self._lines.wait(0.03)  # its time is 20 ms
        read = ("servo", *self.names["PORT"], servo_id, "get", "bus_watchdog", *NEW)
        assert "tripped" in self._dxlrun(*read).out

    def _written(self) -> list[str]:
        return [f"{one[0]} {one[1:].hex(' ')}" for one in writes(self._finish())] or ["nothing"]


@pytest.mark.usefixtures("reader")
@pytest.mark.parametrize("case", cases("servo.txt"))
def test_verbs_of_servo(dxlrun: Dxlrun, virtual_lines: VirtualLines, case: Case) -> None:
    play(case, dxlrun, OnALine(virtual_lines, dxlrun))


Command = Callable[..., Said]


@pytest.fixture
def one(dxlrun: Dxlrun, virtual_lines: VirtualLines) -> Callable[..., tuple[Command, Callable[[], Any]]]:
    """Serve servos of one model; gives the command, and the end with the ledger."""

    def start(model: str = "XM430-W350", protocol: float = 2.0, ids: tuple[int, ...] = (1,)) -> Any:
        servos = tuple(ServoConfig(each, model, 2.0) for each in ids)
        path, finish = virtual_lines.serve(BusConfig("main", 1_000_000, servos, protocol))
        return lambda servo_id, *words: dxlrun("servo", path, servo_id, *words), finish

    return start


def test_id_that_answers_in_two_places_is_asked_about(
    dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = (FoundServo(2.0, 57_600, 1, "XM430-W350"), FoundServo(1.0, 1_000_000, 1, "AX-12A"))
    monkeypatch.setattr(scanning, "find_servo", lambda *_: found)
    master, slave = os.openpty()
    said = dxlrun("servo", os.ttyname(slave), 1, "get")
    os.close(master)
    os.close(slave)
    assert said.code == 1
    assert "ID 1 answers more than once (Protocol 2.0 at 57600 bit/s; Protocol 1.0 at 1000000" in said.err


@pytest.mark.parametrize(("model", "protocol", "words"), [("XM430-W350", 2.0, NEW), ("AX-12A", 1.0, OLD)])
def test_backup_goes_into_a_file_and_back_into_another_servo(
    one: Any, tmp_path: Path, model: str, protocol: float, words: tuple[str, ...]
) -> None:
    servo, _ = one(model, protocol, (1, 2))
    path = tmp_path / "servo.json"
    for name, value in (("return_delay_time", "20"), ("temperature_limit", "60")):
        servo(1, "set", name, value, "--yes", *words)
    assert f"registers saved in {path}" in servo(1, "backup", path, *words).out
    kept = json.loads(path.read_text())
    assert (kept["model"], kept["id"], kept["registers"]["return_delay_time"]) == (model, 1, 20)
    assert "cannot be written (it exists)" in servo(1, "backup", path, *words).err
    back = servo(2, "restore", path, "--yes", *words)
    assert back.code == 0, back.err
    assert "Return Delay Time" in back.out
    assert "Temperature Limit" in back.out
    first, second = (result_of(servo(each, "get", "--json", *words).out)["registers"] for each in (1, 2))
    differing = {name for name in first if first[name] != second[name] and not name.startswith("present_")}
    assert differing <= {"id", "realtime_tick", "goal_position", "position_trajectory", "torque_limit"}
    assert "has all values of" in servo(2, "restore", path, *words).out


def test_backup_of_another_model_is_refused(one: Any, tmp_path: Path) -> None:
    servo, finish = one("XL430-W250")
    path = tmp_path / "servo.json"
    servo(1, "backup", path, *NEW)
    kept = json.loads(path.read_text())
    for changed, sentences in (
        (
            {"model_number": 1020, "model": "XM430-W350"},
            ["is a backup of XM430-W350, Protocol 2.0, not of XL430-W250"],
        ),
        (
            {"registers": {"led": 7, "lde": 1, "temperature_limit": "hot"}},
            ["is not a backup of a servo"],
        ),
        ({"registers": {"led": 7, "lde": 1}}, ["led is 7, not in 0..1", "has no writable register lde"]),
    ):
        path.write_text(json.dumps(kept | changed))
        said = servo(1, "restore", path, "--yes", *NEW)
        assert said.code == 2
        assert [one for one in sentences if one not in said.err] == []
    assert writes(finish()) == []


@pytest.mark.parametrize("content", [b"{", b'{"model": "\xff"}', b'{"x": ' + b"[" * 200_000])
def test_damaged_backup_is_one_sentence(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "servo.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"servo\.json is not a backup of a servo: "):
        read_backup(path)


class Terminal(io.StringIO):
    """A terminal with an answer typed."""

    def isatty(self) -> bool:
        return True


def test_only_yes_confirms(one: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    servo, finish = one()
    for answer in ("n\n", "", "\n", "y\n"):
        monkeypatch.setattr(sys, "stdin", Terminal(answer))
        said = servo(1, "id", "3", *NEW)
        assert said.code == (0 if answer == "y\n" else 1)
        assert "XM430-W350, ID 1 at 1000000 bit/s: its ID becomes 3 (EEPROM). Continue? [y/N]" in said.err
        assert ("nothing was changed" in said.out) == bool(said.code)
    assert len(writes(finish())) == 1


def test_packets_of_a_verb_are_a_log_when_it_is_named(one: Any, tmp_path: Path) -> None:
    servo, finish = one()
    log = tmp_path / "servo.mcap"
    assert servo(1, "set", "led", "1", *NEW, "--log", log).code == 0
    read = read_log(log)
    sent = b"".join(packet.data for packet in read.packets if packet.kind == PacketKind.INSTRUCTION)
    entries = finish()
    assert sent == b"".join(entry.data for entry in entries if entry.direction == "in")
    assert writes(entries)
    assert read.complete
    assert " servo " in read.metadata["tool"]["command"]
