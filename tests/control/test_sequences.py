"""Random sequences of steering: what is never allowed to happen, whatever a client asks for."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit.campaigns import campaign
from tests.kit.loops import PERIOD_NS, Robot

NAMES = ("a", "b", "c", "d", "none_such")
JOINTS = {"a": ("j0",), "b": ("j1", "j2"), "c": ("j0", "j1", "j2"), "d": ("j2",), "x": ("j0",), "y": ("j1",)}

names = st.one_of(
    st.sampled_from([(), ("a",), ("b",), ("c",), ("d",), ("a", "b"), ("b", "d")]),
    st.lists(st.sampled_from(NAMES), max_size=3),
)
switches = st.builds(lambda on, off: ("switch", {"activate": on, "deactivate": off}), names, names)
rates = st.sampled_from([25.0, 50.0, 100.0, 75.0, 0.0, -1.0, 1e9]).map(lambda rate: ("rate", {"rate": rate}))
plain = st.sampled_from(["pause", "resume", "stop?", ""]).map(lambda kind: (kind, {}))
loads = st.sampled_from(["x", "y"]).map(lambda name: ("load", {"name": name}))
unloads = st.sampled_from(["a", "x", "y"]).map(lambda name: ("unload", {"controller": name}))
commands = st.builds(
    lambda name, lease: ("command", {"name": name, "lease": lease}), st.sampled_from(NAMES), st.integers(0, 3)
)
waits = st.integers(1, 4).map(lambda cycles: ("wait", {"cycles": cycles}))
lates = st.integers(1, 40).map(lambda quarters: ("late", {"ns": quarters * PERIOD_NS // 4}))
fails = st.sampled_from(["update", "activate", "command"]).map(lambda step: ("fail", {"step": step}))
sequences = st.lists(
    st.one_of(switches, switches, rates, plain, loads, unloads, commands, waits, lates, fails),
    min_size=5,
    max_size=25,
)


class Run:
    """One robot whose controllers write their own mark, so that a goal tells what commanded it."""

    def __init__(self, overrun):
        self.robot = robot = Robot(joints=3)
        self.failing = ""  # the step in which c breaks its contract from now on
        self.broken = False  # c did so in this cycle
        self.late_ns = 0
        self.times = {}
        self.wrong = []  # what was told a time before the one that it had been told
        for mark, name in enumerate("abcd", start=1):
            rate = 25.0 if name == "b" else None
            fallback = "d" if name == "c" else ""
            robot.script(
                name,
                self.writer(mark, name),
                joints=JOINTS[name],
                active=name in "ab",
                every=2 if rate else 1,
                rate=rate,
                fallback=fallback,
            )
        robot.build(overrun=overrun)
        robot.hardware.work_ns = self.work
        self.updated = set()

    def writer(self, mark, name):
        def act(controller, step, time_ns, value):
            if name == "c" and step == self.failing:
                self.broken = True
                raise RuntimeError("lost its way")
            own = controller.context.name
            if time_ns < self.times.get(own, 0) or (step == "update" and value < 0):
                self.wrong.append((own, step, time_ns, value))  # what is raised here would be its fault
            self.times[own] = time_ns
            if step == "update":
                self.updated.add(own)
                controller.context.commands.position[:] = mark / 100
                controller.context.commands.velocity[:] = 1.0

        return act

    def work(self):
        """Return how long this read takes, ns."""
        late_ns, self.late_ns = self.late_ns, 0
        return late_ns

    def steps(self, sequence):
        """Give one operation a cycle to the loop; after each cycle, look at what may never be."""
        todo = list(sequence)
        waiting = 0
        for kind, data in todo:
            waiting += data.get("cycles", 1)
            yield kind, data
            for _ in range(data.get("cycles", 1) - 1):
                yield "", {}
        for _ in range(3):
            yield "", {}

    def run(self, sequence):
        robot, steps = self.robot, self.steps(sequence)

        def idle(deadline_ns, time_ns):
            self.updated.clear()
            self.broken = False
            kind, data = next(steps, ("end", {}))
            if kind == "end":
                robot.stop.request()
            elif kind == "fail":
                self.failing = data["step"]
            elif kind == "late":
                self.late_ns = data["ns"]
            elif kind == "command":
                robot.post(data["name"], "position", b"", data["lease"] * PERIOD_NS)
            elif kind == "load":
                name = data["name"]
                both = ("position", "velocity")
                robot.loads(name, type={"x": "a", "y": "d"}[name], joints=JOINTS[name], command=both)()
            elif kind:
                robot.ask(kind, **data)

        robot.hardware.idle = idle
        append = robot.sink.append_cycle
        robot.sink.append_cycle = lambda record: (append(record), self.judge(record))
        return robot.loop.run()

    def judge(self, record):
        manager = self.robot.manager
        active = manager.active
        assert record.active == sum(manager._named[name]._bit for name in active)
        claimed = [joint for name in active for joint in JOINTS[name]]
        assert len(claimed) == len(set(claimed)), "two controllers have one joint"
        assert self.updated <= set(active) | self.ended(), "an inactive controller was updated"
        marks = {round(value * 100) for value in record.commands.position if np.isfinite(value)}
        allowed = {{"a": 1, "b": 2, "c": 3, "d": 4, "x": 1, "y": 4}[name] for name in active}
        assert marks <= allowed, "the robot was commanded by a controller that is not active"
        if self.robot.loop.steering.paused:
            assert not marks
            assert not self.updated

    def ended(self):
        """Return what was ended by its fault in this very cycle."""
        return {"c"} if self.broken else set()


@campaign(ci=60, night=1000, release=10_000)
@settings(deadline=None)
@given(sequence=sequences, overrun=st.sampled_from(["skip", "catch_up", "stop"]))
def test_only_active_controllers_command_and_each_joint_has_one(sequence, overrun):
    run = Run(overrun)
    result = run.run(sequence)
    asked, answered = run.robot._asked, run.robot.refusals
    assert len(answered) + len(run.robot.inbox.waiting) == asked
    cycles = run.robot.sink.cycles
    assert result.cycles == len(cycles)
    assert result.cycles + result.skipped == run.robot.loop.schedule.cycle
    assert not run.wrong, "time went back"
    due = [cycle["scheduled_ns"] for cycle in cycles]
    assert due == sorted(set(due))
