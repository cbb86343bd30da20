"""`dxlrun servo`: its words, and every verb on a pseudo-terminal, judged by the simulated bus' ledger."""

import io
import json
import os
import sys
import time

import pytest
from tests.kit.answers import result_of

from dxlrun.dynamixel.tools import scanning
from dxlrun.dynamixel.tools.scanning import FoundServo
from dxlrun.dynamixel.tools.servo_backup import read_backup
from dxlrun.errors import InputError
from dxlrun.log.log_reader import read_log
from dxlsim.simulation_plan import BusConfig, ServoConfig
from dxlwire.packets import PacketKind

pytestmark = pytest.mark.long

NEW = ("--protocol", "2.0", "--baud", "1000000")
OLD = ("--protocol", "1.0", "--baud", "1000000")


@pytest.fixture
def one(dxlrun, simulated_line):
    """Serve servos of one model, ID 1 and perhaps others; gives the command, and the end with the ledger."""

    def start(model="XM430-W350", protocol=2.0, rate=1_000_000, ids=(1,)):
        servos = tuple(ServoConfig(each, model, 2.0) for each in ids)
        path, finish = simulated_line(BusConfig("main", rate, servos, protocol))

        def command(servo_id, *words):
            return dxlrun("servo", path, servo_id, *words)

        return command, finish

    return start


def writes(entries):
    """Return what was written: parameters of each write instruction."""
    sent = [entry.data for entry in entries if entry.direction == "in"]
    new = [data[8:-2] for data in sent if data[2] == 0xFD and data[7] == 3]
    return new + [data[5:-1] for data in sent if data[2] != 0xFD and data[4] == 3]


def test_registers_are_read_and_written_and_the_eeprom_only_when_it_was_asked_for(one):
    servo, finish = one()
    table = servo(1, "get", *NEW)
    assert table.code == 0, table.err
    assert ["return_delay_time", "9", "EEPROM", "RW", "250", "500", "us"] in [
        line.split() for line in table.out.splitlines()
    ]
    assert servo(1, "set", "position_p_gain", "900", *NEW).out.strip().endswith("was changed from 800 to 900")
    refused = servo(1, "set", "return_delay_time", "0", *NEW)
    assert refused.code == 2
    assert "Return Delay Time (9) changes from 250 to 0 (EEPROM): not a terminal, cannot ask" in refused.err
    assert "add --yes" in refused.err
    done = servo(1, "set", "return_delay_time", "100 us", "--yes", "--json", *NEW)
    result = result_of(done.out)
    assert result["done"] == ["Return Delay Time (9) was changed from 250 to 50"]
    assert result["servo"]["model"] == "XM430-W350"
    again = servo(1, "set", "return_delay_time", "100 us", *NEW)  # nothing to confirm
    assert (again.code, "is 50 already" in again.out) == (0, True)
    offset = servo(1, "set", "homing_offset", "-100", "--yes", *NEW)
    assert (offset.code, "was changed from 0 to -100" in offset.out) == (0, True)
    read = result_of(servo(1, "get", "return_delay_time", "homing_offset", "--json", *NEW).out)
    assert read["registers"] == {"return_delay_time": 50, "homing_offset": -100}
    assert len(writes(finish())) == 3


def test_a_tripped_bus_watchdog_is_shown_named_and_cleared(one):
    servo, finish = one()
    servo(1, "torque", "on", *NEW)
    servo(1, "set", "bus_watchdog", "1", *NEW)
    time.sleep(0.2)  # no instruction for more than its 20 ms
    assert servo(1, "get", "bus_watchdog", *NEW).out.split()[-2:] == ["255", "tripped"]
    done = servo(1, "set", "goal_position", "1400", *NEW)
    assert done.code == 0, done.err
    assert "cleared Bus Watchdog (98) = 255 (tripped): it had stopped the servo" in done.out
    assert done.out.strip().endswith("to 1400")
    servo(1, "set", "bus_watchdog", "1", *NEW)
    time.sleep(0.2)
    asked = servo(1, "torque", "on", "--json", *NEW)
    assert len(result_of(asked.out)["done"]) == 2, asked.err
    assert "Bus Watchdog" in result_of(asked.out)["done"][0]
    finish()


REFUSED = [
    (("set", "id", "7"), "use `dxlrun servo PORT ID id NEW`"),
    (
        ("set", "position_gain", "7"),
        "has no register position_gain; did you mean position_d_gain or position_i_gain or position_p_gain?",
    ),
    (("set", "position_p_gain", "99999"), "is 0..16383, not 99999"),
    (("set", "present_position", "7"), "Present Position (132) can only be read"),
    (("set", "goal_position", "fast"), "fast"),
    (("get", "gaol"), "has no gaol"),
    (("baud", "12345"), "has no baud rate of 12345 bit/s; give one of 9600, 57600"),
    (("id", "253"), "Protocol 2.0 has no ID 253; give one from 0 to 252"),
]


def test_what_the_model_does_not_have_is_reported(one):
    servo, finish = one()
    for words, sentence in REFUSED:
        said = servo(1, *words, *NEW)
        assert said.code == 2
        assert sentence in said.err
    assert writes(finish()) == []


def test_a_servo_moves_to_another_id_and_rate_and_is_started_anew_and_reset(one):
    servo, finish = one()
    assert "has ID 9 (before: 1)" in servo(1, "id", "9", "--yes", *NEW).out
    assert "runs at 2000000 bit/s (before: 1000000)" in servo(9, "baud", "2000000", "--yes", *NEW).out
    fast = ("--protocol", "2.0", "--baud", "2000000")
    assert "rebooted, and is limp" in servo(9, "reboot", *fast).out
    reset = servo(9, "factory-reset", "--except", "id", "--yes", *fast)
    assert "has the factory values, ID 9 at 57600 bit/s" in reset.out
    missing = servo(9, "get", *fast)
    assert missing.code == 1
    assert "no servo with ID 9 answers at" in missing.err
    assert len(writes(finish())) == 2


def test_a_servo_is_found_without_its_address(one):
    servo, _ = one("AX-12A", 1.0, 1_000_000)
    said = servo(1, "get", "model_number", "--json")
    assert result_of(said.out)["servo"] == {
        "id": 1,
        "model": "AX-12A",
        "firmware": 24,
        "protocol": 1.0,
        "baud_rate": 1_000_000,
    }


def test_an_id_that_answers_in_two_places_is_asked_about(dxlrun, monkeypatch):
    found = (FoundServo(2.0, 57_600, 1, "XM430-W350"), FoundServo(1.0, 1_000_000, 1, "AX-12A"))
    monkeypatch.setattr(scanning, "find_servo", lambda *_: found)
    master, slave = os.openpty()
    said = dxlrun("servo", os.ttyname(slave), 1, "get")
    os.close(master)
    os.close(slave)
    assert said.code == 1
    assert "ID 1 answers more than once (Protocol 2.0 at 57600 bit/s; Protocol 1.0 at 1000000" in said.err


def test_torque_and_led_need_no_question_and_torque_guards_the_eeprom(one):
    servo, _ = one()
    assert "holds torque in position mode at its present tick 1304" in servo(1, "torque", "on", *NEW).out
    refused = servo(1, "id", "5", "--yes", *NEW)
    assert refused.code == 1
    assert "holds torque, so ID (7) in its EEPROM was not written: switch the torque off" in refused.err
    assert "holds torque: the reboot switches it off" in servo(1, "reboot", *NEW).err
    assert "is limp" in servo(1, "torque", "off", *NEW).out
    assert "blinked 1 times" in servo(1, "blink", "1", *NEW).out


@pytest.mark.parametrize(("model", "protocol", "words"), [("XM430-W350", 2.0, NEW), ("AX-12A", 1.0, OLD)])
def test_a_backup_goes_into_a_file_and_back_into_another_servo(one, tmp_path, model, protocol, words):
    servo, _ = one(model, protocol, int(words[-1]), (1, 2))
    path = tmp_path / "servo.json"
    servo(1, "set", "return_delay_time", "20", "--yes", *words)
    servo(1, "set", "temperature_limit", "60", "--yes", *words)
    assert f"registers saved in {path}" in servo(1, "backup", path, *words).out
    kept = json.loads(path.read_text())
    assert (kept["model"], kept["id"], kept["registers"]["return_delay_time"]) == (model, 1, 20)
    assert "cannot be written (it exists)" in servo(1, "backup", path, *words).err
    back = servo(2, "restore", path, "--yes", *words)
    assert back.code == 0, back.err
    assert "Return Delay Time" in back.out
    assert "Temperature Limit" in back.out
    one_, two = (result_of(servo(each, "get", "--json", *words).out)["registers"] for each in (1, 2))
    differing = {name for name in one_ if one_[name] != two[name] and not name.startswith("present_")}
    assert differing <= {"id", "realtime_tick", "goal_position", "position_trajectory", "torque_limit"}
    assert "has all values of" in servo(2, "restore", path, *words).out


def test_a_backup_of_another_model_is_refused(one, tmp_path):
    servo, finish = one("XL430-W250")
    path = tmp_path / "servo.json"
    servo(1, "backup", path, *NEW)
    kept = json.loads(path.read_text())
    path.write_text(json.dumps(kept | {"model_number": 1020, "model": "XM430-W350"}))
    said = servo(1, "restore", path, "--yes", *NEW)
    assert said.code == 2
    assert "is a backup of XM430-W350, Protocol 2.0, not of XL430-W250" in said.err
    path.write_text(json.dumps(kept | {"registers": {"led": 7, "lde": 1, "temperature_limit": "hot"}}))
    assert "is not a backup of a servo" in servo(1, "restore", path, "--yes", *NEW).err
    path.write_text(json.dumps(kept | {"registers": {"led": 7, "lde": 1}}))
    said = servo(1, "restore", path, "--yes", *NEW)
    assert "led is 7, not in 0..1" in said.err
    assert "has no writable register lde" in said.err
    assert writes(finish()) == []


def test_a_servo_keeps_a_backup_of_its_own(one):
    servo, _ = one()
    assert "stored its control table in its internal backup" in servo(1, "backup", "--yes", *NEW).out
    servo(1, "set", "return_delay_time", "0", "--yes", *NEW)
    assert "restored its EEPROM from" in servo(1, "restore", "--yes", *NEW).out
    said = servo(1, "get", "return_delay_time", "--json", *NEW)
    assert result_of(said.out)["registers"] == {"return_delay_time": 250}


class Terminal(io.StringIO):
    """A terminal with an answer typed."""

    def isatty(self):
        return True


def test_only_yes_confirms(one, monkeypatch):
    servo, finish = one()
    for answer in ("n\n", "", "\n", "y\n"):
        monkeypatch.setattr(sys, "stdin", Terminal(answer))
        said = servo(1, "id", "3", *NEW)
        assert said.code == (0 if answer == "y\n" else 1)
        assert "XM430-W350, ID 1 at 1000000 bit/s: its ID becomes 3 (EEPROM). Continue? [y/N]" in said.err
        assert ("nothing was changed" in said.out) == bool(said.code)
    assert len(writes(finish())) == 1


def test_two_servos_of_one_id_are_not_dealt_with(one, simulated_line, dxlrun):
    servos = (ServoConfig(1, "XM430-W350", 2.0), ServoConfig(1, "XM430-W350", 1.0))
    path, finish = simulated_line(BusConfig("main", 1_000_000, servos, 2.0))
    said = dxlrun("servo", path, 1, "id", "5", "--yes", *NEW)
    assert said.code == 1
    assert "do two servos have this ID?" in said.err
    assert writes(finish()) == []


@pytest.mark.parametrize("content", [b"{", b'{"model": "\xff"}', b'{"x": ' + b"[" * 200_000])
def test_a_damaged_backup_is_one_sentence(tmp_path, content: bytes):
    path = tmp_path / "servo.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"servo\.json is not a backup of a servo: "):
        read_backup(path)


def test_the_packets_of_a_verb_are_a_log_when_it_is_named(one, tmp_path):
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


def test_get_shows_what_a_start_would_refuse_or_report(one):
    servo, _ = one()
    servo(1, "set", "secondary_shadow_id", 2, "--yes", *NEW)
    servo(1, "set", "pwm_limit", 400, "--yes", *NEW)
    said = servo(1, "get", "secondary_shadow_id", "pwm_limit", "velocity_limit", *NEW).out
    assert [word in said for word in ("refused: makes", "reported: limits")] == [True, True]
    judged = result_of(servo(1, "get", "--json", *NEW).out)["deviations"]
    assert {name: found["judgement"] for name, found in judged.items()} == {
        "secondary_shadow_id": "refuse",
        "pwm_limit": "report",
    }
