"""What acts on a robot from outside: hands and obstacles, weights, supplies, tools, and what an IMU sees."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from tests.analysis.stranger.kit import S, Story

from dxlrun.simulation.servo.simulated_servo import SimulatedServo


def shove(story: Story, joint: str, torque: Callable[[float, float, float], float], kind: str) -> None:
    """Let a torque (Nm of the joint) act on a joint, by time (s), angle (rad) and velocity (rad/s)."""

    def plan() -> None:
        shaft = story.servo(joint).shaft
        mechanics, index, sign = shaft.mechanics, shaft.index, story.joint(joint)["direction"]
        plant = mechanics.plant
        step = plant.step

        def shoved(drive: Any, damping: Any, dt_s: float) -> None:
            t_s, velocity = mechanics.grid_ns / S, sign * float(plant.velocity[index])
            outside = torque(t_s, story.q(joint), velocity)
            if outside:
                story.evidence[kind] += 1
                drive = drive.copy()
                drive[index] += sign * outside
            step(drive, damping, dt_s)

        plant.step = shoved  # type: ignore[method-assign]

    story.prepared.append(plan)
    # without a goal that changes the mechanics would rest
    story.every(0.02, lambda t_s: story.servo(joint).shaft.mechanics._wake(), joint)


def hard_stop(story: Story, joint: str, highest: float) -> None:
    """Let something stand in the way of a joint above an angle (rad); the other way is free."""

    def plan() -> None:
        shaft, sign = story.servo(joint).shaft, story.joint(joint)["direction"]
        plant, index = shaft.mechanics.plant, shaft.index
        step = plant.step

        def stopped(drive: Any, damping: Any, dt_s: float) -> None:
            step(drive, damping, dt_s)
            beyond = story.q(joint) - highest
            if beyond > 0.0:
                story.evidence["stopped"] += 1
                plant.angle[index] -= sign * beyond
                plant.velocity[index] = 0.0

        plant.step = stopped  # type: ignore[method-assign]

    story.prepared.append(plan)


def carry(story: Story, joint: str, torque_nm: float) -> None:
    """Let a joint carry a weight from now on, or none."""
    shaft = story.servo(joint).shaft
    shaft.mechanics.plant._gravity[shaft.index] = torque_nm
    shaft.mechanics.plant._has_gravity = True
    shaft.mechanics._wake()
    story.evidence["weight changed"] += 1


def poke(story: Story, joint: str, **items: int) -> None:
    """Set those of some registers that a joint's servo has, as a tool would, now."""
    servo = story.servo(joint)
    for name, value in items.items():
        if name in servo.registers:
            servo.poke(name, value)
            story.evidence["registers changed"] += 1


def set_before(story: Story, joint: str, **items: int) -> None:
    """Set those of some registers that a joint's servo has, before the program connects to it."""
    story.prepared.append(lambda: poke(story, joint, **items))


def supply(
    story: Story,
    joint: str | int,
    volts: Callable[[float, SimulatedServo], float | None],
    kind: str,
    since_s: float = 0.9,
) -> None:
    """Give the servos of a joint's bus another voltage (V), by time (s) and servo; None: as it is."""

    def give(t_s: float) -> None:
        for servo in story.bus(joint).servos:
            given = volts(t_s, servo)
            if given is not None:
                story.evidence[kind] += 1
                servo.voltage = given
                servo.protect()

    story.every(0.02, give, joint, since_s)


def voltages_often(story: Story) -> None:
    """Let the voltages be read ten times a second."""
    item = "present_voltage" if story.kind.protocol == 1.0 else "present_input_voltage"
    for bus in story.spec["buses"].values():
        bus["slow_registers"] = {"rate": 10, "items": [item]}


def late_wakes(story: Story, from_s: float, to_s: float, share: float, late_s: tuple[float, float]) -> None:
    """Let a share of the loop's wakes in a part of the run be late, by a time (s) between two."""

    def by_s(number: int) -> float:
        late = story.virtual.clock.now_ns() < to_s * S and story.random.random() < share
        return story.random.uniform(*late_s) if late else 0.0

    story.stall(by_s, from_s)


def noisy_imu(story: Story) -> None:
    """Give the IMU the noise that a real one has."""
    story.spec["sensors"]["gyro"] |= {
        "gyroscope": {"noise_density": 1.0e-3},
        "accelerometer": {"noise_density": 3.0e-3},
    }


def imu_gives(story: Story, change: Callable[[float, np.ndarray[Any, Any]], None]) -> None:
    """Change what the IMU gives, in place, by the time (s)."""

    def plan() -> None:
        sensor = story.virtual.sensors["gyro"]
        read = sensor.read

        def changed(values: Any) -> int:
            t_ns = read(values)
            change(story.now_s(), values)
            return t_ns

        sensor.read = changed  # type: ignore[method-assign]

    story.prepared.append(plan)


def rubs(story: Story, joint: str, friction: Callable[[float, float, float], float], kind: str) -> None:
    """Let a joint have a friction (Nm) by time (s), angle (rad) and speed (rad/s), of its own beside it."""

    def plan() -> None:
        shaft = story.servo(joint).shaft
        mechanics, index, sign = shaft.mechanics, shaft.index, story.joint(joint)["direction"]
        plant, own = mechanics.plant, float(mechanics.plant._friction[shaft.index])
        step = plant.step

        def rubbed(drive: Any, damping: Any, dt_s: float) -> None:
            speed = sign * float(plant.velocity[index])
            more = friction(mechanics.grid_ns / S, story.q(joint), speed)
            story.evidence[kind] += more > 0
            plant._friction[index] = own + more
            step(drive, damping, dt_s)

        plant.step = rubbed  # type: ignore[method-assign]

    story.prepared.append(plan)
    story.every(0.02, lambda t_s: story.servo(joint).shaft.mechanics._wake(), joint)


def transmits(story: Story, joint: str, change: Callable[[float, float], float], kind: str) -> None:
    """Change by the time (s) which torque (Nm of the joint) of a motor arrives at its output."""

    def plan() -> None:
        shaft = story.servo(joint).shaft
        mechanics, index, sign = shaft.mechanics, shaft.index, story.joint(joint)["direction"]
        step = mechanics.plant.step

        def changed(drive: Any, damping: Any, dt_s: float) -> None:
            was = sign * float(drive[index])
            now = change(mechanics.grid_ns / S, was)
            if now != was:
                story.evidence[kind] += 1
                drive = drive.copy()
                drive[index] = sign * now
            step(drive, damping, dt_s)

        mechanics.plant.step = changed  # type: ignore[method-assign]

    story.prepared.append(plan)


def heats(story: Story, joint: str, celsius: Callable[[float], float], *, trips: bool = False) -> None:
    """Let a servo have a temperature (degrees C) by time (s), and trip above its limit if it is to."""
    for bus in story.spec["buses"].values():
        bus["slow_registers"] = {"rate": 4}

    def heat(t_s: float) -> None:
        story.evidence["heated"] += 1
        if trips:
            story.servo(joint).set_temperature(celsius(t_s))
        else:
            story.servo(joint).temperature = celsius(t_s)

    story.every(0.1, heat, joint, 0.5)


def cut_tails(story: Story, joint: str | int, share: float, bytes_left: range, since_s: float) -> None:
    """Let the adapter lose the rest of what it received in a share of the group reads, from a byte on."""
    state: dict[str, int | None] = {"from": None, "got": 0}

    def decide(ids: tuple[int, ...], t_s: float) -> None:
        cut = len(ids) > 1 and t_s > since_s and story.random.random() < share
        state.update({"from": story.random.choice(bytes_left) if cut else None, "got": 0})

    def plan() -> None:
        bus = story.bus(joint)
        take = bus.take

        def short(now_ns: int, *, handed_ns: int | None = None) -> bytes:
            data = take(now_ns, handed_ns=handed_ns)
            begin, cut = state["got"] or 0, state["from"]
            state["got"] = begin + len(data)
            if cut is None or begin + len(data) <= cut:
                return data
            story.evidence["bytes lost"] += begin + len(data) - max(begin, cut)
            if begin <= cut:
                story.evidence["tails cut"] += 1
            return data[: max(0, cut - begin)]

        bus.take = short  # type: ignore[method-assign]

    story.on_request(joint, decide)
    story.prepared.append(plan)
