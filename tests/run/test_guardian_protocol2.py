"""The guardian on Protocol 2.0: the arm is limp after its loop was killed; judged by the ledger."""

import os
import signal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from tests.kit.awaited import until
from tests.kit.live_run import Start
from tests.kit.wire import all_writes

ARM = Path(__file__).parents[2] / "robots/open_manipulator_x.yaml"
IDS = (11, 12, 13, 14, 15)
ONE_CYCLE = 400
"""Bytes that a cycle of five servos has at most in one direction: a loop that is killed takes them along."""
BOARD_ID = 42
BOARD = """\
kind = "device"
model = "my-board"
model_number = 60_123
protocol = 2.0
capabilities = ["sync_read"]
cyclic = ["force"]
[items]
lamp = {address = 20, size = 1, access = "RW", maximum = 9, initial = 0, safe = 3}
force = {address = 30, size = 2}
"""
TORQUE_ENABLE = 64  # e-Manual, XM430-W350, control table
WIRE: Any = SimpleNamespace(protocol=2.0, servos=[SimpleNamespace(servo_id=one) for one in (*IDS, BOARD_ID)])


def test_an_arm_whose_loop_was_killed_is_limp_and_its_board_safe(start: Start, tmp_path: Path) -> None:
    (tmp_path / "board.toml").write_text(BOARD)
    robot = tmp_path / "arm.yaml"
    text = ARM.read_text().replace("urdf: urdf", f"urdf: {ARM.parent}/urdf")
    robot.write_text(
        f"{text}\ndevices: {{board: {{bus: main, id: {BOARD_ID}, model: board.toml, commands: [lamp]}}}}\n"
    )
    run = start(robot=robot)

    def writes() -> list[tuple[int, int, bytes]]:
        return [(servo, address, data) for _, servo, address, data in all_writes(run.ledger(), WIRE)]

    def goals() -> bool:
        return sum(address != TORQUE_ENABLE for _, address, _ in writes()) >= 10 * len(IDS)

    until(goals, "goals in the ledger", check=run.lives, pause_s=0.1)
    os.kill(run.child("run.loop_process"), signal.SIGKILL)
    code, _, err = run.finish()
    assert code == 1
    assert "torque off was confirmed by all 5 servos" in err
    changes = [
        (servo, bool(data[0]))
        for servo, address, data in writes()
        if address == TORQUE_ENABLE and servo in IDS
    ]
    assert any(on for _, on in changes)
    assert dict(changes) == dict.fromkeys(IDS, False)
    assert (BOARD_ID, 20, b"\x03") in writes()[-4:]  # the others: answers that came late
    assert run.wire_is_logged(ONE_CYCLE)
