"""Campaign: the exchange kernel and the packet-by-packet parser on the same lines.

Two robots of equal plans, one read by the kernel, one by the parser alone, get the same bytes at the same
times: replies that are good, cut, stuffed, late, shifted, doubled, foreign or noisy, in one piece or many.
Lines are lost and come back, servos leave the exchange and join it, and idle time is used in between. After
each cycle everything that a run shows is compared: bytes sent, the log, states, ages, what is known of each
servo, events. A stream is the bytes of one line after one read.

    python bench/fuzz_kernel.py 2000000 --seed 1 --processes 2
    python bench/fuzz_kernel.py 200000 --processes 2 --sanitized
    python bench/fuzz_kernel.py 100000 --digests

The last one writes a line for each robot, with the SHA-256 of all that it showed: the same on every machine.
CI runs a seeded sample of it (tests/dynamixel/test_kernel.py).
"""

from __future__ import annotations

import argparse
import hashlib
import math
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count, zip_longest
from operator import itemgetter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from bench.sanitizers import compile_sanitized, sanitizing_environment
from msgspec.structs import replace
from tests.kit.decoded import decode_packets

from dxlrun.channels.cycle import Commands, SourceStates, States
from dxlrun.channels.logged_packets import PacketBatch
from dxlrun.channels.ring import Handover
from dxlrun.dynamixel.dynamixel_hardware import DynamixelHardware, ServoArrays
from dxlrun.dynamixel.servo.life import ServoEvent
from dxlrun.errors import PortError
from dxlwire.bus_plan import BusPlan, DevicePlan
from dxlwire.clock import VirtualClock
from dxlwire.control_table import find_table
from dxlwire.control_table.device_table import read_device_table
from dxlwire.exchange import kernel
from dxlwire.exchange.bus_engine import NEVER, Lines
from dxlwire.modes import Mode
from dxlwire.plan.device_reads import device_blocks
from dxlwire.plan.line import Line as LineTimes
from dxlwire.plan.planning import Wiring, bus_plan
from dxlwire.port.ports import OwnProcessors
from dxlwire.wire import protocol1, protocol2

IDS = (1, 7, 3, 20)
ROBOTS = {
    "single reads": ("AX-12A", 1.0),
    "bulk read": ("MX-28", 1.0),
    "sync read": ("XM430-W350", 2.0),
    "fast sync read": ("XM430-W350", 2.0),
    "single reads beside a bulk read": (("AX-12A", "MX-28"), 1.0),
    "two layouts": (("XM430-W350", "XL-320"), 2.0),
    "bulk read with devices": ("XM430-W350", 2.0),
    "fast bulk read with devices": ("XM430-W350", 2.0),
}
BOARD = """
kind = "device"
model = "board"
protocol = 2.0
capabilities = ["bulk_read", "fast_sync_read", "sync_read"]
fast_sync_read_firmware = 1
[items]
model_number = {address = 0, size = 2}
button = {address = 10, size = 1, bit = 3}
byte = {address = 11, size = 1, encoding = "twos_complement"}
signed = {address = 20, size = 2, encoding = "twos_complement", tick = "-3/7 V", offset = "1 V"}
float = {address = 22, size = 4, encoding = "float32"}
counted = {address = 26, size = 4}
"""
DEVICES = (("signed", "float"), ("counted", "button", "byte", "float"), ("float",))
"""States of the devices of each bus; those of the second one are in two blocks."""
LIBRARY = "DXLRUN_FUZZ_KERNEL"
"""Environment variable: the compiled kernel that is used instead of the installed one."""
PERIOD_NS = 20_000_000
CYCLES = 60
"""Cycles of one robot; the sixth of each six has an accident."""


@dataclass(slots=True)
class Tally:
    """Figures of a campaign."""

    streams: int = 0
    cycles: int = 0
    by_kernel: int = 0
    """Cycles that the kernel read to their end."""
    interrupted: int = 0
    """Cycles that it began and the parser ended."""
    reopened: int = 0
    """Lines that were lost and came back."""


class Line(OwnProcessors):
    """Answers the reads of a cycle in their order with prepared pieces of (ns after it, bytes), and nothing
    else. `replies`: pairs of a read's packet and its pieces, None where the line is lost at that read.
    """

    def __init__(self, clock):
        self.clock = clock
        self.replies, self.arriving, self.sent = [], [], []
        self.stall_ns = 0
        """How long the host pauses after each read."""
        self.lost = False
        """True where the line takes no bytes: its adapter is gone."""

    def write_packet(self, data):
        self.sent.append(bytes(data))
        if self.lost:
            raise PortError("it is gone")
        if not self.replies or self.replies[0][0] != data:
            return
        _, pieces = self.replies.pop(0)
        if pieces is None:
            self.lost = True
            raise PortError("it is gone")
        self.arriving += [(self.clock.now_ns() + at, piece) for at, piece in pieces]
        self.arriving.sort(key=lambda one: one[0])
        self.clock.wait_until(self.clock.now_ns() + self.stall_ns)

    def read_into(self, buffer):
        if not self.ready:
            return 0
        _, data = self.arriving.pop(0)
        buffer[: len(data)] = data
        return len(data)

    def failure(self, code):
        return PortError("it is gone")

    @property
    def ready(self):
        return bool(self.arriving) and self.arriving[0][0] <= self.clock.now_ns()


class LinePorts:
    """Some lines, waited for together."""

    polling = descriptors = functions = None

    def __init__(self, plans):
        self.clock = VirtualClock(1_000_000)
        self.ports = [Line(self.clock) for _ in plans]
        self.back = False
        """True when lines that are lost can be opened again."""

    def wait_for_bytes(self, deadline_ns):
        self.clock.wait_until(min([deadline_ns, *(at for line in self.ports for at, _ in line.arriving)]))
        return [index for index, line in enumerate(self.ports) if line.ready]

    def reopen(self, index):
        if self.back:
            self.ports[index] = Line(self.clock)
        return self.back


class Events:
    """Keeps events."""

    def __init__(self):
        self.list = []

    def emit_event(self, source, event, data=b""):
        self.list.append((source, *event))


class Hardware(DynamixelHardware):
    """Reports when the parser reads."""

    def _parse(self):
        self.parsed()
        super()._parse()


class Side:
    """A robot that is read by the kernel, or by the parser alone."""

    def __init__(self, plans, desk=None, by_parser=False):
        self.lines = LinePorts(plans)
        self.log, self.events = [], Events()
        self.packets = PacketBatch(
            Handover(lambda _, payload: self.log.extend(decode_packets(payload))),
            desk or memoryview(bytearray(1 << 20)),
        )
        count = sum(len(plan.servos) for plan in plans)
        self.states, self.goals = States.empty(count), Commands.empty(count)
        devices = [device for plan in plans for device in plan.devices]
        states = [field for device in devices for block in device.blocks for field in block.fields]
        self.sources = SourceStates.empty(len(devices), len(states))
        lines = Lines(plans, self.lines, self.lines.clock, self.packets)
        arrays = ServoArrays(self.states, self.goals, self.sources)
        self.hardware = Hardware(lines, self.packets, arrays, self.events)
        self.hardware.parsed = self._parsed
        if by_parser:
            self.hardware._kernel.plan = lambda *_: False  # as where it has no room for what is to be read
        for servos in self.hardware._servos:
            for servo in range(len(servos.life.torqued)):
                servos.life.on(servo, ServoEvent.ENGAGED)
                servos.life.on(servo, ServoEvent.TORQUE_ON)
        self.began = self.ended = 0
        """Cycles that the kernel began, and that it read to their end."""

    def _parsed(self):
        self.parsed = True

    def prepare(self):
        """Plan the next cycle; return the reads of each bus, none where it is lost."""
        self._plan_reads()
        found = []
        for bus, servos in self.hardware._pairs:
            if bus.failure is not None:
                found.append([])
                continue
            reads = servos.reads
            found.append([reads._in_length(one.patient, one.group) for one in reads.plan().queue])
        return found

    def change(self, number, row, servo, rng):
        """Change between two cycles what stays for many: modes, torque, limits, servos in the exchange; or
        lose a line.
        """
        self.hardware._look = True
        _, servos = self.hardware._pairs[number]
        losses = [(part, *each) for part in servos._parts for each in enumerate(part._losses)]
        for devices, index, loss in losses:
            if loss is not None and not loss.probing and rng.random() < 0.7:
                devices._take_back(index, loss)
        match rng.randrange(7):
            case 0 | 1:
                plan = self.hardware._lines.plans[number].servos[servo]
                mode = rng.choice([one.mode for one in plan.modes] + [Mode.UNKNOWN])
                servos.goals.set_mode(servo, mode)
                self.states.mode[row] = mode
            case 2:
                if not servos.life.offline(servo):
                    servos.life.on(
                        servo, ServoEvent.DOUBT if servos.life.torqued[servo] else ServoEvent.TORQUE_ON
                    )
            case 3:
                servos.life.ceiling[servo] = rng.choice((math.nan, 0.0, 0.5, 3.0))
            case 4:
                servos.goals.weaken(rng.choice((0.0, 0.3, 1.0)))
            case 5:
                if servos.life.offline(servo):
                    servos.life.on(servo, ServoEvent.RETURNED)
                else:
                    servos.life.lose(servo, NEVER)
            case _:
                if rng.random() < 0.2:
                    self.lines.ports[number].lost = True

    def reopen(self):
        """Open the lines again that are lost; their servos take part at once. Returns how many they were."""
        hardware = self.hardware
        lost = [index for index, bus in enumerate(hardware._buses) if bus.failure is not None]
        self.lines.back = hardware._look = True
        hardware._reopen_lines()
        self.lines.back = False
        for index in lost:
            _, servos = hardware._pairs[index]
            for servo in range(len(IDS)):
                servos.life.on(servo, ServoEvent.RETURNED)
                servos.life.on(servo, ServoEvent.TORQUE_ON)
        return len(lost)

    def _plan_reads(self):
        if self.hardware._by_kernel is None:
            self.hardware._by_kernel = self.hardware._exchange.plan_reads()

    def answer(self, replies):
        """Prepare the replies of the lines to the reads of a cycle."""
        for line, mine in zip(self.lines.ports, replies, strict=True):
            line.replies = list(mine)

    def write(self, goals, idle_ns):
        """Write goals and use the idle time."""
        self.log.clear()
        self.events.list.clear()
        hardware = self.hardware
        for line in self.lines.ports:
            line.sent = []
        self.goals.values[:] = goals
        hardware.write_goals()
        if idle_ns:
            hardware.idle(self.lines.clock.now_ns() + idle_ns)

    def read(self):
        """Read once; return everything that a run shows of the cycle, and the time."""
        hardware, clock = self.hardware, self.lines.clock
        self._plan_reads()
        began, self.parsed = bool(hardware._by_kernel), False
        hardware.read_states()
        self.began += began
        self.ended += began and not self.parsed
        self.packets.commit_packets()
        found = self.found(), clock.now_ns()
        clock.wait_until(clock.now_ns() + PERIOD_NS)
        return found

    def cycle(self, replies, goals, idle_ns=0):
        """Write goals, then read once."""
        self.answer(replies)
        self.write(goals, idle_ns)
        return self.read()

    def found(self):
        """Return everything that a run shows of a cycle, by name."""
        hardware = self.hardware
        return {
            "packets": [
                [packet for packet in self.log if packet.bus == index]
                for index in range(len(hardware._pairs))
            ],
            "sent": [line.sent for line in self.lines.ports],
            "motion": self.states.motion.tobytes(),
            "valid": self.states.valid.tolist(),
            "age": self.states.age_ns.tolist(),
            "sources": (self.sources.values.tobytes(), self.sources.valid.tolist()),
            "source ages": self.sources.age_ns.tolist(),
            "known": [
                (one.reads.missed, one.reads.errors, one.reads.garbled, one.reads.away)
                for one in hardware._servos
            ],
            "torqued": [one.life.torqued.tolist() for one in hardware._servos],
            "failures": [str(bus.failure) for bus in hardware._buses],
            "events": sorted(self.events.list, key=itemgetter(0)),  # in order for each source, as packets are
        }


def replies(transaction, dialect, rng, drift, standing):
    """Return the replies to a read, as servos send them; their data drift, or are anything. `standing`: error
    bytes that stay, by ID.
    """
    error = rng.choice((0x80, 0x20)) if rng.random() < 0.02 else 0
    found = []
    for one in transaction.awaited:
        data = bytes((drift >> 8 * at % 16 & 0xFF) for at in range(one.length))
        if rng.random() < 0.1:
            data = bytes(rng.choices((0xFF, 0xFF, 0xFD, 0x00, 0x00, 0x04, 0x12), k=one.length))
        found.append((one.servo_id, error | standing.get(one.servo_id, 0), data))
    if not transaction.fast:
        return [dialect.status_packet(*one) for one in found]
    size = sum(one.length + 4 for one in transaction.awaited) + 1
    packet = protocol2.HEADER + b"\xfe" + size.to_bytes(2, "little") + b"\x55"
    for servo_id, fault, data in found:
        packet += bytes((fault, servo_id)) + data
        packet += protocol2.crc(packet).to_bytes(2, "little")
    return [packet]


def spoilt(packets, rng):
    """Return the bytes of replies after an accident."""
    match rng.randrange(6):
        case 0:
            packets.pop(rng.randrange(len(packets)))
        case 1:
            packets.insert(rng.randrange(len(packets) + 1), rng.randbytes(rng.randint(1, 20)))
        case 2:
            packets.insert(rng.randrange(len(packets) + 1), rng.choice(packets))
    stream = bytearray(b"".join(packets))
    if stream and rng.random() < 0.6:
        where = rng.randrange(len(stream))
        match rng.randrange(3):
            case 0:
                stream[where] ^= 1 << rng.randrange(8)
            case 1:
                del stream[where : where + rng.randint(1, 4)]
            case _:
                stream[where:where] = rng.randbytes(rng.randint(1, 4))
    return bytes(stream)


def answered(transactions, dialect, rng, accident, standing):
    """Return the replies of a line to each read of a cycle, with an accident in one of them; see `Line`."""
    found = []
    victim = rng.randrange(len(transactions)) if accident and transactions else -1
    drift = rng.randrange(500, 520)
    for number, transaction in enumerate(transactions):
        packets = replies(transaction, dialect, rng, drift, standing)
        stream, at, most = b"".join(packets), 1_500_000, rng.choice((9, 1_000, 1_000))
        if number == victim:
            if rng.random() < 0.03:
                found.append((transaction.packet, None))
                continue
            stream = spoilt(packets, rng)
            at = rng.choice((1_000, 1_500_000, 1_500_000, 9_000_000, 30_000_000))
            most = rng.choice((1, 5, 17, 999))
        pieces = []
        while stream:
            pieces.append((at, stream[:most]))
            stream, at = stream[most:], at + rng.choice((0, 1_000, 100_000))
        found.append((transaction.packet, pieces))
    return found


def robot(name: str, count: int) -> tuple[list[BusPlan], object]:
    """Return the plans of `count` buses that are read in some way, and their dialect."""
    models, protocol = ROBOTS[name]
    models = (models,) if isinstance(models, str) else models
    plans = []
    for number in range(count):
        joints = [
            Wiring(
                joint=f"joint_{number}_{servo_id}",
                row=number * len(IDS) + index,
                servo_id=servo_id,
                table=find_table(models[index % len(models)], protocol),
                reference=math.radians(150),
                direction=1 if index % 2 else -1,
                lower=-2.5,
                upper=2.5,
            )
            for index, servo_id in enumerate(IDS)
        ]
        boards = devices_of(number) if "devices" in name else []
        plan = bus_plan(
            name=f"bus{number}",
            port="sim",
            baud_rate=1_000_000,
            latency_ns=0,
            return_delay_ns=500_000,
            joints=joints,
            protocol=protocol,
            devices=boards,
        )
        fast = name.startswith("fast")
        plans.append(replace(plan, fast=tuple(fast and len(group) > 1 for group in plan.groups)))
    return plans, protocol1 if protocol == 1.0 else protocol2


def devices_of(number):
    """Return the devices of a bus, each with its table."""
    table, found = read_device_table(BOARD), []
    columns = sum(map(len, DEVICES)) * number
    for index, names in enumerate(DEVICES):
        items = {name: table.items[name] for name in names}
        blocks = device_blocks(LineTimes(1_000_000, 0, 500_000, protocol2), table, items, count(columns))
        columns += len(names)
        row = number * len(DEVICES) + index
        found.append((DevicePlan(f"board_{row}", 100 + index, table.model, None, row, blocks), table))
    return found


def moved(goals, rng):
    """Return the goals of the next cycle: some move, some are odd, some are none."""
    goals = goals.copy()
    for row in range(goals.shape[1]):
        if rng.random() < 0.3:
            goals[0, row] = rng.uniform(-3, 3)
        if rng.random() < 0.1:
            goals[1, row] = rng.choice((math.nan, 0.0, -0.0, 1.5, -4.0, 1e300, math.inf))
        if rng.random() < 0.02:
            goals[0, row] = math.nan
    return goals


def difference(found, expected, where):
    """Return what differs of what two robots did in a cycle."""
    lines = [where, f"at {found[1]} and {expected[1]} ns"]
    for name, one in found[0].items():
        other = expected[0][name]
        if name in {"packets", "sent"}:
            for index, (ours, theirs) in enumerate(zip(one, other, strict=True)):
                pairs = zip_longest(ours, theirs)
                lines += [f"{name} of line {index}: {a} instead of {b}" for a, b in pairs if a != b]
        elif one != other:
            lines.append(f"{name}: {one} instead of {other}")
    return "\n".join(lines)


def campaign(
    streams: int, seed: int, names: Sequence[str] = tuple(ROBOTS), digest: Callable[[str], object] = str
) -> Tally:
    """Compare so many streams; raises AssertionError where kernel and parser differ.

    `digest` gets a line for each robot: its seed, the streams until then, and a digest of all that it showed.
    """
    rng, tally = random.Random(seed), Tally()
    kernel.LIBRARY = Path(os.environ.get(LIBRARY, kernel.LIBRARY))
    while tally.streams < streams:
        name, count = rng.choice(names), rng.choice((1, 1, 3))
        plans, dialect = robot(name, count)
        ours, theirs = Side(plans), Side(plans, by_parser=True)
        goals = np.full_like(ours.goals.values, math.nan)
        standing: dict[int, int] = {}
        shown = hashlib.sha256()
        for number in range(CYCLES):
            if number % 12 == 9:
                where, servo, seed_of_change = rng.randrange(count), rng.randrange(len(IDS)), rng.random()
                for side in (ours, theirs):
                    side.change(where, where * len(IDS) + servo, servo, random.Random(seed_of_change))
                standing = {rng.choice(IDS): rng.choice((0x80, 0x04, 0x20))} if rng.random() < 0.2 else {}
            if rng.random() < 0.2:
                theirs.reopen()
                tally.reopened += ours.reopen()
            victim = rng.randrange(count) if number % 6 == 5 else -1
            goals, idle_ns = moved(goals, rng), rng.choice((0, 0, 1_000_000, 5_000_000))
            where = f"{seed} {name} {count} {number}"
            ours.write(goals, idle_ns)
            theirs.write(goals, idle_ns)
            reads, expected = ours.prepare(), theirs.prepare()
            assert reads == expected, f"{where}: {reads} instead of {expected}"
            replies = [
                answered(mine, dialect, rng, index == victim, standing) for index, mine in enumerate(reads)
            ]
            ours.answer(replies)
            theirs.answer(replies)
            found, expected = ours.read(), theirs.read()
            assert found == expected, difference(found, expected, where)
            shown.update(repr(found).encode())
            lost = [bus.failure is not None for bus in ours.hardware._buses]
            tally.streams += sum(len(mine) for mine, gone in zip(replies, lost, strict=True) if not gone)
            tally.cycles += 1
        tally.by_kernel += ours.ended
        tally.interrupted += ours.began - ours.ended
        digest(f"{seed} {tally.streams} {count} {name} {shown.hexdigest()}\n")
    return tally


def main() -> None:
    """Run the campaign, in several processes by seeds that follow each other."""
    parser = argparse.ArgumentParser()
    parser.add_argument("streams", type=int, nargs="?", default=2_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--sanitized", action="store_true", help="with AddressSanitizer and UBSan of gcc")
    parser.add_argument("--digests", action="store_true", help="write what each robot showed")
    chosen = parser.parse_args()
    if chosen.processes == 1 and not chosen.sanitized:
        began = time.monotonic()
        digest = sys.stdout.write if chosen.digests else str
        tally = campaign(chosen.streams, chosen.seed, digest=digest)
        sys.stdout.write(f"seed {chosen.seed}: {tally}, {time.monotonic() - began:.0f} s\n")
        return
    share = -(-chosen.streams // chosen.processes)
    seeds = range(chosen.seed, chosen.seed + chosen.processes)
    command = [sys.executable, __file__, str(share), *["--digests"] * chosen.digests, "--seed"]
    with tempfile.TemporaryDirectory() as folder:
        environment = None
        if chosen.sanitized:
            library = str(compile_sanitized(kernel.SOURCE, Path(folder)))
            environment = {**sanitizing_environment(), LIBRARY: library}
        children = [subprocess.Popen([*command, str(seed)], env=environment) for seed in seeds]
        sys.exit(max(abs(child.wait()) for child in children))


if __name__ == "__main__":
    main()
