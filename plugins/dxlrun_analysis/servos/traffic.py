"""Traffic of each bus and servo: requests, replies, reply times, error bits; by the bytes in the log."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from dxlrun.channels.packets import PacketKind
from dxlrun.dynamixel.port.latency_timer import is_timer
from dxlrun.dynamixel.port.remedies import late_replies
from dxlrun.dynamixel.wire import protocol1, protocol2
from dxlrun.log.reader import Log
from dxlrun.plan.transaction import BROADCAST_ID
from dxlrun_analysis.counts import Counts, median, quantile
from dxlrun_analysis.finding import Finding, cause
from dxlrun_analysis.plan import LoggedBus, plan_of
from dxlrun_analysis.servos.broken_replies import BrokenReplies
from dxlrun_analysis.servos.exchanges import Exchanges, Pairing
from dxlrun_analysis.servos.joint_states import JointStates
from dxlrun_analysis.servos.late_replies import LateReplies
from dxlrun_analysis.servos.losses import Losses, ServoLosses
from dxlrun_analysis.servos.other_host import OtherHosts
from dxlrun_analysis.servos.reply_times import ReplyTime, ReplyTimes, rested, slow_servo
from dxlrun_analysis.servos.requests import IDS, Numbers

_BYTES = 256
LATE_US = 2000  # An adapter that adds so much more than the plan expects is late
_LATE_SHARE = 0.1  # Of the complete exchanges, from which a bus is late
_NOW_AND_THEN = 0.01
_FEWEST_MOMENTS = 10
_FEWEST_SERVOS = 4  # Of so many it is no chance that only one was late
_FEWEST = 20
_FEWEST_ALONE = 10
_OFTEN = 3  # Late replies of a servo from which they are no chance
_KINDS = max(PacketKind) + 1


@dataclass(frozen=True, slots=True)
class ServoTraffic:
    """One servo's traffic over the whole log, set-up and shutdown included."""

    bus: str
    servo_id: int
    joint: str  # Or the device; empty where the log's plan names none
    instructions: int  # Addressed to it alone
    asked: int
    """Pings and reads, also those of several servos at once: what it has to answer at every status return
    level."""
    lost: int
    """Of `asked`, without a status packet of this servo before the bus' next instruction. What is still open
    where the log ends is in neither: its reply may have come a moment later."""
    replies: int  # Status packets, acknowledged writes included
    errors: int  # Replies with any error bit
    error_names: tuple[str, ...]
    reply_median_us: float
    """From before the write() of a ping or read to after the read() of the reply's last byte; in a read of
    several servos at once, those that answer later have the replies before theirs in it."""
    reply_max_us: float
    reply_p99_us: float = 0.0
    own: ReplyTime | None = None  # What of that is its own; None where its replies never came one by one
    losses: ServoLosses | None = None
    """Of `lost`, what is its own and not that of a servo before it in a chain."""
    device: bool = False  # It is a device of the plan, and no servo

    @property
    def subject(self) -> str:
        """What findings accuse: its joint, or its bus and ID."""
        return self.joint or f"{self.bus} {self.servo_id}"


@dataclass(frozen=True, slots=True)
class BusTraffic:
    """One bus over the whole log."""

    name: str
    instructions: int
    broadcasts: int
    replies: int
    noise_bytes: int  # Bytes that belong to no intact packet
    bytes_out: int
    bytes_in: int
    extra_us: float | None = None
    """Median of how much longer than wire and return delay a complete exchange took: what the adapter adds;
    None where the log's plan does not have it, and where replies wait for the next cycle."""
    planned_latency_us: float | None = None  # What the plan expects of that
    port: str = ""
    late_share: float = 0.0
    """Of the exchanges, those that took 2 ms longer than the plan expects, or that were given up too soon:
    a reply came behind the next instruction."""
    late_us: float = 0.0
    """How much longer than wire and return delay three quarters of these took at most: those behind a reply
    that was given up may have waited for several."""


class Traffic:
    """Counts packets, slice by slice of a log, in memory that does not grow with it."""

    def __init__(self, watch: Callable[[Exchanges], None] = lambda _: None) -> None:
        """`watch` is called with all exchanges, too: they are paired once."""
        self._pairing, self._watch = Pairing(), watch
        self._extra_us, self._given_up_us, self._reply_us = Counts(), Counts(), Counts()
        self.findings: tuple[Finding, ...] = ()  # By the rules of this room; known when all is finished
        self._size(0, JointStates())

    def _size(self, buses: int, states: JointStates) -> None:
        self._states, self._losses, self._reply_times = states, Losses(states), ReplyTimes(states)
        self._broken, self._late_replies = BrokenReplies(buses), LateReplies(buses)
        self._others = OtherHosts(buses)
        servos = buses * IDS
        self._packets, self._bytes = (np.zeros((buses, _KINDS), np.int64) for _ in range(2))
        self._late, self._alone = np.zeros((2, 2, servos), np.int64)
        """Of reads of one servo those that were late, and all; behind an exchange, and after a rest."""
        self._instructions, self._asked, self._lost, self._replies, self._reply_max_ns = (
            np.zeros(servos, np.int64) for _ in range(5)
        )
        self._protocol = np.ones(servos, np.int64)
        self._seen = np.zeros(servos, np.bool_)
        self._errors = np.zeros((servos, _BYTES), np.int64)  # By error byte

    def take(self, log: Log) -> None:
        """Count the packets of the next slice. Raises LogError when one cannot be read."""
        if len(self._packets) != len(log.buses):
            self._size(len(log.buses), JointStates(log.buses, log.joints, plan_of(log)))
        packets = log.packets
        if len(packets):
            kind = packets.bus.astype(np.int64) * _KINDS + packets.kind
            shape = self._packets.shape
            self._packets += np.bincount(kind, minlength=self._packets.size).reshape(shape)
            size = np.bincount(kind, packets.length, self._packets.size)
            self._bytes += size.astype(np.int64).reshape(shape)
            sent = packets.kind == PacketKind.INSTRUCTION
            servo = packets.bus[sent].astype(np.int64) * IDS + packets.servo_id[sent]
            self._instructions += np.bincount(servo, minlength=len(self._instructions))
        exchanges = self._pairing.take(log)
        self._states.take(log)
        for event in log.events:
            self._others.writes.failed(event)
        self._count(exchanges)

    def finish(self) -> tuple[tuple[ServoTraffic, ...], tuple[BusTraffic, ...]]:
        """Return the traffic of each servo and of each bus."""
        self._count(self._pairing.finish(), final=True)
        addressed = self._instructions.copy()
        addressed[BROADCAST_ID::IDS] = 0
        servos = np.flatnonzero(self._seen | (addressed > 0)).tolist()
        plans = self._pairing.buses
        own, losses = self._reply_times.finish(plans), self._losses.finish()
        found = tuple(
            replace(
                self._servo(servo), own=own.get(divmod(servo, IDS)), losses=losses.get(divmod(servo, IDS))
            )
            for servo in servos
        )
        buses = tuple(self._bus(index, plan) for index, plan in enumerate(plans))
        findings: list[Finding] = []
        now_and_then = [index for index, bus in enumerate(buses) if not usually_late(bus)]
        together = self._late_replies.together(now_and_then)
        if together:
            findings.append(self._late_replies.everywhere(together, plans))
        for index, (bus, plan) in enumerate(zip(buses, plans, strict=True)):
            findings += self._others.findings(index, plan)
            if self._others.explains(index):
                continue  # what is late, missing or spoilt then is a consequence
            somewhere = tuple(self._reply_times.somewhere(index, plan))
            if index not in together:
                ids = slice(index * IDS, (index + 1) * IDS)
                alone = (self._late[:, ids].sum(axis=0), self._alone[:, ids].sum(axis=0))
                if not somewhere and is_late(bus, len(plan.servos), *alone):
                    findings.append(_late_replies(bus))
                    continue
                findings += somewhere or self._late_replies.findings(index, plan)
            findings += self._reply_times.findings(index, plan)
            if index not in together and not {one.subject for one in findings} & {
                plan.name,
                *plan.names.values(),
            }:
                findings += self._now_and_then(index, bus, plan)
            mine = {each: lost for (of, each), lost in losses.items() if of == index}
            findings += self._broken.findings(index, plan, mine) or self._losses.findings(index, plan, mine)
        self.findings = tuple(findings)
        return found, buses

    def _now_and_then(self, index: int, bus: BusTraffic, plan: LoggedBus) -> Iterable[Finding]:
        """Name the one servo that is late where it is asked alone; else the bus, where that is often."""
        names, moments = plan.names, self._late_replies.moments(index)
        ids = slice(index * IDS, (index + 1) * IDS)
        late, asked = self._late[:, ids], self._alone[:, ids]
        one = int(np.argmax(late.sum(axis=0)))
        mine, others = late[:, one], late.sum(axis=1) - late[:, one]
        # after a rest of the line it is mostly the first of each cycle, with what wakes the adapter
        as_often = mine[1] / max(asked[1, one], 1) * (asked[1].sum() - asked[1, one])
        alone = ((mine >= _OFTEN) & (others == 0) & (np.array([_OFTEN, as_often]) >= _OFTEN)).any()
        if bus.late_share < _NOW_AND_THEN:
            return
        if alone and len(names) >= _FEWEST_SERVOS:
            seen = f"answers late: {mine.sum()} times where it was asked alone, by up to "
            seen += f"{bus.late_us / 1e3:.0f} ms; the others never"
            fix = "Compare its Return Delay Time and firmware with those of the others, and check its supply."
            yield slow_servo(plan, one, seen, bus.late_share, fix)
        elif moments >= _FEWEST_MOMENTS:
            yield cause(
                "late_now_and_then",
                plan.name,
                f"Replies on bus {plan.name} come late now and then: {moments} times, by up to "
                f"{bus.late_us / 1e3:.0f} ms; the log does not show whether it is one servo or the adapter.",
                "Check adapter and USB hub, and what else runs on the machine (`dxlrun doctor`).",
                bus.late_share,
            )

    def _count(self, exchanges: Exchanges | None, *, final: bool = False) -> None:
        if exchanges is None:
            return
        self._watch(exchanges)
        places = self._states.until(int(exchanges.cycle.max(initial=-1)), everything=final)
        self._reply_times.take(exchanges, places)
        self._losses.take(exchanges, places)
        self._broken.take(exchanges)
        self._others.take(exchanges)
        count, due, replies = len(self._asked), exchanges.due, exchanges.replies
        # what is still open where the log ends may have been answered a moment later
        lost = (due.reply < 0) & exchanges.ended[due.exchange]
        for counts, servo in (
            (self._asked, due.servo[(due.reply >= 0) | lost]),
            (self._lost, due.servo[lost]),
            (self._replies, replies.servo),
        ):
            np.add(counts, np.bincount(servo, minlength=count), out=counts)
        self._seen[due.servo] = self._seen[replies.servo] = True
        self._protocol[replies.servo] = replies.protocol  # the last of each counts
        errors = np.bincount(replies.servo * _BYTES + replies.error, minlength=self._errors.size)
        self._errors += errors.reshape(self._errors.shape)
        answers = np.flatnonzero(replies.answers)
        servo, of = replies.servo[answers], replies.exchange[answers]
        took_ns = replies.last_ns[answers] - exchanges.asked_ns[of]
        self._reply_us.take(servo, took_ns // 1000)
        slower = took_ns > self._reply_max_ns[servo]
        np.maximum.at(self._reply_max_ns, servo[slower], took_ns[slower])
        self._extra(exchanges, of, answers)

    def _extra(self, exchanges: Exchanges, of: Numbers, answers: Numbers) -> None:
        """Count how much longer than wire and return delay each complete exchange took."""
        replies, count = exchanges.replies, len(exchanges.request)
        due = exchanges.requests.servos[exchanges.request]
        complete = (np.bincount(of, minlength=count) == due) & (due > 0)
        last = np.zeros(count, np.int64)
        last[of] = answers
        rows = last[complete]
        extra_ns = np.maximum(replies.last_ns[rows] - replies.due_ns[rows], 0)
        self._extra_us.take(exchanges.bus[complete], extra_ns // 1000)
        late = exchanges.late  # of several late replies of an exchange the first one counts
        given_up, first = np.unique(late.exchange, return_index=True)
        given_up, late_ns = given_up[given_up >= 0], late.late_ns[first[given_up >= 0]]
        self._given_up_us.take(exchanges.bus[given_up], late_ns // 1000)
        limits = np.array([bus.latency_ns + LATE_US * 1000 for bus in self._pairing.buses], np.int64)
        in_time = np.flatnonzero(complete)[extra_ns >= limits[exchanges.bus[complete]]]
        self._late_replies.take(exchanges, in_time, replies.last_ns[last[in_time]])
        rows = np.concatenate([in_time, given_up[late_ns >= limits[exchanges.bus[given_up]]]])
        alone, after_rest = np.flatnonzero(due == 1), rested(exchanges).astype(np.int64)
        servo = exchanges.bus * IDS + exchanges.requests.ids[exchanges.request, -1]
        for counts, at in ((self._late, np.intersect1d(rows, alone)), (self._alone, alone)):
            found = np.bincount(after_rest[at] * len(self._asked) + servo[at], minlength=counts.size)
            np.add(counts, found.reshape(counts.shape), out=counts)

    def _servo(self, index: int) -> ServoTraffic:
        bus, servo_id = self._pairing.buses[index // IDS], index % IDS
        names, devices = bus.names, {device.servo_id for device in bus.devices}
        errors = self._errors[index]
        found = {error for error in np.flatnonzero(errors).tolist() if error}
        times = self._reply_us.of(index)
        return ServoTraffic(
            bus=bus.name,
            servo_id=servo_id,
            joint=names.get(servo_id, ""),
            device=servo_id in devices,
            instructions=0 if servo_id == BROADCAST_ID else int(self._instructions[index]),
            asked=int(self._asked[index]),
            lost=int(self._lost[index]),
            replies=int(self._replies[index]),
            errors=int(errors[1:].sum()),
            error_names=error_names(int(self._protocol[index]), found),
            reply_median_us=median(*times),
            reply_max_us=int(self._reply_max_ns[index]) / 1e3,
            reply_p99_us=quantile(*times, 0.99),
        )

    def _bus(self, index: int, plan: LoggedBus) -> BusTraffic:
        packets, size = self._packets[index].tolist(), self._bytes[index].tolist()
        extras = self._extra_us.of(index)
        extra_us = median(*extras)
        known = bool(plan.baud_rate)
        values, counts = (
            np.concatenate(one) for one in zip(extras, self._given_up_us.of(index), strict=True)
        )
        late = values >= plan.latency_ns / 1e3 + LATE_US
        order = np.argsort(values[late])
        total = int(counts.sum())
        share = float(counts[late].sum() / total) if total >= _FEWEST else 0.0
        return BusTraffic(
            name=plan.name,
            instructions=packets[PacketKind.INSTRUCTION],
            broadcasts=int(self._instructions[index * IDS + BROADCAST_ID]),
            replies=packets[PacketKind.STATUS],
            noise_bytes=size[PacketKind.NOISE],
            bytes_out=size[PacketKind.INSTRUCTION],
            bytes_in=size[PacketKind.STATUS] + size[PacketKind.NOISE],
            extra_us=extra_us if known else None,
            planned_latency_us=plan.latency_ns / 1e3 if plan.baud_rate else None,
            port=plan.port,
            late_share=share if known else 0.0,
            late_us=quantile(values[late][order], counts[late][order], 0.75) if known else 0.0,
        )


def usually_late(bus: BusTraffic) -> bool:
    """Return whether half of the exchanges of a bus or more take 2 ms longer than the plan expects."""
    if bus.extra_us is None or bus.planned_latency_us is None:
        return False
    return bus.extra_us >= bus.planned_latency_us + LATE_US


def is_late(bus: BusTraffic, servos: int, late: Numbers, alone: Numbers) -> bool:
    """Return whether the adapter of a bus keeps replies back longer than planned.

    `servos`: how many it has; `late`: how often each was late when it was asked alone, and `alone`: how often
    it was asked so, shape (256,). Where only one of several was late then, or none although as many of
    those replies as of all would be ten, it is a servo, not the adapter.
    """
    if bus.extra_us is None or bus.planned_latency_us is None:
        return False
    if not usually_late(bus) and bus.late_share < _LATE_SHARE:
        return False
    if servos < 2:
        return True
    most = int(np.argmax(late))
    expected = bus.late_share * int(alone.sum() - alone[most])
    if expected >= _FEWEST_ALONE and late.sum() - late[most] < expected / _FEWEST_ALONE:
        return False
    return int(np.count_nonzero(late >= _OFTEN)) != 1


def _late_replies(bus: BusTraffic) -> Finding:
    late_us = (bus.extra_us or 0.0) if usually_late(bus) else bus.late_us
    what, fix = late_replies(bus.name, bus.port, late_us * 1e3, (bus.planned_latency_us or 0.0) * 1e3)
    code = "latency_timer" if is_timer(late_us * 1e3) else "late_replies"
    sentence = f"{what[0].upper()}{what[1:]}."
    remedy = (
        f"{fix}."
        if fix
        else (
            "Check adapter, driver and USB hub; or write what is true: "
            f"`adapter: {{latency: {math.ceil(late_us / 1e3)} ms}}`."
        )
    )
    return cause(code, bus.name, sentence, remedy, bus.late_share)


def error_names(protocol: int, errors: set[int]) -> tuple[str, ...]:
    """Return the names of all errors in these error bytes."""
    if protocol == 1:
        return tuple(_word(bit) for bit in protocol1.StatusError if any(error & bit for error in errors))
    numbers = {error & ~protocol2.ALERT for error in errors}
    names = tuple(_word(number) for number in protocol2.ErrorNumber if number in numbers)
    return (*names, "alert") if any(error & protocol2.ALERT for error in errors) else names


def _word(error: protocol1.StatusError | protocol2.ErrorNumber) -> str:
    return (error.name or "").lower().replace("_", " ")
