"""A drafted robot file is one that compiles, for every model there is."""

import math
from array import array
from itertools import pairwise

import pytest

from dxlrun.channels.answers import Completion
from dxlrun.channels.commands import CommandMessage
from dxlrun.cli.tools.scan import draft, draft_file
from dxlrun.compile.robot_compiler import compile_files
from dxlrun.dynamixel.tools.scanning import FoundServo
from dxlrun.errors import InputError, ServoFault
from dxlrun.testing import simulated_robot
from dxlwire.control_table import all_tables

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


SYNC_WRITE = 0x83
GOALS = {1.0: (30, math.radians(300 / 1023)), 2.0: (116, math.radians(360 / 4096))}
"""By protocol: address of Goal Position of an AX-12A and an XL430-W250, and rad a tick (e-Manual)."""


def goals(entries, protocol):
    """Return (t_ns, servo ID, rad) of each goal position that was written by sync write."""
    address, unit = GOALS[protocol]
    first, size = (4, 2) if protocol == 1.0 else (7, 4)
    for entry in entries:
        if entry.direction != "in" or entry.data[first] != SYNC_WRITE:
            continue
        parameters = entry.data[first + 1 : -1 if protocol == 1.0 else -2]
        start, width = (parameters[0], parameters[1])
        if protocol == 2.0:
            start, width = int.from_bytes(parameters[:2], "little"), int.from_bytes(parameters[2:4], "little")
            parameters = parameters[2:]
        if not start <= address < start + width:
            continue
        for at in range(2, len(parameters), width + 1):
            row = parameters[at + 1 + address - start :][:size]
            yield entry.t_ns, parameters[at], int.from_bytes(row, "little") * unit


@pytest.mark.parametrize(("protocol", "model"), [(1.0, "AX-12A"), (2.0, "XL430-W250")])
@pytest.mark.parametrize(("baud_rate", "slow"), [(1_000_000, 30), (9_600, 15)])
def test_the_first_send_to_a_drafted_robot_moves_it_slowly(tmp_path, protocol, model, baud_rate, slow):
    path = tmp_path / "arm.yaml"
    text = draft_file(
        path, PORT, [found(1, model, protocol, baud_rate), found(2, model, protocol, baud_rate)], 0
    )
    assert text.count(f"velocity: {slow} deg/s") == 2
    assert "limits.velocity after" in text
    robot = simulated_robot(path, arguments={"port": "sim"}, duration_s=5.0)
    robot.inbox.waiting.append(
        CommandMessage(1, "all_joints", "positions", array("d", (1.0, -1.0)).tobytes(), "anna")
    )
    result = robot.run()
    assert (result.reason, result.detail) == ("ended", "")
    assert isinstance(robot.inbox.answers[1], Completion)
    written = list(goals(robot.ledger.entries, protocol))
    unit, middle = GOALS[protocol][1], math.radians(150 if protocol == 1.0 else 180)
    for servo_id, end in ((1, 1.0), (2, -1.0)):
        mine = [(t_ns, rad - middle) for t_ns, servo, rad in written if servo == servo_id]
        assert mine[-1][1] == pytest.approx(end, abs=unit)
        for (t_ns, rad), (next_ns, following) in pairwise([(mine[0][0] - 200_000_000, 0.0), *mine]):
            assert abs(following - rad) <= math.radians(slow) * (next_ns - t_ns) * 1e-9 + 1.5 * unit
        arrived = next(t_ns for t_ns, rad in mine if abs(rad) > 0.95)
        assert arrived - mine[0][0] >= 0.85 / math.radians(slow) * 1e9
