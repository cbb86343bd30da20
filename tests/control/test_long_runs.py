"""Long runs on an injected clock: the phase, the account of all periods, each controller's own rate, memory.

CI runs a sample; `DXLRUN_CYCLES=1000000 python -m pytest tests/control/test_long_runs.py` runs them whole.
"""

import gc
import os
import random
import sys

import pytest

from dxlrun.control.schedule import MOST_CAUGHT_UP

CYCLES = int(os.environ.get("DXLRUN_CYCLES", "12000"))
RATES = (25.0, 50.0, 100.0, 200.0)


class Grid:
    """The deadlines as arithmetic has them, found again from what the loop says of each cycle."""

    def __init__(self, period_ns):
        self.period_ns = period_ns
        self.before = None

    def judge(self, record, policy, paused):
        """Compare one cycle with the one before, and with when that one ended."""
        if self.before is None:
            self.before = (record.cycle, record.scheduled_ns, record.written_ns, paused)
            return
        cycle, scheduled_ns, written_ns, stood = self.before
        steps = record.cycle - cycle
        assert steps >= 1
        assert record.scheduled_ns == scheduled_ns + steps * self.period_ns, "the phase was lost"
        assert record.skipped == steps - 1
        overdue = max(0, -(-(written_ns - scheduled_ns) // self.period_ns) - 1)  # deadlines that passed
        spared = {MOST_CAUGHT_UP if policy == "catch_up" else 0}
        if stood or paused:
            spared.add(0)  # nobody is late in a pause
        assert record.skipped in {max(0, overdue - most) for most in spared}
        self.before = (record.cycle, record.scheduled_ns, record.written_ns, paused)


@pytest.mark.campaign
@pytest.mark.parametrize("policy", ["skip", "catch_up"])
def test_the_phase_is_kept_exactly_through_overruns_rates_and_pauses(make_robot, policy):
    robot, chance = make_robot(joints=3), random.Random(11)
    seen = {}

    def updated(name):
        seen[name] = []

        def act(controller, step, time_ns, period_ns):
            if step == "update":
                seen[name].append((time_ns, period_ns))
                del seen[name][:-2]
                judge_period(name)

        return act

    def judge_period(name):
        if len(seen[name]) == 2:
            (before_ns, _), (time_ns, period_ns) = seen[name]
            nominal = robot.loop.schedule.period_ns * {"each": 1}.get(name, 0) or rates[name]
            assert 0 < period_ns == min(time_ns - before_ns, 5 * nominal)

    rates = {"half": 80_000_000, "tenth": 200_000_000}  # ns: 12.5 and 5 Hz divide all of RATES
    robot.script("each", updated("each"), joints=("j0",), command=())
    robot.script("half", updated("half"), joints=("j1",), command=(), every=4, rate=12.5)
    robot.script("tenth", updated("tenth"), joints=("j2",), command=(), every=10, rate=5.0)
    robot.build(overrun=policy)
    grid = Grid(robot.plan.period_ns)
    robot.hardware.keep = False
    robot.events.emit = lambda *_: None
    counts = {"cycles": 0, "skipped": 0}

    def append(record):
        grid.judge(record, policy, robot.loop.paused)
        counts["cycles"] += 1
        counts["skipped"] += record.skipped
        grid.period_ns = robot.loop.schedule.period_ns
        assert record.active == 0b111

    def idle(deadline_ns):
        dice = chance.random()
        if dice < 0.002:
            robot.ask("rate", rate=chance.choice(RATES))
        elif dice < 0.004:
            robot.ask("resume" if robot.loop.paused else "pause")
        if counts["cycles"] == CYCLES:
            robot.stop.request()

    robot.sink.append = append
    robot.hardware.idle = idle
    robot.hardware.work_ns = lambda: int(chance.expovariate(1 / 3e7)) if chance.random() < 0.05 else 1000
    result = robot.loop.run()
    assert result.cycles == counts["cycles"] == CYCLES + 1
    assert counts["skipped"] > CYCLES // 200
    assert grid.before[0] + 1 == counts["cycles"] + counts["skipped"]


@pytest.mark.campaign
def test_memory_is_flat_and_nothing_is_collected(make_robot):
    robot = make_robot(joints=4)
    for name in ("a", "b"):
        robot.script(name, lambda *_: None, joints=({"a": "j0", "b": "j1"}[name],))
    robot.build()
    robot.hardware.keep = False
    robot.events.emit = lambda *_: None
    robot.loop.steering.taken = type("Nothing", (), {"take": lambda self, _: None})()
    robot.inbox.answer = lambda number, refusal: None
    marks, cycles = [], max(CYCLES // 10, 4000)

    def append(record):
        cycle = record.cycle
        robot.post("a", "position", b"", 3 * robot.plan.period_ns)
        if cycle % 7 == 0:
            robot.ask("switch", activate=["b"], deactivate=["b"])
        if cycle in (1000, cycles - 1):
            marks.append((sys.getallocatedblocks(), sum(one["collections"] for one in gc.get_stats())))
        if cycle == cycles:
            robot.stop.request()

    robot.sink.append = append
    gc.collect()
    robot.loop.run()
    (early, collected), (late, collected_late) = marks
    assert collected_late == collected
    assert abs(late - early) < 60
