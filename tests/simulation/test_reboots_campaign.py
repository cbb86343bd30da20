"""Campaign: a servo reboots at a random byte of the wire, in a set-up, in a cycle, in a gap, at the end.

Judged by the simulated bus' ledger alone, see fault_judge.py: no servo that rebooted gets torque without a
policy, no value of the time before is taken for one of the time after, and the others go on.

No servo is back sooner than 50 ms after it lost its power [i]: at 50 Hz it misses a read. On Protocol 1.0
nothing would show a shorter reboot, and the next goal would switch its torque on (protocol.md). On Protocol
2.0 its clock shows it, which is read once a second.

CI reboots 4 times from a fixed seed. The full campaign before a release:

    DXLRUN_REBOOTS=200 python -m pytest tests/simulation/test_reboots_campaign.py -q

`DXLRUN_REBOOT_SEED` (default 1) is what servo, byte and duration are drawn from.
"""

from __future__ import annotations

import os
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dxlrun.log.reader import read_log
from dxlrun.testing import simulated_robot

BYTE_NS = 10_000
"""At 1 Mbit/s."""
DURATION_S = 3.0
LATEST_BYTE = 150_000
"""Some 1.5 s: a reboot at the very end is no longer seen."""
ROBOT = """\
name: eight
loop: {rate: 50}
buses:
  main: {port: sim, protocol: PROTOCOL, baud_rate: 1_000_000, return_delay_time: 100 us}
joints:
"""
JOINT = "  j{id}: {{bus: main, id: {id}, model: {model}, reference: {middle} deg, direction: 1}}\n"
MODELS = {1.0: ("AX-12A", 150), 2.0: ("XM430-W350", 180)}


def reboots() -> list[Any]:
    """Return protocols in turn, the servo that reboots, at which byte, and for how long it is silent, ms."""
    chance = random.Random(int(os.environ.get("DXLRUN_REBOOT_SEED", "1")))
    drawn = []
    for index in range(int(os.environ.get("DXLRUN_REBOOTS", "4"))):
        protocol = (1.0, 2.0)[index % 2]
        byte = chance.randrange(LATEST_BYTE)
        boot_ms = chance.choice((50, 60, 100, 400) if protocol == 1.0 else (1, 10, 50, 60, 100, 400))
        drawn.append((protocol, chance.randint(1, 8), byte, boot_ms))
    return [pytest.param(*one, id=f"{index}-servo{one[1]}-byte{one[2]}") for index, one in enumerate(drawn)]


@pytest.mark.campaign
@pytest.mark.parametrize(("protocol", "servo_id", "byte", "boot_ms"), reboots())
def test_a_reboot_at_any_byte_breaks_no_promise(  # noqa: PLR0917  what was drawn, and fixtures
    protocol: float, servo_id: int, byte: int, boot_ms: int, tmp_path: Path, judge: Any
) -> None:
    model, middle = MODELS[protocol]
    path, log_path = tmp_path / "eight.yaml", tmp_path / "run.mcap"
    joints = "".join(JOINT.format(id=number, model=model, middle=middle) for number in range(1, 9))
    path.write_text(ROBOT.replace("PROTOCOL", str(protocol)) + joints)
    robot = simulated_robot(path, duration_s=DURATION_S, log=log_path)
    reboot = f"reboot servo={servo_id} for={boot_ms}ms at={byte * BYTE_NS // 1000}us"
    print(reboot)
    trial = judge.Trial.of(robot, [reboot])
    started = trial.run()
    log = read_log(log_path)
    trial.judge(log)
    if not started:  # in the middle of the set-up
        assert f"ID {servo_id} " in "\n".join(trial.refusal)
        return
    others = np.delete(log.cycles["valid"], servo_id - 1, axis=1)
    assert others.mean() > 0.9  # those behind a silent one in a chain lose a cycle or two
    begun_ns = int(log.cycles["woken_ns"][0])
    if byte * BYTE_NS > begun_ns:
        (servo,) = (one for one in robot.buses[0].servos if one.servo_id == servo_id)
        assert not servo.registers["torque_enable"]
        joint = f"j{servo_id}"
        sent = [event.name for event in log.events if event.source == joint and event.t_ns > begun_ns]
        assert {"servo_limp", "servo_rebooted", "servo_lost"} & set(sent), sent
