"""What the MX of Protocol 1.0 have beside an AX: turns that count, a goal for the torque, a clock."""

from __future__ import annotations

import math

import pytest

from dxlrun.simulation.wire.protocol1 import ErrorBit


def low_high(value: int) -> tuple[int, int]:
    return value & 0xFF, value >> 8


def test_goals_of_multi_turn_mode_count_turns(make_line):
    line = make_line((1,), "MX-28")
    assert line.write(1, 6, *low_high(4095), *low_high(4095)) == 0
    goals = (28_672, 28_673, -28_672 & 0xFFFF, -28_673 & 0xFFFF)
    errors = [line.write(1, 30, *low_high(goal)) for goal in goals]
    assert errors == [0, ErrorBit.RANGE, 0, ErrorBit.RANGE]
    assert line.read(1, 30, 2) == goals[2]
    line.servo().turn_by_hand(-3.0)
    assert line.read(1, 36, 2) == pytest.approx((1 << 16) - 3.0 / math.tau * 4096, abs=2)


def test_goal_torque_cannot_be_bigger_than_torque_limit(make_line):
    line = make_line((1,), "MX-64")
    assert line.write(1, 34, *low_high(500)) == 0
    errors = [line.write(1, 71, *low_high(torque)) for torque in (500, 501, 1024 + 500, 1024 + 501)]
    assert errors == [0, ErrorBit.RANGE, 0, ErrorBit.RANGE]


def test_an_mx_counts_milliseconds_from_its_power_up(make_line):
    line = make_line((1,), "MX-28")
    first = line.read(1, 50, 2)
    line.clock.wait_until(line.clock.now_ns() + 2_000_000_000)
    assert line.read(1, 50, 2) - first == pytest.approx(2010, abs=1)
    line.servo().reset()
    assert line.read(1, 50, 2) < 10
    line.clock.wait_until(line.clock.now_ns() + 32_768_000_000)
    assert line.read(1, 50, 2) < 50
