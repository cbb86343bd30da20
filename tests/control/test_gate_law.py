"""The compiled gate does what its law in Python does, to the bit."""

from random import Random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.control.gate_law import Joint
from tests.kit.loops import GateRig

from dxlrun.channels.cycle import Torque
from dxlrun.control import gate
from dxlrun.plan.loop_plan import JointPlan
from dxlwire.compiled import load_compiled
from dxlwire.exceptions import NotCompiled
from dxlwire.joint_unit import LINEAR, ROTARY
from dxlwire.modes import Mode

FAR = float("inf")
DT_NS = (1_000_000, 10_000_000, 10_000_000, 600_000_000, 0)


def some_joint(random, number):
    """Return a joint with some limits; most have an acceleration limit."""
    return JointPlan(
        f"j{number}",
        random.choice([-1.0, random.uniform(-3, 0), -FAR]),
        random.choice([1.0, random.uniform(0, 3), FAR]),
        random.choice([None, random.uniform(0.1, 10)]),
        effort=random.choice([None, random.random()]),
        bounded=random.random() < 0.7,
        top_speed=random.choice([None, random.uniform(0.5, 9)]),
        top_effort=random.choice([None, 1.0]),
        acceleration=random.choice([None, random.uniform(0.5, 100), random.uniform(0.5, 100)]),
        unit=LINEAR if random.random() < 0.1 else ROTARY,
    )


def some_command(random, near):
    """Return a number, mostly near another, now and then none or too much."""
    wild = [np.nan, np.nan, FAR, -FAR, 0.0, -0.0, random.uniform(-4, 4)]
    return near + random.gauss(0, 0.05) if random.random() < 0.8 else random.choice(wild)


@settings(max_examples=150, deadline=None)
@given(seed=st.integers(0, 1 << 32), count=st.integers(1, 4), cycles=st.integers(1, 60))
def test_goals_and_what_was_done_are_those_of_the_law(seed, count, cycles):
    random = Random(seed)
    plans = [some_joint(random, number) for number in range(count)]
    rig = GateRig(Mode.UNKNOWN, joints=0, more=plans, eased=False)
    accelerates = any(plan.acceleration is not None for plan in plans)
    modes = [random.choice(list(Mode)) for _ in plans]
    joints = [Joint(plan, Mode.UNKNOWN, np.nan, accelerates) for plan in plans]
    counts = np.zeros((count, 8), np.int64)
    for _ in range(cycles):
        for row, joint in enumerate(joints):
            if random.random() < 0.05:
                modes[row] = random.choice(list(Mode))
            if random.random() < 0.1:
                joint.torque = random.choice([Torque.ON, Torque.ON, Torque.OFF, Torque.RELEASED, Torque.LOST])
            joint.position = some_command(random, joint.position if abs(joint.position) < FAR else 0.0)
            joint.velocity = random.gauss(0, 2)
            near = (joint.goals[0], 1.0, 0.5, 0.5)
            joint.commands = [some_command(random, one if abs(one) < FAR else 0.0) for one in near]
        rig.states.position[:] = [joint.position for joint in joints]
        if [joint.mode for joint in joints] != modes:
            for joint, mode in zip(joints, modes, strict=True):
                joint.enter(mode)
        rig.states.mode[:] = modes
        rig.states.torque[:] = [joint.torque for joint in joints]
        rig.states.velocity[:] = [joint.velocity for joint in joints]
        dt_ns = random.choice(DT_NS)
        commands = np.array([joint.commands for joint in joints]).T
        rig.record.reset_counts()
        rig.cycle(dt_ns, commands)
        passes = [joint.begin(dt_ns) for joint in joints]
        for joint in joints:
            joint.end(all(passes))
        counts += [[int(joint.clamped) >> bit & 1 for bit in range(8)] for joint in joints]
        assert rig.record.clamped.tolist() == [joint.clamped for joint in joints]
        goals = np.array([joint.goals for joint in joints]).T
        assert np.nan_to_num(rig.goals.values, nan=9e9).tobytes() == np.nan_to_num(goals, nan=9e9).tobytes()
        assert rig.gate.counts.tolist() == counts.tolist()


def test_a_gate_of_another_source_is_not_used(tmp_path, monkeypatch):
    (tmp_path / "gate.c").write_text("int changed;")
    with pytest.raises(NotCompiled, match=r"^the compiled gate is missing; install dxlrun again"):
        load_compiled(tmp_path / "gate.c", gate.ctypes.PyDLL)
    (tmp_path / "libgate.so").write_bytes(gate.SOURCE.with_name("libgate.so").read_bytes())
    with pytest.raises(NotCompiled, match=r"^the compiled gate does not match gate\.c"):
        load_compiled(tmp_path / "gate.c", gate.ctypes.PyDLL)
