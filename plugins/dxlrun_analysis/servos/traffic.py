"""Traffic of each bus and servo over a run: numbers of requests and replies, reply times, error bits.

Everything is computed from the bytes of the packets in the log.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dxlrun import Log
from dxlrun_analysis.counts import Counts, median, quantile
from dxlrun_analysis.finding import Finding
from dxlrun_analysis.plan_excerpt import LoggedBus, plan_of
from dxlrun_analysis.servos.broken_replies import BrokenReplies
from dxlrun_analysis.servos.exchanges import Exchanges, Pairing
from dxlrun_analysis.servos.joint_states import JointStates
from dxlrun_analysis.servos.logged_requests import IDS
from dxlrun_analysis.servos.losses import Losses, ServoLosses
from dxlrun_analysis.servos.other_host import OtherHosts
from dxlrun_analysis.servos.reply_times import ReplyTimes
from dxlwire import BROADCAST_ID, PacketKind, protocol1, protocol2


@dataclass(frozen=True, slots=True)
class ServoTraffic:
    """Requests, replies, reply times and error bits of one servo or device over the whole log."""

    bus: str
    servo_id: int
    joint: str  # Joint or device; empty if the log's plan names none
    instructions: int  # Instructions addressed to it alone
    asked: int
    """Number of pings and reads of the servo, including those of several servos: the requests that it
    answers at every status return level."""
    lost: int
    """Number of those requests that this servo did not answer before the next instruction on the bus. A
    request that is open at the end of the log is in neither count, as its reply may have come later."""
    replies: int  # Status packets, acknowledged writes included
    errors: int  # Replies with any error bit
    error_names: tuple[str, ...]
    reply_median_us: float
    """Median reply time: from before the write() of a ping or read to after the read() of the reply's last
    byte. In a read of several servos it includes the preceding replies."""
    reply_max_us: float
    reply_p99_us: float = 0.0
    losses: ServoLosses | None = None
    """Missing replies that are its own, not due to a servo before it; None if it was never asked."""
    device: bool = False  # A device of the plan, not a servo

    @property
    def subject(self) -> str:
        """Name with which findings accuse the servo: its joint or device, or its bus and ID."""
        return self.joint or f"{self.bus} {self.servo_id}"


@dataclass(frozen=True, slots=True)
class BusTraffic:
    """Packets and bytes of one bus over the whole log, and the latency of its adapter."""

    name: str
    instructions: int
    broadcasts: int
    replies: int
    noise_bytes: int  # Bytes that belong to no intact packet
    bytes_out: int
    bytes_in: int
    extra_us: float | None = None
    """Measured latency of the adapter: median time of a complete exchange beyond wire time and return
    delay. None if the log's plan lacks the bus."""
    planned_latency_us: float | None = None  # Planned value of `extra_us`
    port: str = ""


class Traffic:
    """Accumulator of the traffic of all buses and servos, fed slice by slice in constant memory."""

    def __init__(self, watch: Callable[[Exchanges], None] = lambda _: None) -> None:
        """Create the accumulator.

        Args:
            watch: Function that also receives the paired packets, so that packets are paired only once.
        """
        self._pairing, self._watch = Pairing(), watch
        self._extra_us, self._reply_us = Counts(), Counts()
        self.findings: tuple[Finding, ...] = ()  # Findings of this room's rules; complete after `finish`
        self._size(0, JointStates())

    def _size(self, buses: int, states: JointStates) -> None:
        self._states, self._losses, self._reply_times = states, Losses(states), ReplyTimes(buses)
        self._broken, self._others = BrokenReplies(buses), OtherHosts(buses)
        self._asked, self._lost = np.zeros((2, buses * IDS), np.int64)
        self._seen = np.zeros(buses * IDS, np.bool_)

    def add_slice(self, log: Log) -> None:
        """Count the packets of the next slice of the log.

        Raises:
            LogError: A packet cannot be read.
        """
        if len(self._seen) != len(log.buses) * IDS:
            self._size(len(log.buses), JointStates(log.buses, log.joints, plan_of(log)))
        exchanges = self._pairing.pair_packets(log)
        self._states.add_states(log)
        for event in log.events:
            self._others.writes.add_failure(event)
        self._count(exchanges)

    def summarize_traffic(self) -> tuple[tuple[ServoTraffic, ...], tuple[BusTraffic, ...]]:
        """Return the traffic of each servo and of each bus, and complete `findings`."""
        self._count(self._pairing.pair_remaining(), final=True)
        counts = self._pairing.counts
        addressed = counts.instructions > 0
        addressed[BROADCAST_ID::IDS] = False
        servos = np.flatnonzero(self._seen | addressed | (counts.replies > 0)).tolist()
        plans = self._pairing.buses
        losses = self._losses.count_losses()
        found = tuple(replace(self._servo(servo), losses=losses.get(divmod(servo, IDS))) for servo in servos)
        self.findings = tuple(self._findings(plans, losses))
        return found, tuple(self._bus(index, plan) for index, plan in enumerate(plans))

    def _findings(
        self, plans: Sequence[LoggedBus], losses: Mapping[tuple[int, int], ServoLosses]
    ) -> Iterator[Finding]:
        """Report problems with replies: first those that several buses share, then bus by bus. Later rules
        of a bus are omitted if an earlier one explains their symptoms."""
        occasions = self._losses.occasions(self._reply_times.always_late())
        shared, are_late = occasions.together()
        yield from occasions.machine(plans, self._reply_times.longest_ms())
        for index, plan in enumerate(plans):
            yield from self._others.findings(index, plan)
            if self._others.explains(index):
                continue  # Late, missing or broken replies are then a consequence
            alone = not (are_late and index in shared)
            slow = tuple(self._reply_times.servos(index, plan, now_and_then=alone))
            yield from slow
            if alone:
                late = tuple(self._reply_times.line(index, plan, [one.subject for one in slow]))
                yield from late
                if late:
                    continue
            mine = {each: lost for (of, each), lost in losses.items() if of == index}
            spoilt = tuple(self._broken.findings(index, plan, mine))
            yield from spoilt
            if "noise" not in {one.code for one in spoilt}:
                named = {one.subject for one in (*slow, *spoilt)}
                explained = {servo for servo, name in plan.names.items() if name in named}
                yield from occasions.loss_findings(index, plan, mine, explained)

    def _count(self, exchanges: Exchanges | None, *, final: bool = False) -> None:
        if exchanges is None:
            return
        self._watch(exchanges)
        places = self._states.until(int(exchanges.cycle.max(initial=-1)), everything=final)
        self._losses.add_exchanges(exchanges, places)
        complete = exchanges.complete()
        self._reply_times.add_exchanges(exchanges, complete, self._losses)
        self._broken.add_exchanges(exchanges)
        self._others.add_exchanges(exchanges)
        count, due, replies = len(self._asked), exchanges.due, exchanges.replies
        # A request that is open at the end of the log may have been answered later.
        ended = exchanges.ended[due.exchange[due.missing]]
        asked = exchanges.count_due(exchanges.times)
        self._seen |= asked > 0
        self._asked += asked - np.bincount(due.servo[due.missing[~ended]], minlength=count)
        self._lost += np.bincount(due.servo[due.missing[ended]], minlength=count)
        self._reply_us.count_values(np.where(replies.answers, replies.servo, -1), replies.took_us)
        rows, extra_ns = complete
        self._extra_us.count_values(exchanges.bus[rows], np.maximum(extra_ns, 0) // 1000)

    def _servo(self, index: int) -> ServoTraffic:
        bus, servo_id = self._pairing.buses[index // IDS], index % IDS
        names, devices = bus.names, {device.servo_id for device in bus.devices}
        counts = self._pairing.counts
        errors = counts.errors[index]
        found = set(np.flatnonzero(errors).tolist())
        times = self._reply_us.counts_of(index)
        return ServoTraffic(
            bus=bus.name,
            servo_id=servo_id,
            joint=names.get(servo_id, ""),
            device=servo_id in devices,
            instructions=0 if servo_id == BROADCAST_ID else int(counts.instructions[index]),
            asked=int(self._asked[index]),
            lost=int(self._lost[index]),
            replies=int(counts.replies[index]),
            errors=int(errors.sum()),
            error_names=error_names(int(counts.protocol[index]), found),
            reply_median_us=median(*times),
            reply_max_us=int(counts.longest_ns[index]) / 1e3,
            reply_p99_us=quantile(*times, 0.99),
        )

    def _bus(self, index: int, plan: LoggedBus) -> BusTraffic:
        counts = self._pairing.counts
        packets, size = counts.packets[index].tolist(), counts.bytes[index].tolist()
        return BusTraffic(
            name=plan.name,
            instructions=packets[PacketKind.INSTRUCTION],
            broadcasts=int(counts.instructions[index * IDS + BROADCAST_ID]),
            replies=packets[PacketKind.STATUS],
            noise_bytes=size[PacketKind.NOISE],
            bytes_out=size[PacketKind.INSTRUCTION],
            bytes_in=size[PacketKind.STATUS] + size[PacketKind.NOISE],
            extra_us=median(*self._extra_us.counts_of(index)) if plan.baud_rate else None,
            planned_latency_us=plan.latency_ns / 1e3 if plan.baud_rate else None,
            port=plan.port,
        )


def error_names(protocol: int, errors: set[int]) -> tuple[str, ...]:
    """Return the names of all errors that occur in a set of error bytes; `protocol` is 1 or 2."""
    if protocol == 1:
        return tuple(_word(bit) for bit in protocol1.StatusError if any(error & bit for error in errors))
    numbers = {error & ~protocol2.ALERT for error in errors}
    names = tuple(_word(number) for number in protocol2.ErrorNumber if number in numbers)
    return (*names, "alert") if any(error & protocol2.ALERT for error in errors) else names


def _word(error: protocol1.StatusError | protocol2.ErrorNumber) -> str:
    return (error.name or "").lower().replace("_", " ")
