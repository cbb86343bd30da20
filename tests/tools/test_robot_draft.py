"""A drafted robot file is one that compiles, for every model there is."""

import pytest

from dxlrun.compile import compile_files
from dxlrun.control_table import all_tables
from dxlrun.dynamixel.scanning import FoundServo
from dxlrun.errors import InputError, ServoFault
from dxlrun.robot_draft import draft, draft_file

PORT = "/dev/ttyUSB0"


def found(servo_id, model, protocol=2.0, rate=1_000_000, **more):
    return FoundServo(protocol, rate, servo_id, model, 1, **more)


@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_every_model_gets_a_line_that_check_accepts(tmp_path, protocol):
    models = [table.model for table in all_tables() if table.protocol == protocol]
    servos = [found(index + 1, model, protocol) for index, model in enumerate(models[:40])]
    path = tmp_path / "all.yaml"
    path.write_text(draft("all", PORT, servos, 1_000_000))
    compiled = compile_files(path, {}, [])
    assert [servo.model for servo in compiled.plan.buses[0].servos] == models[:40]


def test_the_file_says_what_was_found(tmp_path):
    path = tmp_path / "My-Arm 2.yaml"
    servos = [
        found(1, "XM430-W350", lowest=1024, highest=3072, return_delay=0),
        found(7, "XL430-W250", lowest=0, highest=4095, return_delay=20_000, remarks=("is tired",)),
    ]
    text = draft_file(path, PORT, servos, 4_000_000)
    assert path.read_text() == text
    plan = compile_files(path, {}, []).plan
    (bus,) = plan.buses
    assert (plan.robot, bus.port, bus.baud_rate, bus.latency_ns) == ("my_arm_2", PORT, 1_000_000, 4_000_000)
    assert bus.return_delay_ns == 20_000
    assert 1024 <= bus.servos[0].lower_tick <= 1026
    assert 3070 <= bus.servos[0].upper_tick <= 3072
    assert "# joint_7: is tired" in text


def test_the_rate_fits_the_bus(tmp_path):
    path = tmp_path / "slow.yaml"
    servos = [found(number, "AX-12A", 1.0, 9_600) for number in range(1, 9)]
    path.write_text(draft("slow", PORT, servos, 16_000_000))
    plan = compile_files(path, {}, []).plan
    assert plan.loop.period_ns == 1_000_000_000
    assert 250_000_000 < plan.buses[0].budget.total_ns <= 500_000_000


def test_a_wheel_is_named_as_what_it_may_be():
    assert "continuous: true" in draft("base", PORT, [found(1, "AX-12A", 1.0, lowest=0, highest=0)], 0)


@pytest.mark.parametrize("other", [found(2, "XM430-W350", rate=57_600), found(2, "AX-12A", 1.0)])
def test_what_cannot_be_one_bus_is_refused_with_the_way_out(tmp_path, other):
    with pytest.raises(ServoFault, match=r"these servos cannot share a bus.*ID 2.*dxlrun servo /dev/ttyUSB0"):
        draft_file(tmp_path / "two.yaml", PORT, [found(1, "XM430-W350"), other], 0)
    assert not list(tmp_path.iterdir())


def test_nobody_known_is_no_robot():
    with pytest.raises(ServoFault, match="no servo of a known model"):
        draft("none", PORT, [FoundServo(2.0, 57_600, 1)], 0)


@pytest.mark.parametrize("name", ["there.yaml", "robot.json", "missing/robot.yaml"])
def test_a_file_that_cannot_be_written_so_is_refused(tmp_path, name):
    (tmp_path / "there.yaml").write_text("mine")
    with pytest.raises(InputError, match=name):
        draft_file(tmp_path / name, PORT, [found(1, "XM430-W350")], 0)
    assert (tmp_path / "there.yaml").read_text() == "mine"
