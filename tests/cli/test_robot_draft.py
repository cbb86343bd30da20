"""A drafted robot file is one that compiles, for every model there is."""

import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from tests.kit import wire
from tests.kit.virtual_run import VirtualRun, send

from dxlrun.cli.tools.scan import draft, draft_file
from dxlrun.compile.robot_compiler import compile_files
from dxlrun.dynamixel.tools.scanning import FoundServo
from dxlrun.errors import InputError, ServoFault
from dxlwire.control_table import all_tables

PORT = "/dev/ttyUSB0"


def found(servo_id: int, model: str, protocol: float = 2.0, rate: int = 1_000_000, **more: Any) -> FoundServo:
    return FoundServo(protocol, rate, servo_id, model, 1, **more)


@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_every_model_gets_a_line_that_check_accepts(tmp_path: Path, protocol: float) -> None:
    models = [table.model for table in all_tables() if table.protocol == protocol][:40]
    servos = [found(number, model, protocol) for number, model in enumerate(models, 1)]
    path = tmp_path / "all.yaml"
    path.write_text(draft("all", PORT, servos, 1_000_000))
    assert [servo.model for servo in compile_files(path, {}, []).plan.buses[0].servos] == models


def test_file_has_what_was_found(tmp_path: Path) -> None:
    path = tmp_path / "My-Arm 2.yaml"
    servos = [
        found(1, "XM430-W350", lowest=1000, highest=3001, return_delay=0),
        found(7, "XL430-W250", lowest=0, highest=4095, return_delay=20_000, remarks=("is tired",)),
    ]
    text = draft_file(path, PORT, servos, 4_000_000)
    assert path.read_text() == text
    plan = compile_files(path, {}, []).plan
    (bus,) = plan.buses
    assert (plan.robot, bus.port, bus.baud_rate, bus.latency_ns) == ("my_arm_2", PORT, 1_000_000, 4_000_000)
    assert bus.return_delay_ns == 20_000
    assert 1000 <= bus.servos[0].lower_tick <= 1002
    assert 2999 <= bus.servos[0].upper_tick <= 3001
    assert "# joint_7: is tired" in text
    assert "continuous: true" in draft("base", PORT, [found(1, "AX-12A", 1.0, lowest=0, highest=0)], 0)


def test_rate_fits_the_bus(tmp_path: Path) -> None:
    path = tmp_path / "slow.yaml"
    servos = [found(number, "AX-12A", 1.0, 9_600) for number in range(1, 9)]
    path.write_text(draft("slow", PORT, servos, 16_000_000))
    plan = compile_files(path, {}, []).plan
    assert plan.loop.period_ns == 1_000_000_000
    assert 250_000_000 < plan.buses[0].budget.total_ns <= 500_000_000


@pytest.mark.parametrize(
    ("other", "fix"),
    [
        (found(2, "XM430-W350", rate=57_600), "dxlrun servo /dev/ttyUSB0"),
        (found(2, "AX-12A", 1.0), "an adapter of its own: a servo of Protocol 1.0 executes"),
    ],
)
def test_what_cannot_be_one_bus_is_refused_with_the_way_out(
    tmp_path: Path, other: FoundServo, fix: str
) -> None:
    with pytest.raises(ServoFault, match=rf"these servos cannot share a bus.*ID 2.*{fix}"):
        draft_file(tmp_path / "two.yaml", PORT, [found(1, "XM430-W350"), other], 0)
    assert not list(tmp_path.iterdir())
    with pytest.raises(ServoFault, match="no servo of a known model"):
        draft("none", PORT, [FoundServo(2.0, 57_600, 1)], 0)


@pytest.mark.parametrize("name", ["there.yaml", "robot.json", "missing/robot.yaml"])
def test_file_that_cannot_be_written_so_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "there.yaml").write_text("mine")
    with pytest.raises(InputError, match=name):
        draft_file(tmp_path / name, PORT, [found(1, "XM430-W350")], 0)
    assert (tmp_path / "there.yaml").read_text() == "mine"


@pytest.mark.parametrize(
    ("protocol", "model", "tick"),
    [(1.0, "AX-12A", math.radians(300 / 1023)), (2.0, "XM430-W350", math.radians(360 / 4096))],
)
@pytest.mark.parametrize(("baud_rate", "slow"), [(1_000_000, 30), (9_600, 15)])
def test_first_send_to_a_drafted_robot_moves_it_slowly(
    *, tmp_path: Path, protocol: float, model: str, tick: float, baud_rate: int, slow: int
) -> None:
    path = tmp_path / "arm.yaml"
    text = draft_file(path, PORT, [found(each, model, protocol, baud_rate) for each in (1, 2)], 0)
    assert text.count(f"velocity: {slow} deg/s") == 2
    assert "limits.velocity after" in text
    asked = {0: [send("all_joints", "positions", 1.0, -1.0)]}
    robot = VirtualRun(path, asked=asked, arguments={"port": "sim"}, duration_s=5.0)
    result = robot.run()
    assert (result.reason, result.detail) == ("ended", "")
    robot.require_done()
    bus = robot.plan.buses[0]
    sent = [*wire.instructions(robot.ledger.entries, bus)]
    written = [
        (t_ns, servo.servo_id, raw * tick - math.radians(150 if protocol == 1.0 else 180))
        for t_ns, servo, raw in wire.written(sent, bus, "goal_position")
    ]
    for servo_id, end in ((1, 1.0), (2, -1.0)):
        mine = [(t_ns, rad) for t_ns, servo, rad in written if servo == servo_id]
        assert mine[-1][1] == pytest.approx(end, abs=tick)
        for (t_ns, rad), (next_ns, following) in pairwise([(mine[0][0] - 200_000_000, 0.0), *mine]):
            assert abs(following - rad) <= math.radians(slow) * (next_ns - t_ns) * 1e-9 + 1.5 * tick
        arrived = next(t_ns for t_ns, rad in mine if abs(rad) > 0.95)
        began = next(t_ns for t_ns, rad in mine if abs(rad) > tick)
        assert arrived - began >= 0.85 / math.radians(slow) * 1e9
