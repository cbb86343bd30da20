"""The lines of a case: what is changed of a robot, what happens to it, and proof that it did.

A line may begin with a time, `from 2 s on` or `at 2 s`, and end with `every 0.5 s`. The function behind the
pattern of the rest gets the numbers and words of its groups, and is called when its kind says so.
"""

import re
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import yaml
from tests.analysis.verdicts.rig import JOINTS, MS, S, Story, instead
from tests.kit.line_faults import other_host

from dxlrun.channels.cycle import Torque
from dxlrun.errors import StartUpError
from dxlrun.log.log_reader import Log
from dxlsim.simulation_plan import ServoConfig

Act = Callable[..., Any]
WORDS = {"<n>": r"(-?[\d.]+)", "<joint>": r"((?:left|right|head)_\w+)"}


class Line(NamedTuple):
    pattern: re.Pattern[str]
    attach: Callable[..., object]
    act: Act


LINES: list[Line] = []


def line(pattern: str, attach: Callable[..., object]) -> Callable[[Act], Act]:
    """Let a function be what a line of this pattern does; `attach` brings it into a story."""

    def add(act: Act) -> Act:
        words = re.sub(r"<\w+>", lambda word: WORDS[word[0]], pattern)
        LINES.append(Line(re.compile(words), attach, act))
        return act

    return add


def inject(story: Story, text: str) -> bool:
    """Bring a line into a story; return False where no function reads it."""
    found = re.fullmatch(r"(?:(?:from|at) ([\d.]+) s (?:on )?)?(.*)", text)
    since_s, rest = float(found[1] or 0), found[2]
    joints = [word.strip(",") for word in rest.split() if word.strip(",") in JOINTS]
    for pattern, attach, act in LINES:
        if read := pattern.fullmatch(rest):
            groups = [float(one) if re.fullmatch(r"-?[\d.]+", one or "") else one for one in read.groups()]
            attach(story, text, since_s, joints, lambda *more: act(story, *more, *groups))  # noqa: B023
            return True
    return False


# Kinds of lines: each calls `act` with what it needs to know


def once(story: Story, text: str, since_s: float, joints: list[str], act: Act) -> None:
    """Call it while the case is read: act(story, since_s, ...)."""
    story.evidence[text] += 1
    act(since_s)


def then(story: Story, text: str, since_s: float, joints: list[str], act: Act) -> None:
    """Call it at the time, or before the start: act(story, ...); it returns False if nothing happened."""
    story.evidence[text] += 0

    def happen() -> None:
        story.evidence[text] += act() is not False

    if since_s:
        story.at(since_s, happen, joints[0] if joints else 0)
    else:
        story.prepared.append(happen)


def again(story: Story, text: str, since_s: float, joints: list[str], act: Act) -> None:
    """Call it again and again: act(story, seconds since, ...); it returns False if nothing happened."""
    every = re.search(r" every ([\d.]+) s", text)
    story.evidence[text] += 0

    def happen(t_s: float) -> None:
        story.evidence[text] += act(t_s - since_s) is not False

    story.every(float(every[1]) if every else 0.02, since_s, happen, joints[0] if joints else 0)


def reply(story: Story, text: str, since_s: float, joints: list[str], act: Act) -> None:
    """Change replies of a servo: act(story, ...) gives what becomes of the bytes and a delay, ms, or None."""
    (joint,) = joints

    def before(ids: tuple[int, ...], t_s: float) -> None:
        if story.servo_id(joint) in ids and t_s > since_s and (change := act()) is not None:
            story.evidence[text] += 1
            delay_ns = round(change[1] * MS)
            story.bus(joint).alter_next(story.servo_id(joint), text, change[0], delay_ns=delay_ns)

    story.on_request(joint, before)


def cut(story: Story, text: str, since_s: float, joints: list[str], act: Act) -> None:
    """Cut servos off where act(story, seconds since, joint, ...) says so."""
    for joint in joints or JOINTS:
        story.interrupt(
            joint, text, lambda t_s, joint=joint: t_s >= since_s and bool(act(t_s - since_s, joint))
        )


def arrival(story: Story, text: str, since_s: float, joints: list[str], act: Act) -> None:
    """Change what a bus receives, or all: act(story, seconds since, ID, bytes, ...)."""

    def change(servo_id: int, data: bytes, t_s: float) -> bytes:
        changed = data if t_s < since_s else act(t_s - since_s, servo_id, data)
        story.evidence[text] += changed != data
        return changed

    for bus in range(len(story.spec["buses"])) if "all buses" in text else (joints or [0]):
        story.on_arrival(bus, change)


def wake(story: Story, text: str, since_s: float, joints: list[str], act: Act) -> None:
    """Let the loop wake later by act(story, ...), s; `story.count` is the number of the wake-up."""
    story.stall(text, since_s, act)


def proof(story: Story, text: str, since_s: float, joints: list[str], act: Act) -> None:
    """Call act(story, log, row of the joint, ...) after the run: it returns what has to be true."""

    def check(log: Log) -> None:
        story.evidence[text] += bool(act(log, log.header.joints.index(joints[0]) if joints else 0))

    story.checks.append(check)


# The robot and its motion


@line(r"file ([\w.*]+): (.+)", once)
def change_the_robot_file(story: Story, _: float, path: str, text: str) -> None:
    """Put a value where the path says; a mapping is added to the one that is there, `*` is each entry."""
    *parents, last = path.split(".")
    owners, value = [story.spec], yaml.safe_load(text)
    for name in parents:
        owners = [
            one
            for owner in owners
            for one in (owner.values() if name == "*" else [owner.setdefault(name, {})])
        ]
    for owner in owners:
        owner[last] = owner.get(last, {}) | value if isinstance(value, dict) else value


@line("run for <n> s", once)
def run_longer(story: Story, _: float, seconds: float) -> None:
    story.duration_s = seconds
    story.motion = story.swing()


@line("swing by <n> rad at <n> Hz", once)
def swing_otherwise(story: Story, _: float, amplitude: float, hertz: float) -> None:
    story.motion = story.swing(amplitude, hertz)


@line("swing (<joint>|each joint) by (.+)", once)
def swing_by_a_formula(story: Story, _: float, which: str, joint: str | None, formula: str) -> None:
    story.motion = story.swing(own=dict.fromkeys([joint] if joint else JOINTS, formula))


@line("do not move", once)
def do_not_move(story: Story, _: float) -> None:
    story.motion = None


@line(r"a client asks (\w+) (.+)", once)
def ask(story: Story, at_s: float, kind: str, data: str) -> None:
    story.requests.append((at_s, kind, yaml.safe_load(data)))


@line(r"fault (.+?)(?: on the bus of <joint>| (on each bus))?", once)
def fault(story: Story, _: float, text: str, joint: str | None, each: str | None) -> None:
    """Inject a fault of the simulation: `{JOINT}` is the ID of a joint."""
    if named := re.search(r"\{(\w+)\}", text):
        text, joint = text.replace(named[0], str(story.servo_id(named[1]))), named[1]
    for bus in range(len(story.spec["buses"])) if each else [joint or 0]:
        story.fault(text, bus)


# Replies, instructions and noise


@line("(?:<n> % of the )?replies of <joint> are <n> ms late(?: beyond <n> rad)?", reply)
def late(story: Story, percent: float | None, joint: str, ms: float, angle: float | None) -> Any:
    here = angle is None or story.angle(joint) > angle
    return (bytes, ms) if here and (percent is None or story.happens(percent)) else None


@line("<n> % of the replies of <joint> have a wrong bit", reply)
def flip_bits(story: Story, percent: float, joint: str) -> Any:
    return (partial(flipped, story), 0.0) if story.happens(percent) else None


def flipped(story: Story, data: bytes) -> bytes:
    place = story.random.randrange(2, len(data))
    return data[:place] + bytes((data[place] ^ 1 << story.random.randrange(8),)) + data[place + 1 :]


@line("<n> % of the instructions have a wrong bit", once)
def spoil_instructions(story: Story, since_s: float, percent: float) -> None:
    def spoil(ids: tuple[int, ...], t_s: float) -> None:
        if t_s > since_s and story.happens(percent):
            story.bus(0).alter_next_instruction("spoilt", lambda data: data[:-1] + bytes((data[-1] ^ 4,)))

    story.on_request(0, spoil)


@line("every <n>th reply of <joint> lacks its last <n> bytes", arrival)
def cut_reply(  # noqa: PLR0917  words of a line
    story: Story, _: float, servo_id: int, data: bytes, each: float, joint: str, count: float
) -> bytes:
    is_cut = servo_id == story.servo_id(joint) and next(story.numbers) % each == 0
    return data[: -int(count)] if is_cut else data


@line("(?:bus 0 receives|all buses receive) nothing for <n> s every <n> s", arrival)
def receive_nothing(story: Story, t_s: float, _: int, data: bytes, for_s: float, period_s: float) -> bytes:
    return b"" if t_s % period_s < for_s else data


@line("up to <n> bytes of noise come on the bus of <joint> every <n> s", again)
def noise(story: Story, _: float, most: float, joint: str, period_s: float) -> None:
    data = story.random.randbytes(story.random.randint(1, int(most)))
    story.bus(joint).inject_noise(data, story.bus(joint).now_ns + story.random.randrange(20 * MS))


@line("all buses receive <n> ms late for <n> s every <n> s", once)
def hand_over_late(story: Story, since_s: float, ms: float, for_s: float, period_s: float) -> None:
    def late_ns(now_ns: int) -> int:
        return round(ms * MS) if now_ns > since_s * S and (now_ns / S - since_s) % period_s < for_s else 0

    story.ports_in_python = True
    story.prepared.append(lambda: [story.hold_back(bus, late_ns) for bus in story.virtual.buses])


@line("(?:<joint>(?:, )?)+ (?:is|are) cut off for <n> s every <n> s", cut)
def cut_off(story: Story, t_s: float, joint: str, _: str, for_s: float, period_s: float) -> bool:
    return t_s % period_s < for_s


@line("(?:<joint>(?:, )?)+ are cut off together for 20 to 120 ms at (.+) s", cut)
def cut_off_together(story: Story, t_s: float, joint: str, _: str, times: str) -> bool:
    if not story.moments:
        story.moments = [(one, one + story.random.uniform(0.02, 0.12)) for one in map(float, times.split())]
    return any(begin <= t_s < end for begin, end in story.moments)


@line("every <n>th instruction does not reach <joint>", cut)
def miss_each(story: Story, t_s: float, joint: str, each: float, _: str) -> bool:
    return next(story.numbers) % each == 0


@line(
    "<n> % of the instructions do not reach (?:<joint>|any joint)(?: while it is faster than <n> rad/s)?", cut
)
def miss_some(story: Story, t_s: float, joint: str, percent: float, _: str, speed: float | None) -> bool:
    return (speed is None or abs(story.servo(joint).velocity) > speed) and story.happens(percent)


@line(
    r"another host (?:pings|reads (\w+) of) (<joint>|any joint|the next joint|the next ID) every <n> s"
    r"(, by our adapter)?",
    again,
)
def ask_from_another_host(  # noqa: PLR0917  words of a line
    story: Story, t_s: float, item: str | None, which: str, _: str, period_s: float, own: str | None
) -> None:
    number, bus = next(story.numbers), story.bus(0)
    joint = {"any joint": story.random.choice(JOINTS), "the next joint": JOINTS[number % len(JOINTS)]}
    servo_id = number + 1 if which == "the next ID" else story.servo_id(joint.get(which, which))
    packet = story.wire.ping(servo_id)
    if item:
        entry = bus.servo(servo_id).registers.table.items[item]
        packet = story.wire.read_range(servo_id, entry.address, entry.size)
    other_host(bus, packet, bus.now_ns + story.random.randrange(8 * MS), received=not own)


@line("a spare servo with the ID of <joint> is plugged in", then)
def plug_in_a_twin(story: Story, joint: str) -> None:
    servo = story.servo(joint)
    twin = ServoConfig(servo.servo_id, servo.registers.table.model, servo.shaft_angle + 0.9, 100_000)
    story.bus(joint).add_servo(twin)


# Servos: registers that a servo lacks are passed over, so that one line fits several models


@line("(?:before the start )?<joint> gets (.+)", then)
def set_registers(story: Story, joint: str, values: str) -> bool:
    servo = story.servo(joint)
    own = [entry.split(" = ") for entry in values.split(", ") if entry.split(" = ")[0] in servo.registers]
    for name, value in own:
        servo.poke(name, max(1, servo.registers[name] // 12) if value == "a twelfth" else int(value))
    return bool(own)


@line(r"<joint> shows <n> as ([\w ]+)", then)
def show_a_number(story: Story, joint: str, value: float, items: str) -> bool:
    return show(story, joint, dict.fromkeys(items.split(" or "), lambda: int(value)))


@line(r"<joint> shows the same ([\w, ]+)", then)
def freeze(story: Story, joint: str, items: str) -> bool:
    live = story.servo(joint).registers._live
    return show(
        story, joint, {item: partial(int, live[item]()) for item in items.split(", ") if item in live}
    )


def show(story: Story, joint: str, shown: dict[str, Callable[[], int]]) -> bool:
    servo = story.servo(joint)
    known = {item: value for item, value in shown.items() if item in servo.registers}
    servo.show_live({**servo.registers._live, **known})
    return bool(known)


@line("<joint> never overloads", again)
def never_overload(story: Story, _: float, joint: str) -> None:
    """As a servo whose Shutdown is off: what is seen is the fault itself."""
    shaft = story.servo(joint).shaft
    shaft.mechanics.servos["overloaded"][shaft.index] = 0


@line("<joint> has a bag of <n> Nm to carry", then)
def hang_a_bag(story: Story, joint: str, torque: float) -> None:
    shaft = story.servo(joint).shaft
    plant, index = shaft.mechanics.plant, shaft.index
    plant.joints["gravity"][index], plant.joints["down"][index] = torque, plant.angle[index] - 1.4
    shaft.mechanics._wake()


@line("<joint> warms up by <n> degC a second, from <n> degC to <n> degC", again)
def warm_up(story: Story, t_s: float, joint: str, per_s: float, low: float, high: float) -> None:  # noqa: PLR0917
    story.servo(joint).temperature = min(high, low + per_s * t_s)


@line("the supply of <joint> falls with its load", again)
def sag(story: Story, _: float, joint: str) -> bool:
    servo = story.servo(joint)
    servo.advance_to(story.bus(joint).now_ns)
    servo.voltage = max(10.2, 12.0 - 7.0 * abs(servo.shaft.duty * servo.shaft.current))
    servo.apply_protection()
    return bool(servo.voltage < 10.8)


@line("the battery falls from <n> V to <n> V in <n> s", again)
def run_flat(story: Story, t_s: float, first: float, last: float, in_s: float) -> None:
    for servo in story.bus(0).servos:
        servo.voltage = max(last, first - t_s * (first - last) / in_s)
        servo.apply_protection()


# The loop and the machine


@line("every <n>th wake-up is <n> ms late(?:, after the first <n>)?", wake)
def wake_late(story: Story, each: float, ms: float, first: float | None) -> float:
    return ms / 1000 if next(story.numbers) % each == (first or 0) else 0.0


@line("the machine sleeps for <n> s", wake)
def sleep(story: Story, for_s: float) -> float:
    return for_s if next(story.numbers) == 0 else 0.0


@line("the loop wakes 0.5 to 2.5 periods late in the first <n> s of each second", wake)
def wake_late_each_second(story: Story, for_s: float) -> float:
    is_busy = story.virtual.clock.now_ns() / S % 1.0 < for_s
    return story.random.uniform(0.5, 2.5) / story.kind.rate if is_busy else 0.0


@line("the loop stands still for <n> ms every <n> s", once)
def stand_still(story: Story, since_s: float, ms: float, period_s: float) -> None:
    story.stand_still("still", since_s, round(ms * MS), round(period_s * S))


# Proof, by the log, the ledger and the start


@line(r"proof: (\w+) of <joint> is (above|below) <n>", proof)
def prove_a_bound(  # noqa: PLR0917  words of a line
    story: Story, log: Log, row: int, field: str, _: str, where: str, bound: float
) -> bool:
    values = log.cycles[field][:, row]
    return bool(np.nanmax(values) > bound if where == "above" else np.nanmin(values) < bound)


@line("proof: <joint> is off its goal by <n> rad after <n> s", proof)
def prove_an_error(story: Story, log: Log, row: int, _: str, bound: float, since_s: float) -> bool:
    later = log.cycles[log.cycles["scheduled_ns"] > since_s * S]
    return bool(np.nanmax(np.abs(later["goal_position"][:, row] - later["position"][:, row])) > bound)


@line("proof: after <n> s <joint> stays where it is while its goal moves", proof)
def prove_a_standstill(story: Story, log: Log, row: int, since_s: float, _: str) -> bool:
    later = log.cycles[log.cycles["scheduled_ns"] > since_s * S]
    return len(set(later["position"][:, row].tolist())) == 1 and np.ptp(later["goal_position"][:, row]) > 0.2


@line("proof: the goals of <joint> change by less than <n> rad", proof)
def prove_a_small_motion(story: Story, log: Log, row: int, _: str, most: float) -> bool:
    return bool(0 < np.ptp(log.cycles["goal_position"][:, row]) < most)


@line("proof: <joint> is not read in <n> cycles", proof)
def prove_losses(story: Story, log: Log, row: int, _: str, least: float) -> bool:
    return int((~log.cycles["valid"][:, row]).sum()) >= least


@line("proof: <joint> has no torque at <n> s", proof)
def prove_limpness(story: Story, log: Log, row: int, _: str, at_s: float) -> bool:
    cycle = int(np.searchsorted(log.cycles["scheduled_ns"], at_s * S))
    return int(log.cycles["torque"][cycle, row]) != Torque.ON


@line(r"proof: the ledger notes (\w+) of <joint>", proof)
def prove_a_note(story: Story, log: Log, row: int, note: str, joint: str) -> bool:
    servo, entries = f"servo {story.servo_id(joint)}", story.bus(joint).ledger.entries
    return any(note in one.note and servo in one.note for one in entries)


@line("proof: the start is refused", then)
def prove_a_refusal(story: Story) -> None:
    def refused(run: Act) -> None:
        try:
            run()
        except StartUpError:
            return
        raise AssertionError("it started")

    instead(story.virtual, "run", lambda run: partial(refused, run))
