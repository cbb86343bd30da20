"""What acts on a robot from outside: hands and obstacles, weights, supplies, tools, and what an IMU sees."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import numpy as np
from msgspec.structs import replace
from tests.analysis.stranger.kit import ARMS, JOINTS, MS, S, Spec, Story, instead

from dxlrun.simulation.servo.simulated_servo import SimulatedServo


def _drives(story: Story, joint: str, change: Callable[[float, float, float], float]) -> None:
    """Change what drives a joint: `change` gets that (Nm of the joint), time (s) and speed (rad/s)."""

    def changes(step: Callable[[Any, Any, float], None]) -> Callable[[Any, Any, float], None]:
        shaft = story.servo(joint).shaft
        mechanics, index, sign = shaft.mechanics, shaft.index, story.joint(joint)["direction"]

        def changed(drive: Any, damping: Any, dt_s: float) -> None:
            was, speed = sign * float(drive[index]), sign * float(mechanics.plant.velocity[index])
            now = change(was, mechanics.grid_ns / S, speed)
            if now != was:
                drive = drive.copy()
                drive[index] = sign * now
            step(drive, damping, dt_s)

        return changed

    story.prepared.append(lambda: instead(story.servo(joint).shaft.mechanics.plant, "step", changes))


def _stays_awake(story: Story, joint: str) -> None:
    """Keep the mechanics of a joint going, which would rest without a goal that changes."""
    story.every(0.02, lambda t_s: story.servo(joint).shaft.mechanics._wake(), joint)


def shove(story: Story, joint: str, torque: Callable[[float, float, float], float], kind: str) -> None:
    """Let a torque (Nm of the joint) act on a joint, by time (s), angle (rad) and velocity (rad/s)."""

    def shoved(drive: float, t_s: float, velocity: float) -> float:
        outside = torque(t_s, story.q(joint), velocity)
        story.evidence[kind] += outside != 0.0
        return drive + outside

    _drives(story, joint, shoved)
    _stays_awake(story, joint)


def hard_stop(story: Story, joint: str, highest: float) -> None:
    """Let something stand in the way of a joint above an angle (rad); the other way is free."""

    def stops(step: Callable[[Any, Any, float], None]) -> Callable[[Any, Any, float], None]:
        shaft, sign = story.servo(joint).shaft, story.joint(joint)["direction"]
        plant, index = shaft.mechanics.plant, shaft.index

        def stopped(drive: Any, damping: Any, dt_s: float) -> None:
            step(drive, damping, dt_s)
            beyond = story.q(joint) - highest
            if beyond > 0.0:
                story.evidence["stopped"] += 1
                plant.angle[index] -= sign * beyond
                plant.velocity[index] = 0.0

        return stopped

    story.prepared.append(lambda: instead(story.servo(joint).shaft.mechanics.plant, "step", stops))


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

    def changed(read: Callable[[Any], int], values: Any) -> int:
        t_ns = read(values)
        change(story.now_s(), values)
        return t_ns

    imu_reads(story, changed)


def imu_reads(story: Story, given: Callable[[Callable[[Any], int], Any], int]) -> None:
    """Let `given` read the IMU: it gets how it is read and the values to fill, and returns their time, ns."""
    story.prepared.append(
        lambda: instead(story.virtual.sensors["gyro"], "read", lambda read: partial(given, read))
    )


def rubs(story: Story, joint: str, friction: Callable[[float, float, float], float], kind: str) -> None:
    """Let a joint have a friction (Nm) by time (s), angle (rad) and speed (rad/s), of its own beside it."""

    own: list[float] = []

    def rubbed(drive: float, t_s: float, speed: float) -> float:
        shaft = story.servo(joint).shaft
        plant, more = shaft.mechanics.plant, friction(t_s, story.q(joint), speed)
        own[:] = own or [float(plant._friction[shaft.index])]
        story.evidence[kind] += more > 0
        plant._friction[shaft.index] = own[0] + more
        return drive

    _drives(story, joint, rubbed)
    _stays_awake(story, joint)


def transmits(story: Story, joint: str, change: Callable[[float, float], float], kind: str) -> None:
    """Change by the time (s) which torque (Nm of the joint) of a motor arrives at its output."""

    def changed(drive: float, t_s: float, speed: float) -> float:
        now = change(t_s, drive)
        story.evidence[kind] += now != drive
        return now

    _drives(story, joint, changed)


def read_slowly(story: Story, hertz: int = 4) -> None:
    """Let temperatures and voltages be read some times a second."""
    for bus in story.spec["buses"].values():
        bus["slow_registers"] = {"rate": hertz}


def heats(story: Story, joint: str, celsius: Callable[[float], float], *, trips: bool = False) -> None:
    """Let a servo have a temperature (degrees C) by time (s), and trip above its limit if it is to."""
    read_slowly(story)

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

    def shorten(take: Callable[..., bytes]) -> Callable[..., bytes]:
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

        return short

    story.on_request(joint, decide)
    story.prepared.append(lambda: instead(story.bus(joint), "take", shorten))


def stream_to_arms(story: Story, lease_ms: int, goals: Iterable[tuple[float, list[float]]]) -> None:
    """Let a client stream goals (rad) at times (s) to a controller of the arms, each with a lease."""
    controllers = story.spec["controllers"]
    controllers["body"]["joints"] = [joint for joint in JOINTS if joint not in ARMS]
    controllers["arms"] = {"type": "joint_group_position_controller", "joints": list(ARMS)}
    story.motion = story.swing()
    story.asks += [(t_s, "arms", "positions", {"positions": goal}) for t_s, goal in goals]

    def lease() -> None:
        asks = story.virtual.robot.loop.steering.inbox._asks
        for place, (at_s, command) in enumerate(asks):
            asks[place] = (at_s, replace(command, lease_ns=lease_ms * MS))

    story.prepared.append(lease)


def foot_board(story: Story) -> None:
    """Give the robot a board in its foot whose four forces tremble by some steps."""
    if story.kind.protocol == 1.0:
        model, middle, noise = "OP-FSR", 4.0, 0.02
        cells = [f"force.{number}" for number in range(1, 5)]
    else:
        model, middle, noise = "bitbots-foot", 80_000.0, 400.0
        cells = [f"pressure.{side}_{end}" for side in ("left", "right") for end in ("front", "back")]
    forces: Spec = {
        "values": {cell: middle * (1 + 0.1 * place) for place, cell in enumerate(cells)},
        "noise": dict.fromkeys(cells, noise),
    }
    story.spec["devices"] = {"foot": {"bus": "main", "id": 101, "model": model, "simulation": forces}}
