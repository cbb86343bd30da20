"""The commands of docs/how-to/teleoperation.md, and its robot with an arm at each of two ports."""

import re
import shlex
from pathlib import Path

import pytest
from tests.kit.pages import page_text
from tests.kit.wire import changes

from dxlrun.testing import simulated_robot

ROOT = Path(__file__).parents[2]
PAGE = page_text("teleoperation.md")
COMMANDS = re.findall(r"^    dxlrun (.+)$", PAGE, re.MULTILINE)
TWO_PORTS = ROOT / "robots" / "leader_follower_two_ports.yaml"
GOAL_POSITION = 116
TICKS = 4096 / 360
"""Of a degree"""


@pytest.mark.parametrize("line", COMMANDS)
def test_its_commands_do_what_they_say(dxlrun, tmp_path, monkeypatch, line):
    """What `dxlrun teleop` does then: tests/teleop/test_terminal.py."""
    (tmp_path / "robots").symlink_to(ROOT / "robots")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    words = shlex.split(re.sub(r"/dev/ttyUSB\d", "sim", line))
    if words[0] == "teleop":
        said = dxlrun(*words)
        assert (said.code, said.out) == (1, "")
        assert "no running robot found" in said.err
    else:
        assert dxlrun(*words, "--virtual", "--duration", "0.1", "--no-record").code == 0


def test_an_arm_at_one_port_follows_the_hand_at_the_other():
    robot = simulated_robot(TWO_PORTS, duration_s=4.0)
    leader, _ = robot.buses
    hand_s = 1.0
    leader.at(1_000_000_000, lambda: leader.servo(1).turn_shaft(-0.6, round(hand_s * 1e9)))
    assert robot.run().reason == "ended"
    sent = changes(robot.ledger.entries, robot.plan, GOAL_POSITION)
    assert {*sent} == {3, 4}
    assert not leader.servo(1).torque_on
    moved = sent[3]
    assert moved[-1][1] - 2048 == pytest.approx(34.4 * TICKS, abs=20)  # 0.6 rad
    on_its_way = [at for at, value in moved if 2048 + 5 * TICKS < value < 2048 + 30 * TICKS]
    assert 1.0 < min(on_its_way) < max(on_its_way) < 1.0 + hand_s + 0.25
