"""The guardian on Protocol 2.0: the arm is limp after its loop was killed; judged by the ledger."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

from dxlrun.simulation.wire.packets import Instruction, InstructionReceiver
from dxlrun.simulation.wire.protocol2 import CODEC

ARM = Path(__file__).parents[2] / "robots/open_manipulator_x.yaml"
IDS = (11, 12, 13, 14, 15)
ONE_CYCLE = 400
"""Bytes that a cycle of five servos has at most in one direction."""
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


def writes(data: bytes, *, whole: bool = True) -> Iterator[tuple[int, int, bytes]]:
    """Cut the host's bytes into writes of (ID, address, data); all must be intact packets, whole ones."""
    line, start = InstructionReceiver(CODEC), 0
    while (packet := line.feed(data, start)) is not None:
        assert packet.intact
        start = packet.end
        parameters = packet.parameters
        address = int.from_bytes(parameters[:2], "little")
        if packet.instruction == Instruction.WRITE:
            for servo_id in IDS if packet.servo_id == 0xFE else (packet.servo_id,):
                yield servo_id, address, parameters[2:]
        elif packet.instruction == Instruction.SYNC_WRITE:
            step = int.from_bytes(parameters[2:4], "little") + 1
            for at in range(4, len(parameters), step):
                yield parameters[at], address, parameters[at + 1 : at + step]
    assert not (whole and line.pending)


def test_an_arm_whose_loop_was_killed_is_limp_and_its_board_safe(start, tmp_path, wait_for, wire_and_log):
    (tmp_path / "board.toml").write_text(BOARD)
    robot = tmp_path / "arm.yaml"
    text = ARM.read_text().replace("urdf: urdf", f"urdf: {ARM.parent}/urdf")
    robot.write_text(
        f"{text}\ndevices: {{board: {{bus: main, id: {BOARD_ID}, model: board.toml, commands: [lamp]}}}}\n"
    )
    run = start(robot=robot)

    def sent():
        return b"".join(entry.data for entry in run.ledger() if entry.direction == "in")

    def goals():
        return sum(address != TORQUE_ENABLE for _, address, _ in writes(sent(), whole=False)) >= 10 * len(IDS)

    wait_for(goals, "goals in the ledger")
    os.kill(run.child("dxlrun.run.loop_process"), signal.SIGKILL)
    code, _, err = run.finish()
    assert code == 1
    assert "torque off was confirmed by all 5 servos" in err
    torque = dict.fromkeys(IDS, False)
    changes = []
    for servo_id, address, data in writes(sent()):
        if address == TORQUE_ENABLE and servo_id in IDS:
            torque[servo_id] = bool(data[0])
            changes.append(bool(data[0]))
    assert (BOARD_ID, 20, b"\x03") in list(writes(sent()))[-4:]  # the others: answers that came late
    assert any(changes)
    assert not any(torque.values())
    # a loop that is killed takes the packets of its cycle along, and nothing else
    for wire, ours in wire_and_log(run):
        lost = len(wire) - len(ours)
        alike = next((at for at, (a, b) in enumerate(zip(wire, ours, strict=False)) if a != b), len(ours))
        assert 0 <= lost <= ONE_CYCLE
        assert ours[alike:] == wire[alike + lost :]
