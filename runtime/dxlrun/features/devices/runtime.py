"""Runtime of the devices on one bus: drops silent devices from the reads, probes them, writes commands.

A device that does not answer leaves the cyclic reads at once, so that its timeouts do not delay the servos.
It is then probed in idle time: in every cycle until it counts as lost, then once a second.
"""

from __future__ import annotations

import math

import msgspec
from msgspec.structs import replace

from dxlrun.channels.cycle import LOST_AGE_NS, LOST_CYCLES
from dxlrun.channels.event_records import EventBody
from dxlrun.dynamixel.bus_part import BusContext, BusStage
from dxlrun.features.devices import texts
from dxlrun.features.devices.device_checks import inspect_device, survey_devices
from dxlrun.features.devices.plan import DeviceCommand, decode_devices
from dxlwire.bus_plan import DevicePlan
from dxlwire.exchange.cyclic_reads import MOST_BROKEN
from dxlwire.exchange.idle import Urgency
from dxlwire.plan.line import Line
from dxlwire.plan.planning import plan_line
from dxlwire.transaction import Program, Transaction, TransactionOutcome
from dxlwire.wire.dialect import dialect_of

PROBE_NS = 1_000_000_000
"""Time between two probes of a device that counts as lost, ns, as for a servo (failures.md)."""
REPEAT_NS = 1_000_000_000
"""Time after which an unchanged command is written again, ns: the device may have rebooted unnoticed."""


class _Loss(msgspec.Struct):
    """State of a device that does not answer: since when, missed replies, next probe."""

    since_ns: int
    probe_at_ns: int
    missed: int = 1  # consecutive missed replies
    probing: bool = False
    reported: bool = False  # counts as lost and has been reported
    problem: str = ""  # last reported reason why it cannot be read again


class _WrittenCommand(msgspec.Struct):
    data: bytes = b""  # last acknowledged data; empty: none
    at_ns: int = 0
    commanded: bool = False  # a controller commanded it in this run
    writing: bool = False
    refused: bool = False


class Devices:
    """All devices of one bus during a run; a device is given by its index in the bus's plan."""

    def __init__(self, context: BusContext) -> None:
        self._plan = plan = context.idle.plan
        self._idle = context.idle
        self._reads = context.reads
        self._samples = context.samples
        self._commands = context.commands
        self._events = context.events
        self._dialect = dialect_of(plan.protocol)
        self._members: list[list[int]] = [[] for _ in plan.devices]
        for number, member in enumerate(plan.members):
            if member.device >= 0:
                self._members[member.device].append(number)
        self._losses: list[_Loss | None] = [None] * len(plan.devices)
        self._joined_ns = [-1] * len(plan.devices)  # time of the last return of each to the cyclic reads
        self._turns = [0] * len(plan.devices)  # number of probes of each
        self._flaps = [0] * len(plan.devices)  # consecutive losses of each right after a return
        self._errors = [0] * len(plan.devices)  # last reported error byte of each
        commands = decode_devices(context.plan)
        self._written = [
            [(command, _WrittenCommand()) for command in commands.get(device.name, ())]
            for device in plan.devices
        ]
        """Commands of each device, each with the bytes last written and their time."""

    # The cyclic reads

    def judge_replies(self, now_ns: int) -> None:
        """Report changed error bytes in the cycle's replies; stop reading devices that did not answer."""
        for index, members in enumerate(self._members):
            self._report_error(index, max(self._reads.errors[member] for member in members))
            if self._losses[index] is None and any(self._reads.blamed(member) for member in members):
                self._miss(index, now_ns)

    def recover_line(self) -> None:
        """Stop reading all devices after their line was lost; each is probed before it is read again."""
        now_ns = self._idle.now_ns()
        for index in range(len(self._losses)):
            self._leave(index, _Loss(now_ns, now_ns, missed=0, reported=True))

    def recover_servo(self, servo: int) -> None:
        """Do nothing: required by the interface, but devices return independently of servos."""

    def _miss(self, index: int, now_ns: int) -> None:
        label = self._label(index)
        garbled = any(self._reads.garbled[member] for member in self._members[index])
        servos = len(self._plan.servos)
        newest_ns = min(int(self._samples.blocks_at_ns[member - servos]) for member in self._members[index])
        self._flaps[index] = self._flaps[index] + 1 if newest_ns <= self._joined_ns[index] else 0
        if self._flaps[index] == MOST_BROKEN:
            for member in self._members[index]:
                self._reads.apart[member] = True
            self._report_device(index, texts.device_read_apart(label))
        loss = _Loss(now_ns, now_ns)
        if not self._flaps[index]:
            self._report_device(index, texts.reply_garbled(label) if garbled else texts.reply_missed(label))
        elif self._flaps[index] >= 2 * MOST_BROKEN:
            loss.reported, loss.probe_at_ns = True, now_ns + PROBE_NS
            self._report_device(index, texts.device_silent_in_cycles(label))
        self._leave(index, loss)

    def _leave(self, index: int, loss: _Loss) -> None:
        self._losses[index] = loss
        for member in self._members[index]:
            self._reads.stop_reading(member)

    def _report_error(self, index: int, error: int) -> None:
        if error != self._errors[index]:
            self._errors[index] = error
            text = texts.error_byte_set if error else texts.error_byte_cleared
            self._report_device(index, text(self._label(index), self._dialect.describe_error(error)))

    # Idle time

    def schedule_idle_work(self, time_ns: int) -> None:
        """Queue, for the idle time of the bus, probes of silent devices and writes of changed commands."""
        now_ns = self._idle.now_ns()
        for index, loss in enumerate(self._losses):
            if loss is None:
                self._schedule_writes(index, now_ns)
            elif not loss.probing and loss.probe_at_ns <= now_ns:
                loss.probing = True
                name = f"the return of {self._label(index)}"
                self._idle.add(self._probe(index, loss), Urgency.REPAIR, name)

    def _probe(self, index: int, loss: _Loss) -> Program[None]:
        """Probe a silent device and read its states; if it answers, resume reading it in cycles.

        Replies come in the order of their requests. The first probe has a reply of another length than the
        requests before it, so a late reply cannot be taken for its reply, and after it no late reply can
        follow.
        """
        device, line = self._plan.devices[index], plan_line(self._plan)
        probes = _probes(line, device)
        self._turns[index] += 1
        first = probes[self._turns[index] % len(probes)]
        reads = (line.read_range(device.servo_id, block.address, block.length) for block in device.blocks)
        problem = ""
        for request in (first, *reads):
            # Use a short timeout: a silent device must not take the idle time of the servos.
            brief_ns = request.due_ns + line.latency_ns + line.device_margin_ns
            reply = yield replace(request, timeout_ns=brief_ns)
            if not reply.answered:
                problem = (
                    "rejects reads" if reply.outcome is TransactionOutcome.REFUSED else "does not answer"
                )
                break
        if not problem and loss.reported:  # the device may have been replaced
            problem = yield from inspect_device(self._plan, device, line)
        if self._losses[index] is not loss:
            return  # the line was lost during the probe
        now_ns = self._idle.now_ns()
        if not problem:
            self._take_back(index, loss)
            return
        loss.missed += 1
        loss.probing, loss.probe_at_ns = False, now_ns
        if loss.reported:
            loss.probe_at_ns += PROBE_NS
            if problem not in {loss.problem, "does not answer"}:
                loss.problem = problem
                self._report_device(index, texts.device_unfit(self._label(index), problem))
        elif loss.missed >= LOST_CYCLES and now_ns - loss.since_ns >= LOST_AGE_NS:
            loss.reported = True
            self._report_device(index, texts.device_lost(self._label(index), loss.missed))

    def _take_back(self, index: int, loss: _Loss) -> None:
        self._losses[index] = None
        self._joined_ns[index] = self._idle.now_ns()
        for member in self._members[index]:
            self._reads.join(member)
        for _, written in self._written[index]:
            written.data = b""  # the device may have rebooted
        if loss.reported:
            self._report_device(index, texts.device_back(self._label(index)))
        elif not self._flaps[index]:
            self._report_device(index, texts.device_answers_again(self._label(index), loss.missed))

    # Commands

    def _schedule_writes(self, index: int, now_ns: int) -> None:
        """Queue writes of a device's commands that changed or are older than `REPEAT_NS`.

        A command that no controller sends any more gets its safe value.
        """
        for command, written in self._written[index]:
            value = float(self._commands[command.column])
            if math.isnan(value):
                if command.safe is None or not written.commanded:
                    continue
                value = command.safe
            else:
                written.commanded = True
            if written.writing:
                continue
            data = command.data(value)
            if data != written.data or now_ns - written.at_ns >= REPEAT_NS:
                written.writing = True
                name = f"{command.name} of {self._label(index)}"
                urgency = Urgency.SLOW if data == written.data else Urgency.STEERED
                self._idle.add(self._write_command(index, command, written, data), urgency, name)

    def _write_command(
        self, index: int, command: DeviceCommand, written: _WrittenCommand, data: bytes
    ) -> Program[None]:
        device = self._plan.devices[index]
        reply = yield plan_line(self._plan).write_range(device.servo_id, command.address, data)
        written.writing = False
        refused = reply.outcome is TransactionOutcome.REFUSED
        if refused and not written.refused:
            value, errors = int.from_bytes(data, "little"), self._dialect.describe_error(reply.error)
            self._report_device(index, texts.command_refused(self._label(index), command.item, value, errors))
        written.refused = refused
        # Record a refused value as written, so that it is not tried again before it is due.
        written.data = data if reply.answered or refused else b""
        written.at_ns = self._idle.now_ns()

    def _label(self, index: int) -> str:
        return self._plan.label(self._plan.devices[index])

    def _report_device(self, index: int, event: EventBody) -> None:
        self._events.emit_event(self._plan.devices[index].name, event)


def attach_devices(context: BusContext) -> Devices | None:
    """Return the runtime of a bus's devices; None if the bus has no devices."""
    return Devices(context) if context.idle.plan.devices else None


STAGE = BusStage(inspect=survey_devices, attach=attach_devices)


def _probes(line: Line, device: DevicePlan) -> list[Transaction]:
    """Return alternative requests to probe a device, with reply lengths unlike each other and its states'.

    The lengths of their replies differ from each other and from those of its states.
    """
    block = device.blocks[0]
    found = [
        line.read_range(device.servo_id, block.address, length) for length in (1, 2) if length < block.length
    ]
    if block.length != line.dialect.PING_LENGTH or not found:
        found.append(line.ping(device.servo_id))
    return found
